"""The pictures of README and docs, after `holosplat demo --out demo`: `python docs/figures.py hero demo`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

import holosplat as hs
from holosplat.metrics import robust_material_delta
from holosplat.report.figures import richest_planes, slice_row, value_limits
from holosplat.report.style import (
    DELTA_MAP,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    around_zero,
    colour_bar,
    decimal_scale,
    image_panel,
    letter,
    new_figure,
    scale_bar,
    styled,
)
from holosplat.report.surface import SurfaceImage, camera, render_surface
from holosplat.volume import Volume


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


@styled
def hero_figure(
    hologram: np.ndarray,
    pixel_size: float,
    reconstruction: Volume,
    truth: Volume | None = None,
    material: float | None = None,
) -> Figure:
    """The banner, 1600 × 500 pixels: a hologram [H, W] of `pixel_size` [m], the surface, and slices of δ.

    material: the material's δ, whose half is the surface; None: its robust value. The slices are the xy and
    xz planes that hold most matter: the truth above, the reconstruction below.
    """
    figure, grid = new_figure(10.0, 3.125, "none"), reconstruction.grid
    material = robust_material_delta(truth or reconstruction) if material is None else material

    def place(left: float, bottom: float, width: float, height: float) -> Axes:  # [inches]
        return figure.add_axes((left / 10.0, bottom / 3.125, width / 10.0, height / 3.125))

    first, second = place(0.05, 0.05, 2.8, 2.8), place(2.95, 0.05, 3.5, 2.8)
    low, high = np.percentile(hologram, [0.2, 99.8])
    image_panel(first, hologram, (pixel_size, pixel_size), HOLOGRAM_MAP, (float(low), float(high)))
    scale_bar(first, hologram.shape[1] * pixel_size)
    letter(first, 0, "Hologram")
    picture = render_surface(reconstruction.delta, grid, 0.5 * material, camera(), 800, to_rgb(RECONSTRUCTION))
    _close_surface(second, picture)
    letter(second, 1, "Reconstruction")
    drawn = _banner_slices(place, reconstruction, truth, material)
    _, power = decimal_scale(material)
    colour_bar(figure, drawn, place(9.47, 0.12, 0.085, 2.66), f"δ ({power})" if power else "δ")
    return figure


def _banner_slices(
    place: Callable[[float, float, float, float], Axes],
    reconstruction: Volume,
    truth: Volume | None,
    material: float,
) -> AxesImage:
    grid, planes = reconstruction.grid, richest_planes(truth or reconstruction)
    scale, _ = decimal_scale(material)
    shown = [v.delta / scale for v in (reconstruction, truth) if v is not None]
    colours, limits = around_zero(DELTA_MAP, value_limits(shown))
    if truth is None:
        panels = [place(6.6, 0.05, 2.8, 2.8)]
        letter(panels[0], 2, "Slice of δ")
        return slice_row(panels, reconstruction.delta / scale, grid, planes, colours, limits)
    for i, (name, volume) in enumerate((("truth", truth), ("reconstruction", reconstruction))):
        panels = [place(left, 1.56 - 1.51 * i, 1.29, 1.29) for left in (6.72, 8.11)]
        drawn = slice_row(panels, volume.delta / scale, grid, planes, colours, limits)
        letter(panels[0], 2 + i, f"Slices of δ, {name}")
    return drawn


def _close_surface(axes: Axes, shown: SurfaceImage) -> None:
    """The picture without its box, no wider than the matter needs."""
    half = 0.5 * shown.width
    axes.imshow(shown.rgba, extent=(-half, half, half, -half), zorder=2, interpolation="antialiased", aspect="auto")
    axes.set_axis_off()
    rows, columns = np.nonzero(shown.rgba[..., 3])
    box = axes.get_window_extent()
    ratio = box.width / box.height
    x, y = (0.5 * (i.min() + i.max() + 1) * shown.pixel_size - 0.5 * shown.width for i in (columns, rows))
    half = 0.53 * max(np.ptp(columns) / ratio, np.ptp(rows)) * shown.pixel_size
    axes.set(xlim=(x - half * ratio, x + half * ratio), ylim=(y + half, y - half))
    scale_bar(axes, 2 * half * ratio, INK, 0.03)
