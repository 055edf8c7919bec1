"""Families of methods in two, three and four views: rows of docs/data/few_families.csv.

    python benchmarks/few_families.py DATA [--methods tikhonov-tv onix …] [--views 2 3 4] [--scenes 5] [--write]

Flowing cells of another simulator, one time each, as in learned.py (`espresso`: 128 × 96 pixels of 0.5 µm, 20 keV, 10
cm, haemoglobin known, no noise), by methods of the benchmark with their options as they are. Scored against the true
volume and in two views that are held out. What `auto` makes of the same frames, with and without a learned start, is in
docs/data/learned.csv.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from learned import espresso
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.geometry import Grid
from holosplat_bench.suite.methods import METHODS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "few_families.csv"
TRIED = (
    "paganin-fbp",
    "paganin-tv",
    "tikhonov-tv",
    "holographic-tv",
    "pixelnerf",
    "onix",
    "neural-field",
    "alpha-3dgs",
)


@dataclass(frozen=True)
class Row:
    """scene: which time; dice, error: of occupancy and relative of δ; ssim, frcm: of two views that are held out."""

    scene: int
    views: int
    method: str
    dice: float
    error: float
    ssim: float
    frcm: float
    seconds: float
    machine: str
    commit: str


def row(data: Path, scene: int, views: int, method: str) -> Row:
    """What `method` makes of one time in so many views."""
    given = espresso(data, scene, views)
    began = time.perf_counter()
    options = METHODS[method].options
    result = hs.reconstruct(given.scan, given.prior, options, matter=options.kinds_of_matter[0])
    seconds = time.perf_counter() - began
    scored = hs.evaluate(result, given.scan, given.scene.voxelise(Grid.of_views(given.scan.views)))
    assert scored.volume is not None
    assert scored.test is not None
    volume, frames = scored.volume, scored.test.mean
    scores = (volume.dice, volume.relative_error_delta, frames["ssim"], frames["frcm"])
    return Row(scene, views, method, *scores, seconds, platform.machine(), commit())


def keep(found: Row) -> None:
    """Write `found` into the table, in place of an earlier row of the same scene, views and method."""
    new = {name: str(value) for name, value in asdict(found).items()}
    others = [each for each in read(PAGE) if any(each[n] != new[n] for n in ("scene", "views", "method"))]
    write([*others, new], PAGE)


def main() -> None:
    """Run what is asked for, and print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--methods", nargs="+", default=list(TRIED), choices=list(METHODS))
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4])
    parser.add_argument("--scenes", nargs="+", type=int, default=[5])
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for scene in options.scenes:
        for method in options.methods:
            for views in options.views:
                found = row(options.data, scene, views, method)
                print(found, flush=True)
                if options.write:
                    keep(found)


if __name__ == "__main__":
    main()
