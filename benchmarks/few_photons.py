"""Closed bodies in few photons: how near surfaces come, scene by scene: docs/data/few_photons.csv.

    python benchmarks/few_photons.py [--scenes main12@1000 …] [--seeds 101 102] [--method surfaces]

A scene is a case of the benchmark and its photons a pixel. Methods are told the material. Rows of this commit that are
there already are kept, so that rows of several commits stand beside each other.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from rows import read, replaced, shown

import holosplat as hs
from holosplat.methods import METHODS
from holosplat.optics.noise import noise_share
from holosplat.version import source_commit
from holosplat.workflows.evaluate import volume_scores
from holosplat_bench.suite.case import load_case

TABLE = Path(__file__).resolve().parents[1] / "docs/data/few_photons.csv"
MAIN = tuple(f"main12@{photons}" for photons in (2000, 1000, 500, 250))
SCENES = (
    *MAIN,
    "noise12-500@500",
    "crowded12@1000",
    "cells12@300",
    "shells8@300",
    "foam12@500",
    "cells4@500",
    "main4@1000",
)


@dataclass(frozen=True)
class Row:
    """noise: share of the frames' contrast; error: of δ, and Dice, of the volume; explained: whether the program says
    that the training frames are; seconds: of one core."""

    scene: str
    seed: int
    method: str
    commit: str
    noise: float
    error: float
    dice: float
    explained: bool
    seconds: float
    machine: str


def row_of(scene: str, seed: int, method: str, commit: str) -> Row:
    """One scene, made, reconstructed and judged."""
    name, photons = scene.split("@")
    case = replace(load_case(name, seed), photons=float(photons))
    scan = case.scan()
    began = time.process_time()
    found = hs.reconstruct(scan, case.prior, METHODS[method], seed)
    seconds = time.process_time() - began
    truth = case.truth()
    scores = volume_scores(found.object.voxelise(truth.grid), truth)
    noise = noise_share(torch.from_numpy(scan.train().frames))
    said = found.verdict is not None and found.verdict.good
    machine = f"{platform.machine()}, one core of two"
    numbers = (noise, scores.relative_error_delta, scores.dice)
    return Row(scene, seed, method, commit, *numbers, said, round(seconds), machine)


def main() -> None:
    """Run scenes; rows of others stay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--method", default="surfaces")
    parser.add_argument("--out", type=Path, default=TABLE)
    wanted = parser.parse_args()
    commit = source_commit()
    for scene in wanted.scenes:
        for seed in wanted.seeds:
            sought = {"scene": scene, "seed": str(seed), "method": wanted.method, "commit": commit}
            if any(row.items() >= sought.items() for row in read(wanted.out)):
                continue
            row = row_of(scene, seed, wanted.method, commit)
            shown(row)
            replaced(wanted.out, row, key=4)


if __name__ == "__main__":
    main()
