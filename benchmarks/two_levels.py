"""Are scenes of two materials told from those of one? What the start's volume says where nothing is known.

    python benchmarks/two_levels.py --snapshots DIR                       # tuning seeds, two minutes on two cores
    python benchmarks/two_levels.py --cases two_materials8 --seeds 5 6 7 8

Prints a Markdown table: the ratio of the two levels that split δ best, the spread they leave, and the lighter one's
share and deviation (`baselines.two_materials.Levels`).
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit

from holosplat.baselines import holographic_tv
from holosplat.baselines.two_materials import Levels, best_levels
from holosplat.matter import MaterialPrior
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.presets import preset
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import case_names, load_case


def levels_of(case: Case) -> Levels:
    """The two levels of a case that is told nothing of its matter."""
    train = case.scan().train()
    material = assumed_material(train, MaterialPrior.unknown(), lambda stage, fraction: None)
    unbounded = replace(preset("default").volume, upper=0.0)
    volume, grid = holographic_tv(train, material, unbounded, lambda stage, fraction: None)
    return best_levels(volume * material.delta, round(train.views.pixel_size / grid.voxel_size[0]) or 1)


def main() -> None:
    """Print the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=case_names())
    parser.add_argument("--seeds", nargs="+", type=int, default=[5])
    parser.add_argument("--snapshots", type=Path)
    options = parser.parse_args()
    print("| case | seed | ratio | spread | lighter share | its deviation | two |\n" + "| --- " * 7 + "|")
    for name in options.cases:
        for seed in options.seeds:
            found = levels_of(load_case(name, seed, options.snapshots))
            numbers = (found.high / found.low, found.spread, found.share, found.deviation)
            shown = " | ".join(f"{number:.2f}" for number in numbers)
            print(f"| {name} | {seed} | {shown} | {'yes' if found.are_two() else 'no'} |", flush=True)
    print(f"\nCommit {commit()}.")


if __name__ == "__main__":
    main()
