"""Whether the verdict of `rehearse` separates right runs from wrong ones, and names the cause: docs/data/verdicts.csv.

    python benchmarks/verdicts.py                   # resumable; rows that are there are not made again
    python benchmarks/verdicts.py --summary         # how many, docs/data/verdict_words.csv

Scenes are those of `family_scenes`, in turn of every simulated family, on pixels joined 2 × 2, of seeds and numbers of
views that the calibration of the verdict's limit has not seen. Every second scene has a mistake in its metadata, or
light that nothing tells. A run is right if its error is at most twice that of the best of `BEST` by right metadata, and
wrong if it is more; so a mistake that does no harm leaves a right run.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from calibrate_intervals import halved, off_axis, other_sign, posed
from family_scenes import SIMULATED
from machine import commit
from rows import machine, merge, read, write

import holosplat as hs
from holosplat.checks import InputError
from holosplat.geometry import rotation_y
from holosplat.methods import METHODS
from holosplat.metrics import volume_scores
from holosplat.model import smooth_modes
from holosplat.rotations import angles_about_y
from holosplat.scan import Scan
from holosplat.workflows.certainty import NULL, factors
from holosplat.workflows.rehearsal import RESIDUAL, rehearse

DATA = Path(__file__).resolve().parents[1] / "docs" / "data"
PAGE, WORDS = DATA / "verdicts.csv", DATA / "verdict_words.csv"
SEED = 9501
"""Of the first scene; no other script draws scenes of these numbers."""
VIEWS, WAYS, BEST = (5, 7, 9, 11), ("ctf-tv", "holographic-tv"), ("ctf-tv", "holographic-tv", "volume")
HARMLESS = 2.0
"""So many times the error of the best method may a right run have."""
COLUMNS = ("scene", "family", "method", "views", "mistake", "cause", "error", "best", "word", "named", "excess")
COLUMNS += ("said", "seconds", "machine", "commit")

Told = tuple[Scan, hs.MaterialPrior]
Mistake = Callable[[Scan, hs.MaterialPrior, np.random.Generator], Told]


def doubled(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> Told:
    """Twice the angles."""
    angles = np.rad2deg(np.unwrap(angles_about_y(scan.views.rotations)))
    return posed(scan, rotation_y(2 * angles)), prior


def as_radians(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> Told:
    """Angles in radians that are taken for degrees."""
    return posed(scan, rotation_y(np.unwrap(angles_about_y(scan.views.rotations)))), prior


def farther(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> Told:
    """A distance that is wrong by a factor of 1.5 to 2.5."""
    by = rng.uniform(1.5, 2.5) ** rng.choice([-1, 1])
    return replace(scan, exposures=replace(scan.exposures, distance=by * scan.exposures.distance)), prior


def other_ratio(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> Told:
    """δ/β that is wrong by a factor of 2 to 3."""
    by = rng.uniform(2, 3) ** rng.choice([-1, 1])
    if prior.materials:
        return scan, hs.MaterialPrior.known(*(hs.DeltaBeta(each.delta, each.beta / by) for each in prior.materials))
    return scan, hs.MaterialPrior.of_ratio(by * prior.ratio)


def in_light(scan: Scan, prior: hs.MaterialPrior, rng: np.random.Generator) -> Told:
    """Smooth light of 10 % (rms), another in each frame, that nothing tells."""
    modes = smooth_modes(scan.views.shape, 3)[1:]
    draws = torch.from_numpy(rng.normal(size=(len(scan), len(modes)))).to(modes)
    factor = torch.einsum("vk,khw->vhw", 0.1 * draws / len(modes) ** 0.5, modes).exp().numpy()
    return replace(scan, frames=(scan.frames * factor).astype(np.float32)), prior


MISTAKES: dict[str, tuple[str, Mistake]] = {
    "half the angles": ("angles", halved),
    "twice the angles": ("angles", doubled),
    "angles in radians": ("angles", as_radians),
    "axis elsewhere": ("shift_x", off_axis),
    "other sign": ("sign", other_sign),
    "distance": ("distance", farther),
    "δ/β": ("absorption", other_ratio),
    "uneven light": ("light", in_light),
}
"""The mistakes, each with the cause that a verdict names (`workflows.certainty.MISTAKES`)."""


def row_of(number: int) -> dict[str, Any]:
    """The row of a scene."""
    rng, began = np.random.default_rng([SEED, number]), time.perf_counter()
    family = list(SIMULATED)[number % len(SIMULATED)]
    views, way = int(rng.choice(VIEWS)), str(rng.choice(WAYS))
    made = replace(SIMULATED[family], views=(views,)).scene(SEED + number, family)
    scan = made.scan.binned(2)
    assert made.matter is not None
    truth = made.matter.voxelise(hs.Grid.of_views(scan.views))
    mistake = list(MISTAKES)[number // 2 % len(MISTAKES)] if number % 2 else ""
    cause, change = MISTAKES.get(mistake, ("", lambda scan, prior, rng: (scan, prior)))
    told, prior = change(scan, made.prior, rng)

    def error(scan: Scan, prior: hs.MaterialPrior, way: str) -> tuple[hs.Reconstruction, float]:
        done = hs.reconstruct(scan, prior, METHODS[way])
        return done, volume_scores(done.object.voxelise(truth.grid), truth).relative_error_delta

    best = min(error(scan, made.prior, each)[1] for each in BEST)
    row = {"scene": number, "family": family, "method": way, "views": views, "mistake": mistake, "cause": cause}
    row |= {"best": f"{best:.4g}", "machine": machine(), "commit": commit()}
    try:
        done, found = error(told, prior, way)
        shown = rehearse(done, told, prior, METHODS[way], times=2, bins=1)
    except InputError as refusal:
        return row | {"word": "refused", "said": str(refusal)}
    named = "" if shown.cause is None else shown.cause.choice
    row |= {"error": f"{found:.4g}", "word": shown.word, "named": named, "excess": f"{shown.excess[0]:.4g}"}
    said = "" if shown.cause is None else shown.cause.line
    return row | {"said": said, "seconds": f"{time.perf_counter() - began:.1f}"}


def is_wrong(row: dict[str, str]) -> bool:
    """Whether a run is wrong by its truth; one that was refused has told the user so."""
    return float(row["error"]) > HARMLESS * float(row["best"])


def is_called_wrong(row: dict[str, str]) -> bool:
    """Whether a cause was named, or the excess passes the package's limit as it is now."""
    return row["named"] not in ("", NULL) or float(row["excess"]) > factors()[RESIDUAL].factor


def summary() -> None:
    """Write how many runs had each word, right and wrong ones, and how often the cause was named; and print it."""
    rows = [row for row in read(PAGE) if row["error"]]
    lines = list[dict[str, str]]()
    for mistake in ("", *MISTAKES):
        for wrong in (False, True):
            some = [row for row in rows if row["mistake"] == mistake and is_wrong(row) == wrong]
            if some:
                called = [row for row in some if is_called_wrong(row)]
                consistent = sum(row["word"] == "consistent" for row in some if row not in called)
                named = sum(row["named"] == row["cause"] for row in called) if mistake else ""
                line = {"mistake": mistake or "none", "result": "wrong" if wrong else "right", "runs": str(len(some))}
                line |= {"consistent": str(consistent), "limited": str(len(some) - len(called) - consistent)}
                lines.append({**line, "called wrong": str(len(called)), "cause named": str(named)})
                print(lines[-1])
    write(lines, WORDS)


def main() -> None:
    """Make rows that are not there, or the summary of those that are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=64)
    parser.add_argument("--summary", action="store_true")
    options = parser.parse_args()
    if options.summary:
        summary()
        return
    for number in range(options.scenes):
        if not any(row["scene"] == str(number) for row in read(PAGE)):
            row = row_of(number)
            merge([row], PAGE, "scene", columns=COLUMNS)
            print({name: row.get(name, "") for name in COLUMNS[:11]}, row.get("seconds", ""), flush=True)


if __name__ == "__main__":
    main()
