"""What `onix` learns from many scenes by their frames alone: rows of docs/data/onix_scenes.csv.

    python benchmarks/onix_scenes.py FOLDER [--count 150] [--steps 1000] [--seeds 0] [--adversaries 0 0.1]
        [--scenes 0 1 2] [--views 2 3 4] [--write]

FOLDER gets a dataset of `count` scenes of red cells (seed 0, 48 × 48 pixels, cells 8 to 16 pixels across, half of the
scenes without noise) and a training for each seed and weight of the adversary; those that are there are not made again.
They are judged on red cells of another seed without noise, the material known: as the network guesses, and after the 80
steps of a fit to the frames of that scan, which is how long the method is also fitted from weights that saw nothing.
Dice and the error of δ are of the true volume, SSIM and FRCM of frames that are held out.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.geometry import Grid
from holosplat_bench.declaration import Case
from holosplat_bench.opponents.onix import Onix
from holosplat_bench.opponents.training import AlignedTraining, AlignedValidation
from holosplat_bench.training.folder import Dataset, make_dataset
from holosplat_bench.training.options import FrameLossWeights, Ranges, TrainOptions, ViewSampling
from holosplat_bench.training.sample import drawn_case
from holosplat_bench.training.shown import Validation
from holosplat_bench.training.train import WEIGHTS, made_by

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "onix_scenes.csv"
LEARNT = Ranges(rows=48, columns=48, views=4, across=(8.0, 16.0), noiseless=0.5, tilted=0.0)
UNSEEN = replace(LEARNT, noiseless=1.0)
LEARNT_SEED, UNSEEN_SEED = 0, 77
"""Of the scenes; those of seed 1 validate."""
NOTHING = "nothing"
"""What weights have seen that are drawn anew."""


@dataclass(frozen=True)
class Row:
    """weights: what they were learnt from; seed: of the training, or of weights that saw nothing; learnt, steps: scenes
    and steps of the training; training_seconds: of the processor; scene, views: what it is judged on; fitted: steps on
    its own frames."""

    weights: str
    seed: int
    learnt: int
    steps: int
    training_seconds: float
    scene: int
    views: int
    fitted: int
    dice: float
    error: float
    ssim: float
    frcm: float
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Trained:
    """Weights, and what a row says of them."""

    file: str
    weights: str
    seed: int
    learnt: int
    steps: int
    seconds: float


def trained(folder: Path, scenes: Dataset, steps: int, seed: int, adversary: float) -> Trained:
    """Weights of one training, which is made unless it is there."""
    out = folder / f"adversary{adversary:g}-seed{seed}-steps{steps}"
    how = TrainOptions(
        steps=steps,
        keep_every=steps,
        validation=4,
        seed=seed,
        network="onix",
        shown=ViewSampling(views=(2, 2, 3, 3, 4)),
        frames=FrameLossWeights(adversary=adversary),
    )
    taken = out / "seconds.txt"
    if not taken.is_file():
        training, began = AlignedTraining.begun(scenes, out, how), time.process_time()
        told = Validation.of(scenes.ranges, scenes.seed, how.validation, lambda fraction: None)
        training.run(AlignedValidation(told.samples, network="onix"), lambda now: None)
        training.finish(AlignedValidation(told.samples, network="onix"), made_by("cpu"))
        taken.write_text(f"{time.process_time() - began:.0f}", encoding="utf-8")
    said = "frames" if adversary == 0 else f"frames, adversary {adversary:g}"
    return Trained(str(out / WEIGHTS), said, seed, scenes.count, steps, float(taken.read_text(encoding="utf-8")))


def judged(case: Case, scan: hs.Scan, method: Onix, seed: int) -> dict[str, Any]:
    """Scores of what `method` makes of the frames for training."""
    began = time.process_time()
    result = hs.reconstruct(scan, hs.MaterialPrior.known(case.prior.materials[0]), method, seed, matter="levels")
    seconds = time.process_time() - began
    scored = hs.evaluate(result, scan, case.scene.voxelise(Grid.of_views(scan.views)))
    assert scored.volume is not None
    assert scored.test is not None
    volume, frames = scored.volume, scored.test.mean
    scores = {"dice": volume.dice, "error": volume.relative_error_delta}
    return scores | {"ssim": frames["ssim"], "frcm": frames["frcm"], "seconds": seconds}


def rows_of(scene: int, views: int, every: list[Trained]) -> Iterator[Row]:
    """Rows of one scene: by each of the weights, as they are and fitted."""
    case, plain = drawn_case(replace(UNSEEN, views=views), UNSEEN_SEED, scene), Onix()
    scan, usual = case.scan(), plain.fit.schedule.steps
    for one in every:
        for steps in (0, usual) if one.file else (usual,):
            fit = replace(plain.fit, weights=one.file, schedule=replace(plain.fit.schedule, steps=steps))
            said = judged(case, scan, replace(plain, fit=fit), one.seed)
            told = (one.weights, one.seed, one.learnt, one.steps, one.seconds, scene, views, steps)
            yield Row(*told, **said, machine=f"{platform.machine()}, shared", commit=commit())


def keep(found: Row) -> None:
    """Write `found` into the table, in place of an earlier row of the same weights, seed, scene, views and steps."""
    new = {name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in asdict(found).items()}
    names = ("weights", "seed", "scene", "views", "fitted")
    others = [each for each in read(PAGE) if [each[name] for name in names] != [new[name] for name in names]]
    write([*others, new], PAGE)


def main() -> None:
    """Make what is missing, judge, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--adversaries", nargs="+", type=float, default=[0.0, 0.1])
    parser.add_argument("--scenes", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4])
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scenes = Dataset(options.folder / "scenes", LEARNT, LEARNT_SEED, options.count)
    make_dataset(scenes, 1, lambda fraction: None)
    every = [
        trained(options.folder, scenes, options.steps, seed, weight)
        for seed, weight in product(options.seeds, options.adversaries)
    ]
    every += [Trained("", NOTHING, seed, 0, 0, 0.0) for seed in options.seeds]
    for views, scene in product(options.views, options.scenes):
        for row in rows_of(scene, views, every):
            print(row, flush=True)
            if options.write:
                keep(row)


if __name__ == "__main__":
    main()
