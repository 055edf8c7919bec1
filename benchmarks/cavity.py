"""Are hollow shells hollow? Mean δ in their cavities as a share of that in their walls, by the defaults.

    python benchmarks/cavity.py                       # case shells8 of the suite, seeds 101 and 102, a minute a seed

Prints a Markdown table. A cavity is what the true walls enclose; voxels that a wall fills in part count as neither.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit
from scipy.ndimage import binary_erosion, binary_fill_holes

import holosplat as hs
from holosplat_bench.suite.case import load_case


def main() -> None:
    """Print the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", default="shells8")
    parser.add_argument("--seeds", nargs="+", type=int, default=[101, 102])
    options = parser.parse_args()
    print("| seed | δ in the walls, of the true one | δ in the cavities, of that in the walls |\n| --- | --- | --- |")
    for seed in options.seeds:
        case = load_case(options.case, seed)
        truth = case.truth()
        matter = truth.delta > 0
        wall = truth.delta > 0.999 * truth.delta.max()
        cavity = binary_erosion(binary_fill_holes(matter) & ~matter)
        found = hs.reconstruct(case.scan(), case.prior, hs.preset("default")).object.voxelise(truth.grid).delta
        level = found[wall].mean()
        print(f"| {seed} | {level / truth.delta[wall].mean():.3f} | {found[cavity].mean() / level:.4f} |", flush=True)
    print(f"\nCommit {commit()}.")


if __name__ == "__main__":
    main()
