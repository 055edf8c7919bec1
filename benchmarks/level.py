"""How right the level of sharp matter is of which the ratio δ/β is known, in noise: docs/data/level.csv.

    python benchmarks/level.py --out docs/data/level.csv               # some five minutes on one core

A row: the level over the true one by tomography (`estimate_delta`) and by the likeliest volume (`material_of_levels`).
Matter and noise are those of `benchmarks/mass.py`.
"""

from __future__ import annotations

import argparse
import itertools
import platform
from pathlib import Path

import torch
from machine import commit
from mass import CASES
from rows import written

from holosplat.baselines.material import estimate_delta
from holosplat.methods import Task
from holosplat.methods.volume import material_of_levels

SHARP = ("cells", "shells", "balls")
COLUMNS = ("case", "seed", "views", "noise", "tomography", "likeliest", "commit", "machine")


def row(name: str, seed: int, count: int, noise: float) -> dict[str, str]:
    """A row of the table."""
    sample = CASES[name](seed)
    task = Task(sample.scan(count, noise, seed), sample.prior("ratio"))
    tomography = estimate_delta(task.scan, sample.material.ratio, task.on_progress)
    likeliest = material_of_levels(task).delta
    levels = [f"{level / sample.material.delta:.3f}" for level in (tomography, likeliest)]
    return dict(zip(COLUMNS, (name, str(seed), str(count), f"{noise:g}", *levels, commit(), platform.machine())))


def main() -> None:
    """Write the table, line by line, or print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(SHARP), choices=SHARP)
    parser.add_argument("--seeds", nargs="+", type=int, default=[101, 102])
    parser.add_argument("--views", nargs="+", type=int, default=[12, 4])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.1, 0.2, 0.5, 1.0])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    wanted = itertools.product(options.views, options.noise, options.cases, options.seeds)
    written(options.out, COLUMNS, (row(name, seed, count, noise) for count, noise, name, seed in wanted))


if __name__ == "__main__":
    main()
