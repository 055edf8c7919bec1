"""Conformal factors of the errors that `rehearse` states, on sealed scenes: docs/data/calibrated_intervals.csv.

    python benchmarks/calibrate_intervals.py --scenes 200     # resumable; rows that are there are not made again
    python benchmarks/calibrate_intervals.py --summary        # factors of the package, and coverage by family

Scenes are those of `family_scenes`, in turn of every simulated family, on pixels joined 2 × 2 (23 to 30 of them along
an edge), of 2 to 16 views, reconstructed by linear retrieval, by retrieval of all views with total variation, as a
smooth volume, or as `reconstruct` does by default, which takes ten times as long and has an eighth of the scenes. A
run's errors against the truth stand beside what its rehearsals say of them. The map of matter of each run is compared
with the true matter, too (docs/data/matter_map.csv): its probabilities come from rehearsals alone, which no truth
enters. Every fourth scene is also run with a mistake in the metadata: then only the residual over that of the
rehearsals counts.

Factors are those of all scenes; the coverage of a family is that by factors of all other families. Frames are simulated
with rays through meshes, or closed forms, on a raster several times finer than that of any fit.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from family_scenes import SIMULATED
from machine import commit
from rows import machine, merge, read, write

import holosplat as hs
from holosplat.geometry import rotation_y
from holosplat.methods import METHODS
from holosplat.metrics import dice, robust_material_delta
from holosplat.scan import Scan
from holosplat.workflows.certainty import (
    FACTORS,
    LEVEL,
    SIGNED,
    SIZES,
    Factor,
    errors_of,
    scale_of,
)
from holosplat.workflows.rehearsal import RESIDUAL, Rehearsal, rehearse

DATA = Path(__file__).resolve().parents[1] / "docs" / "data"
PAGE, COVERAGE = DATA / "calibrated_intervals.csv", DATA / "interval_coverage.csv"
MAP, RELIABILITY = DATA / "matter_map.csv", DATA / "matter_reliability.csv"
ENDS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
"""Of the probabilities that the map is compared at."""
SEED = 7001
"""Of the first scene; no other script draws scenes of these numbers."""
VIEWS, TIMES, TIMES_OF_MISTAKES = (2, 3, 4, 6, 8, 12, 16), 2, 2
WAYS = (*3 * ("ctf-tv", "holographic-tv"), "volume", "auto")
RIGHT = 0.95
"""Part of the right runs that are not called wrong."""
NUMBERS = (*SIGNED, *SIZES)
COLUMNS = ("scene", "family", "method", "views", "mistake", "good", "excess")
COLUMNS += tuple(f"{name}_{what}" for name in NUMBERS for what in ("error", "scale"))
COLUMNS += ("facts", "seconds", "machine", "commit")

Mistake = Callable[[Scan, hs.MaterialPrior, np.random.Generator], tuple[Scan, hs.MaterialPrior]]


def posed(scan: Scan, rotations: np.ndarray, shifts: np.ndarray | None = None) -> Scan:
    """`scan` with other poses of its views."""
    views = replace(scan.views, rotations=rotations, shifts=scan.views.shifts if shifts is None else shifts)
    return replace(scan, exposures=replace(scan.exposures, views=views))


def shuffled(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> tuple[Scan, hs.MaterialPrior]:
    """Angles in another order."""
    return posed(scan, scan.views.rotations[rng.permutation(len(scan))]), prior


def halved(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> tuple[Scan, hs.MaterialPrior]:
    """Half the angles."""
    angles = np.unwrap(np.arctan2(scan.views.rotations[:, 0, 2], scan.views.rotations[:, 0, 0]))
    return posed(scan, rotation_y(np.rad2deg(0.5 * angles))), prior


def off_axis(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> tuple[Scan, hs.MaterialPrior]:
    """An axis of rotation 2 to 4 pixels elsewhere."""
    by = rng.choice([-1, 1]) * rng.uniform(2, 4) * scan.views.finest
    return posed(scan, scan.views.rotations, scan.views.shifts + np.array([by, 0.0])), prior


def other_sign(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> tuple[Scan, hs.MaterialPrior]:
    """Matter on the other side of its medium."""
    flipped = [hs.DeltaBeta(-delta, -beta) for delta, beta in prior.materials]
    return scan, hs.MaterialPrior.known(*flipped) if flipped else prior.signed(-1)


MISTAKES: dict[str, Mistake] = {
    "angles shuffled": shuffled,
    "half the angles": halved,
    "axis elsewhere": off_axis,
    "other sign": other_sign,
}


def rows_of(number: int) -> Iterator[dict[str, Any]]:
    """The rows of a scene."""
    rng, began = np.random.default_rng([SEED, number]), time.perf_counter()
    name = list(SIMULATED)[number % len(SIMULATED)]
    views, way = int(rng.choice(VIEWS)), str(rng.choice(WAYS))
    shared = {"scene": number, "family": name, "method": way, "views": views, "mistake": ""}
    shared |= {"machine": machine(), "commit": commit()}
    try:
        made = replace(SIMULATED[name], views=(views,)).scene(SEED + number, name)
    except hs.InputError as refusal:  # its bodies find no place
        yield shared | {"good": f"refused: {refusal}"}
        return
    scan = made.scan.binned(2)
    assert made.matter is not None
    truth, shared = made.matter.voxelise(hs.Grid.of_views(scan.views)), shared | {"facts": made.facts}
    mistakes = ["", str(rng.choice(list(MISTAKES)))] if number % 4 == 3 else [""]
    for mistake in mistakes:
        told, prior = MISTAKES[mistake](scan, made.prior, rng) if mistake else (scan, made.prior)
        try:
            done = hs.reconstruct(told, prior, METHODS[way])
            times = TIMES_OF_MISTAKES if mistake else TIMES
            shown = rehearse(done, told, prior, METHODS[way], times=times, bins=1, causes=False)
        except hs.InputError as refusal:
            yield shared | {"mistake": mistake, "good": f"refused: {refusal}"}
            continue
        if not mistake:
            merge(map_rows(shown, truth, shared), MAP, "scene", "low")
        numbers = {} if mistake else _numbers(shown, errors_of(done, truth))
        facts = {"mistake": mistake, "good": shown.explained.good, "excess": f"{shown.excess[0]:.4g}"}
        yield shared | facts | numbers | {"seconds": f"{time.perf_counter() - began:.1f}"}


def _numbers(shown: Rehearsal, errors: dict[str, float]) -> dict[str, str]:
    found = dict[str, str]()
    for name in NUMBERS:
        for what, value in (("error", errors[name]), ("scale", scale_of(name, shown.values(name)))):
            found[f"{name}_{what}"] = f"{value:.5g}"
    return found


def map_rows(shown: Rehearsal, truth: hs.Volume, shared: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each range of probabilities: its voxels, how many are expected to be matter, and how many are."""
    chance, matter = shown.matter.values, truth.delta / robust_material_delta(truth) > 0.5
    found = shown.matter.found.delta / shown.unit > 0.5
    told = {name: shared[name] for name in ("scene", "family", "method", "views")}
    told |= {"dice": f"{dice(found, matter):.3f}", "expected_dice": f"{shown.matter.expected_dice:.3f}"}
    which = np.clip(np.digitize(chance, ENDS) - 1, 0, len(ENDS) - 2)
    rows = []
    for n, low in enumerate(ENDS[:-1]):
        inside = which == n
        numbers = {"voxels": int(inside.sum()), "expected": f"{chance[inside].sum(dtype=np.float64):.1f}"}
        rows.append(told | {"low": low} | numbers | {"matter": int(matter[inside].sum())})
    return rows


def reliability() -> None:
    """Write how often voxels of each range of probabilities are matter, over all scenes, and print it."""
    rows, lines = read(MAP), list[dict[str, str]]()
    scenes = sorted({row["scene"] for row in rows})
    for low, high in pairwise(ENDS):
        some = [row for row in rows if float(row["low"]) == low]
        voxels, expected, matter = (sum(float(row[name]) for row in some) for name in ("voxels", "expected", "matter"))
        if voxels:
            line = {"from": f"{low:g}", "to": f"{high:g}", "voxels": f"{voxels:.0f}"}
            line |= {"expected": f"{expected / voxels:.4f}", "matter": f"{matter / voxels:.4f}"}
            lines.append(line)
            print(line)
    write(lines, RELIABILITY)
    dices = [next((float(r["dice"]), float(r["expected_dice"])) for r in rows if r["scene"] == each) for each in scenes]
    off = np.diff(np.array(dices), axis=1)
    print(f"{len(scenes)} maps; Dice expected over true: mean {off.mean():+.3f}, rms {np.sqrt((off**2).mean()):.3f}")


def columns_of(rows: Sequence[dict[str, Any]], name: str) -> np.ndarray:
    """Errors, scales and excesses of a quantity, [3, N]."""
    return np.array([[float(row[each]) for row in rows] for each in (f"{name}_error", f"{name}_scale", "excess")])


def conformal_quantile(scores: np.ndarray, level: float) -> float:
    """The ⌈(n + 1) level⌉-th smallest of n scores, which the next one exceeds with a probability of at most 1 - level
    (Vovk et al. 2005; Lei et al. 2018, section 2.2); infinite for too few."""
    rank = math.ceil((len(scores) + 1) * level)
    return float(np.sort(scores)[rank - 1]) if rank <= len(scores) else math.inf


def fitted_factor(errors: np.ndarray, scales: np.ndarray, excess: np.ndarray) -> Factor:
    """What makes the intervals of a quantity by its errors [N], its scales [N] and the excess [N] of N scenes.

    Each floor, of the scales that there are, makes intervals that cover `LEVEL` of the scenes, whether scales count
    times the excess or not: what has the least mean logarithm of the length is taken (efficiency; Vovk et al. 2016,
    COPA). Of so few scenes that there is no quantile, the factor is the largest score; then the level is n/(n + 1).
    """
    sizes, found = np.abs(errors), list[tuple[float, Factor]]()
    for power in (0, 1):
        grown = scales * np.maximum(1.0, excess) ** power
        for floor in np.unique(grown[grown > 0]):
            scores = sizes / (grown + floor)
            factor = min(conformal_quantile(scores, LEVEL), float(scores.max()))
            length = float(np.log(factor * (grown + floor)).mean())
            found.append((length, Factor(float(floor), factor, len(errors), power)))
    return min(found, key=lambda each: each[0])[1]


def covered(of: Factor, rows: Sequence[dict[str, Any]], name: str) -> list[bool]:
    """Whether the intervals of a quantity hold the truth of each row."""
    return [bool(abs(error) <= of.reach(scale, excess)) for error, scale, excess in columns_of(rows, name).T]


def summary() -> None:
    """Write the package's factors and the coverage by family, and print both."""
    rows = [row for row in read(PAGE) if row["excess"]]
    right, wrong = [r for r in rows if not r["mistake"]], [r for r in rows if r["mistake"]]
    excess = np.array([float(row["excess"]) for row in right])
    limit = min(conformal_quantile(excess, RIGHT), float(excess.max()))
    parts = [f"# {len(right)} right runs; made by benchmarks/calibrate_intervals.py --summary from {PAGE.name}\n"]
    lines = list[dict[str, str]]()
    families = sorted({row["family"] for row in right})
    for name in NUMBERS:
        of = fitted_factor(*columns_of(right, name))
        numbers = {"floor": f"{of.floor:.4g}", "factor": f"{of.factor:.4g}", "scenes": of.scenes, "power": of.power}
        parts.append("".join([f"[{name}]\n", *(f"{key} = {value}\n" for key, value in numbers.items())]))
        inside = dict[str, list[bool]]()
        for family in families:
            others = [row for row in right if row["family"] != family]
            own = [row for row in right if row["family"] == family]
            inside[family] = covered(fitted_factor(*columns_of(others, name)), own, name)
        every = [one for each in inside.values() for one in each]
        for family, each in {"all": every, **inside}.items():
            lines.append(_line(name, family, len(each), sum(each), of.factor))
        print(f"{name}: {of}, {sum(every)} of {len(every)} covered", flush=True)
    parts.append(f"[{RESIDUAL}]\nfloor = 0.0\nfactor = {limit:.4g}\nscenes = {len(right)}\n")
    for mistake in ("", *MISTAKES):
        some = [row for row in rows if row["mistake"] == mistake]
        over = sum(float(row["excess"]) > limit for row in some)
        unexplained = sum(row["good"] == "False" for row in some)
        if some:
            print(
                f"{mistake or 'right'}: {over} of {len(some)} above the limit {limit:.3g}; {unexplained} not explained"
            )
            lines.append(_line(RESIDUAL, mistake or "right", len(some), over, limit))
    print(f"{len(right)} right runs of {len(families)} families, {len(wrong)} with a mistake")
    FACTORS.write_text("\n".join(parts))
    write(lines, COVERAGE)


def _line(quantity: str, family: str, scenes: int, covered: int, factor: float) -> dict[str, str]:
    return {
        "quantity": quantity,
        "family": family,
        "scenes": str(scenes),
        "covered": str(covered),
        "factor": f"{factor:.3g}",
    }


def main() -> None:
    """Make rows that are not there, or the summary of those that are."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--summary", action="store_true")
    options = parser.parse_args()
    if options.summary:
        summary()
        reliability()
        return
    for number in range(options.first, options.scenes):
        if any(row["scene"] == str(number) for row in read(PAGE)):
            continue
        rows = list(rows_of(number))
        merge(rows, PAGE, "scene", columns=COLUMNS)
        for row in rows:
            print({name: row.get(name, "") for name in COLUMNS[:10]}, row.get("seconds", ""), flush=True)


if __name__ == "__main__":
    main()
