"""The pictures of README and docs, after `holosplat demo --out demo`: `python docs/figures.py hero demo`."""

from __future__ import annotations

from pathlib import Path

import holosplat as hs
from holosplat.report import hero_figure


def main(demo: Path) -> None:
    """Draw docs/images/hero.png from the folder that `holosplat demo` made."""
    scan, truth = hs.io.read_scan(demo / "scan.nxs"), hs.io.read_volume(demo / "truth.h5")
    found = hs.load_reconstruction(hs.RunFolder(demo / "run")).object
    held_out = scan.test()
    figure = hero_figure(
        held_out.frames[0], scan.views.pixel_size, found.voxelise(truth.grid), truth=truth, material=found.matter.delta
    )
    images = Path(__file__).parents[1] / "images"
    images.mkdir(exist_ok=True)
    figure.savefig(images / "hero.png", dpi=160)
