"""What a learned start is worth: rows of docs/data/learned.csv.

    python benchmarks/learned.py [DATA] [--cases espresso cells capsules foam crowd ellipsoids soft-cells foam-noise …]
        [--views 2 3 4 6 8] [--scenes 0] [--starts phase learned] [--weights FILE] [--write]

espresso: one time of red cells in flow, of an ESPResSo run in DATA (as for motion.py), on 128 × 96 pixels of 0.5 µm
(20 keV, 10 cm), at 0/90°, 0/30/48° and even directions. The others: scenes of 64 × 64 pixels that `holosplat dataset`
draws by a seed that nothing was learnt from, in the first of their views. Haemoglobin, or the material, is known; there
is no noise. With `-noise` at the end of their names, the same scenes have photon noise in the frames for training: 1000
photons a pixel in the flowing cells, and elsewhere a standard deviation of a tenth of the phase of a body. With
`-unknown`, the material is not told. Every scene is reconstructed by `auto`, with and without `--start learned`, and
scored against the true volume and in two views that are held out, without noise. Of continuous cells the kind of matter
is not told.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.learning.start import LearnedStart, guess_matter
from holosplat.methods import Auto, Task
from holosplat.methods.learned import NAME
from holosplat.methods.volume import material_of_levels
from holosplat.metrics import volume_scores
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.scene import MeshScene
from holosplat_bench.training.options import Kind, Ranges
from holosplat_bench.training.sample import drawn_case
from motion import MATERIAL, PHOTONS, PIXEL, SHAPE, cells_in_flow

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "learned.csv"
UNEQUAL = {2: (0.0, 90.0), 3: (0.0, 30.0, 48.0)}
"""Angles of two and three beams [degrees], as instruments have them; more are even."""
SEED = 77
"""Of drawn scenes; networks learn from seed 0 and are validated by seed 1."""
KINDS: dict[str, Kind] = {
    **{"cells": "red-cells", "capsules": "capsules", "foam": "foam"},
    **{"crowd": "crowd", "ellipsoids": "ellipsoids", "soft-cells": "soft-cells"},
}
SCENES = {"espresso": (5, 40)}
"""Which are taken; of the others the first."""
NOISY, UNTOLD = "-noise", "-unknown"
"""Ends of the names of cases with photon noise, and of such whose material is not told."""
NOISE = 0.1
"""Standard deviation of the noise [radians] of drawn scenes, over the phase of a body: a third of the contrast."""
CASES = [base + end for end in ("", NOISY, UNTOLD) for base in ("espresso", *KINDS)]
FIELD = 64
"""Rows and columns of drawn scenes."""
BESIDE = (17.0, 73.0)
"""Angles of the flowing cells' views that are held out [degrees]."""


@dataclass(frozen=True)
class Row:
    """case, scene: what of, and which snapshot, or number of a drawn scene; start: phase, learned, or guess (the
    network's volume itself); dice, error: of occupancy and relative of δ; ssim, frcm: of two views that are held out;
    left: what the guess leaves unexplained of the retrieved thickness; begun: what the run said of its start."""

    case: str
    scene: int
    views: int
    start: str
    dice: float | str
    error: float | str
    ssim: float | str
    frcm: float | str
    left: float | str
    begun: str
    seconds: float
    machine: str
    commit: str


UNSAID: dict[str, Any] = dict.fromkeys(("ssim", "frcm", "left", "begun"), "")
"""What some rows do not say."""


@dataclass(frozen=True)
class Setting:
    """A scan with its true scene and what is told of its material; levels: whether that it has such is told."""

    scan: hs.Scan
    scene: MeshScene | ContinuousScene
    prior: hs.MaterialPrior
    levels: bool = True


def espresso(data: Path, snapshot: int, views: int, noisy: bool = False) -> Setting:
    """One time of the flowing cells."""
    scene = cells_in_flow(data, snapshot, 1).snapshots[0]
    angles = UNEQUAL.get(views) or tuple(np.arange(views) * 180 / views)
    exposures = hs.Exposures.of(hs.Views.from_angles(np.array((*angles, *BESIDE)), SHAPE, PIXEL), 20.0, 0.1)
    is_test = np.arange(views + 2) >= views
    scan = hs.simulate(scene, exposures, is_test=is_test)
    if noisy:
        noise = hs.simulate(scene, exposures, is_test=is_test, photons_per_pixel=PHOTONS, seed=snapshot)
        scan = replace(scan, frames=np.where(is_test[:, None, None], scan.frames, noise.frames))
    return Setting(scan, scene, hs.MaterialPrior.known(MATERIAL))


def drawn(kind: Kind, number: int, views: int, noisy: bool = False) -> Setting:
    """A drawn scene in the first of its views."""
    ranges = Ranges(kinds=(kind,), rows=FIELD, columns=FIELD, noiseless=1.0 - noisy, tilted=0.0, views=views)
    case = drawn_case(replace(ranges, noise=(NOISE, NOISE)), SEED, number)
    return Setting(case.scan(), case.scene, hs.MaterialPrior.known(case.prior.materials[0]), kind != "soft-cells")


def setting(case: str, data: Path | None, scene: int, views: int) -> Setting:
    """The scene of a case, and what is told of it."""
    base, noisy, untold = case.removesuffix(NOISY).removesuffix(UNTOLD), case.endswith(NOISY), case.endswith(UNTOLD)
    if base == "espresso":
        assert data is not None, "the flowing cells need DATA"
        found = espresso(data, scene, views, noisy)
    else:
        found = drawn(KINDS[base], scene, views, noisy)
    return replace(found, prior=hs.MaterialPrior.unknown()) if untold else found


def rows(given: Setting, weights: str, starts: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Start and values of the row, for the guess and for each of `starts`."""
    how, prior, train = LearnedStart(weights=weights), given.prior, given.scan.train()
    began = time.perf_counter()
    material = material_of_levels(Task(train, prior))
    guess = guess_matter(train, material, how.network.network, lambda stage, fraction: None)
    seconds = time.perf_counter() - began
    truth, found = given.scene.voxelise(guess.grid), guess.values.numpy() * material.delta
    scores = volume_scores(hs.Volume(found, found / material.ratio, guess.grid), truth)
    said = {"dice": scores.dice, "error": scores.relative_error_delta, "left": guess.left(), "seconds": seconds}
    table: list[tuple[str, dict[str, Any]]] = [("guess", said)]
    whole, plain = given.scene.voxelise(Grid.of_views(given.scan.views)), Auto()
    for start in starts:
        method = replace(plain, gaussians=replace(plain.gaussians, start=start, learned=how))
        began = time.perf_counter()
        result = hs.reconstruct(given.scan, prior, method, matter="levels" if given.levels else None)
        seconds = time.perf_counter() - began
        scored = hs.evaluate(result, given.scan, whole)
        assert scored.volume is not None
        assert scored.test is not None
        said = {"dice": scored.volume.dice, "error": scored.volume.relative_error_delta}
        said |= {name: scored.test.mean[name] for name in ("ssim", "frcm")}
        begun = next((each.line for each in result.choice.decisions if each.name == NAME), "")
        table.append((start, said | {"begun": begun, "seconds": seconds}))
    return table


def keep(row: Row) -> None:
    """Write `row` into the table, in place of an earlier one of the same case, scene, views and start."""
    new = {name: str(value) for name, value in asdict(row).items()}
    names = ("case", "scene", "views", "start")
    others = [each for each in read(PAGE) if [each[name] for name in names] != [new[name] for name in names]]
    write([*others, new], PAGE)


def main() -> None:
    """Run the cases that are asked for, and print and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES)
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4, 6, 8])
    parser.add_argument("--scenes", nargs="+", type=int)
    parser.add_argument("--starts", nargs="+", default=["phase", "learned"], choices=["phase", "learned"])
    parser.add_argument("--weights", default="")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    every = [
        (v, case, n)
        for v in options.views
        for case in options.cases
        for n in options.scenes or SCENES.get(case.removesuffix(NOISY).removesuffix(UNTOLD), (0,))
    ]
    for views, case, scene in every:
        for start, said in rows(setting(case, options.data, scene, views), options.weights, options.starts):
            values: dict[str, Any] = {**UNSAID, **said, "machine": platform.machine(), "commit": commit()}
            row = Row(case, scene, views, start, **values)
            print(row, flush=True)
            if options.write:
                keep(row)


if __name__ == "__main__":
    main()
