"""What a run of the main case spends its time on, stage by stage: rows of docs/data/stages.csv.

    python benchmarks/stages.py --pixels 128 256 512 [--csv docs/data/stages.csv]

The scene of sizes.py, what `reconstruct` does by default, in one thread. A row is a stage as progress names it, with
its processor time until the next one is named, and its share of the whole: what a faster part could save at most.
"""

from __future__ import annotations

import argparse
import platform
import time
from pathlib import Path

import numpy as np
import rows
import torch
from machine import commit
from sizes import DIAMETER, FIELD, MATERIAL

import holosplat as hs


class Stages:
    """Processor time [s] by stage."""

    def __init__(self) -> None:
        self.taken, self._now, self._since = dict[str, float](), "before", time.process_time()

    def named(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        """Progress of a run: what has passed since the last call belongs to the stage that was named then."""
        now = time.process_time()
        self.taken[self._now] = self.taken.get(self._now, 0.0) + now - self._since
        self._now, self._since = stage, now


def measured(pixels: int, seed: int) -> list[dict[str, object]]:
    """Rows of one size."""
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(24, (FIELD,) * 3, seed, DIAMETER), MATERIAL)
    views = hs.Views.evenly_spaced(12, (pixels, pixels), FIELD / pixels)
    scan = hs.simulate(scene, hs.Exposures.of(views, 20.0, 0.1, 0.05), seed=seed, is_test=np.zeros(12, dtype=bool))
    stages = Stages()
    hs.reconstruct(scan, hs.MaterialPrior.known(MATERIAL), seed=seed, on_progress=stages.named)
    stages.named("after", 1.0, {})
    whole = sum(stages.taken.values())
    about = {"machine": platform.machine(), "commit": commit()}
    return [
        {"pixels": pixels, "seed": seed, "stage": stage, "seconds": f"{taken:.2f}", "share": f"{taken / whole:.3f}"}
        | about
        for stage, taken in stages.taken.items()
    ]


def main() -> None:
    """One size after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, nargs="+", default=[128, 256, 512])
    parser.add_argument("--seed", type=int, default=103)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for pixels in options.pixels:
        found = measured(pixels, options.seed)
        for row in found:
            print(" | ".join(str(value) for value in row.values()), flush=True)
        if options.csv:
            before = [row for row in rows.read(options.csv) if row["pixels"] != str(pixels)]
            rows.write([*before, *found], options.csv)


if __name__ == "__main__":
    main()
