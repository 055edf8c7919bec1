"""The picture of docs/surfaces.md: `python docs/figures.py surfaces RUN TRUTH`.

RUN: run folder of the case main4, seed 101; TRUTH: its true volume (`benchmarks/surfaces.py --runs` keeps both).
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import holosplat as hs
from holosplat.report.style import SIGNED_MAP
from holosplat.report.surface import Deviation, render_surface

from .drawing import in_few_colours


def main(run: Path, truth: Path) -> None:
    """Draw docs/images/surfaces.png: the truth, and how far Gaussians and surfaces lie from it."""
    true, folder = hs.io.read_volume(truth), hs.RunFolder(run)
    cloud = hs.load_reconstruction(folder).object
    found = hs.methods.refine_surfaces(cloud, hs.io.read_scan(folder.source_scan()))
    level, limit = 0.5 * cloud.matter.delta, 0.5 * max(true.grid.voxel_size)
    colours = matplotlib.colormaps[SIGNED_MAP]
    paint = Deviation(true.delta, level, limit, lambda d: colours(0.5 + 0.5 * d)[:, :3])
    panels = (
        ("True surfaces", true, (0.62, 0.64, 0.68)),
        ("Gaussians, 4 views", cloud.voxelise(true.grid), paint),
        ("Surfaces fitted from them", found.voxelise(true.grid), paint),
    )
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.5), layout="constrained")
    for panel, (title, volume, colour) in zip(axes, panels):
        shown = render_surface(volume.delta, volume.grid, level, size=420, colour=colour).rgba
        rows, columns = (np.flatnonzero(shown[..., 3].any(axis=axis)) for axis in (1, 0))
        panel.imshow(shown[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
        panel.set_title(title, fontsize=10)
        panel.set_axis_off()
    end = 1e6 * limit
    bar = figure.colorbar(ScalarMappable(Normalize(-end, end), SIGNED_MAP), ax=axes, shrink=0.7, pad=0.01)
    bar.set_label("outside the true surface by / µm", fontsize=9)
    target = Path(__file__).parents[1] / "images" / "surfaces.png"
    figure.savefig(target, dpi=110)
    in_few_colours(target, target, 160)
