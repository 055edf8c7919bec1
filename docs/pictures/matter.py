"""The pictures of docs/howto/which_matter.md: `python docs/figures.py matter` takes a minute.

A frame and a slice of the true δ of each kind, as benchmarks/matter_scenes.py draws it with seed 1.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from tables.runs import script

import holosplat as hs
from holosplat_bench.specimens.matter import MATTER

IMAGES = Path(__file__).parents[1] / "images" / "matter"
SEED, DPI, PHOTONS = 1, 72, 3000.0
SHOWN = ("bubbles", "cells", "keyhole")
"""Parts through which the slice goes, where a kind has them."""


def picture(name: str) -> None:
    """Write the picture of a kind."""
    drawn, exposures = script("matter_scenes").planned(name, "small", SEED)[2:]
    truth = drawn.scene.voxelise(hs.Grid.of_views(exposures.views))
    scan = hs.simulate(drawn.scene, exposures[[0]], photons_per_pixel=PHOTONS, is_test=np.zeros(1, dtype=bool))
    named = next((part for part in SHOWN if part in drawn.regions), next(iter(drawn.regions)))
    middle = int(drawn.regions[named].voxelise(truth.grid).delta.sum(axis=(1, 2)).argmax())
    figure, (left, right) = plt.subplots(1, 2, figsize=(4.2, 2.1))
    left.imshow(scan.frames[0], cmap="gray", vmin=0.6, vmax=1.5)
    right.imshow(1e6 * truth.delta[middle], cmap="gray")
    for axes, title in ((left, "frame"), (right, "slice of the true δ")):
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
    figure.tight_layout(pad=0.8)
    figure.savefig(IMAGES / f"{name}.png", dpi=DPI, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    """Write the pictures of all kinds."""
    IMAGES.mkdir(exist_ok=True)
    for name in MATTER:
        picture(name)
