"""The pictures: surfaces, held-out views, projections, slices, likely matter."""

from __future__ import annotations

import math
from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ..frames import evenly
from ..geometry import Grid
from ..units import in_percent, length_unit, plain, wavenumber
from ..volume import Volume
from ..workflows.matter_map import MatterMap
from .content import DELTA, HeldOutViews, ProjectedMaps, Quantity, pixel_of
from .style import (
    BETA_MAP,
    DELTA_MAP,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    SIGNED_MAP,
    TRUE_SURFACE,
    WIDTH,
    Block,
    PanelGrid,
    around_zero,
    decimal_scale,
    drawn_block,
    grey_limits,
    image_panel,
    largest,
    letter,
    scale_bar,
    scientific,
    styled,
)
from .surface import Deviation, box_edges, camera, render_surface

PLANES = (("xy", 0, ("x", "y")), ("xz", 1, ("x", "z")), ("zy", 2, ("z", "y")))
"""Orthogonal planes: name, the axis of [Z, Y, X] that is fixed, and what runs along columns and rows."""


@styled
def scene_figure(reconstruction: Volume, truth: Volume | None, material: float) -> Figure:
    """Surfaces at half of the `material`'s δ: truth, reconstruction, and its distance from the truth.

    Without truth: the reconstruction seen from two sides, a quarter turn apart.
    """
    found, turned = (reconstruction, to_rgb(RECONSTRUCTION)), camera(120.0)
    if truth is None:
        shown = [(*found, camera(), "Reconstruction"), (*found, turned, "Turned by 90°")]
        panels = PanelGrid(1, [1.0, 1.0], [1.12, 1.12], (), 0.8 * WIDTH)
    else:
        colours = matplotlib.colormaps[SIGNED_MAP]
        paint = Deviation(
            truth.delta, (0.5 * material), max(truth.grid.voxel_size), lambda d: colours(0.5 + 0.5 * d)[:, :3]
        )
        shown = [
            (truth, to_rgb(TRUE_SURFACE), camera(), "Truth"),
            (*found, camera(), "Reconstruction"),
            (reconstruction, paint, camera(), "Distance from the true surface"),
        ]
        panels = PanelGrid(1, [1.0] * 3, [1.12] * 3, ())
    for i, (volume, colour, rotation, title) in enumerate(shown):
        axes = panels.axes[0][i]
        picture = render_surface(volume.delta, volume.grid, 0.5 * material, rotation, 512, colour)
        half = 0.5 * picture.width
        axes.imshow(
            picture.rgba, extent=(-half, half, half, -half), zorder=2, interpolation="antialiased", aspect="auto"
        )
        axes.set_axis_off()
        for points in box_edges(volume.grid, picture.rotation):
            axes.plot(points[:, 0], points[:, 1], lw=0.5, color=INK, alpha=0.4, zorder=1)
        axes.set(xlim=(-half, half), ylim=(1.24 * half, -half))  # room for the scale bar below the box
        scale_bar(axes, 2 * half, INK, 0.03)
        letter(axes, i, title)
    if truth is not None:
        _deviation_bar(panels.figure, panels.axes[0][2], max(truth.grid.voxel_size))
    return panels.figure


def _deviation_bar(figure: Figure, axes: Axes, limit: float) -> None:
    unit, factor = length_unit(limit)
    end = limit * factor
    inset = axes.inset_axes((0.53, 0.028, 0.40, 0.024))
    scale = ScalarMappable(Normalize(-end, end), SIGNED_MAP)
    bar = figure.colorbar(scale, cax=inset, orientation="horizontal", ticks=[-end, 0, end])
    bar.outline.set_linewidth(0.4)  # type: ignore[operator]
    inset.xaxis.set_ticks_position("top")
    inset.set_xticklabels([f"−{end:.3g}", "0", f"{end:.3g} {unit}"])
    inset.tick_params(length=2, width=0.4, pad=1.5)


@styled
def held_out_figure(views: HeldOutViews, pixel_size: float, most: int = 4) -> Figure:
    """Measured, predicted and residual intensity of up to `most` test views; pixel_size [m]."""
    chosen = evenly(len(views.labels), most).tolist()
    low, high = grey_limits(views.measured)
    limit = largest(views.predicted - views.measured)
    scale, power = decimal_scale(limit)
    height, width = views.measured.shape[1:]
    panels = PanelGrid(len(chosen), [width] * 3, [height] * 3, (1, 2))
    for row, k in enumerate(chosen):
        axes, pixel = panels.axes[row], pixel_of(views, k, pixel_size)
        pitch = (pixel, pixel)
        grey = image_panel(axes[0], views.measured[k], pitch, HOLOGRAM_MAP, (low, high))
        image_panel(axes[1], views.predicted[k], pitch, HOLOGRAM_MAP, (low, high))
        residual = (views.predicted[k] - views.measured[k]) / scale
        signed = image_panel(axes[2], residual, pitch, SIGNED_MAP, (-limit / scale, limit / scale))
        scores = f"SSIM {views.scores.ssim[k]:.3f}, FRCM {views.scores.frcm[k]:.3f}"
        for i, title in enumerate((f"Measured, {views.labels[k]}", f"Predicted ({scores})", "Predicted − measured")):
            letter(axes[i], 3 * row + i, title)
        scale_bar(axes[0], width * pixel)
    panels.bar(grey, 1, (0, len(chosen) - 1), "intensity relative to the flat field", "both")
    panels.bar(signed, 2, (0, len(chosen) - 1), f"difference of intensity{f' ({power})' if power else ''}", "both")
    return panels.figure


@styled
def projections_figure(maps: ProjectedMaps, energy_kev: float, pixel_size: float, with_phase: bool = True) -> Figure:
    """Phase φ = -kD [rad] and absorption 2kB of one or two views; truth and difference too where it is known.

    energy_kev [keV]; pixel_size [m]; with_phase: False where D is not known.
    """
    k, views = wavenumber(energy_kev), min(len(maps.labels), 2)
    height, width = maps.projected_delta.shape[1:]
    shown_of_each = (True, False) if with_phase else (False,)
    pairs, count = [(phase, i) for i in range(views) for phase in shown_of_each], len(shown_of_each)
    if maps.true_projected_delta is None or maps.true_projected_beta is None:
        bars = tuple(range(count))
        panels = PanelGrid(views, [width] * count, [height] * count, bars, (0.8 if count > 1 else 0.5) * WIDTH)
        for index, (phase, i) in enumerate(pairs):
            found = -k * maps.projected_delta[i] if phase else 2 * k * maps.projected_beta[i]
            _projected(panels, divmod(index, count), [found], phase, maps.labels[i], pixel_of(maps, i, pixel_size))
        return panels.figure
    panels = PanelGrid(len(pairs), [width] * 3, [height] * 3, (1, 2))
    for row, (phase, i) in enumerate(pairs):
        factor, true, found = (
            (-k, maps.true_projected_delta, maps.projected_delta)
            if phase
            else (2 * k, maps.true_projected_beta, maps.projected_beta)
        )
        shown = [factor * np.asarray(true[i]), factor * np.asarray(found[i])]
        _projected(panels, (row, 0), shown, phase, maps.labels[i], pixel_of(maps, i, pixel_size))
    return panels.figure


def _projected(
    panels: PanelGrid,
    place: tuple[int, int],
    shown: list[np.ndarray],
    phase: bool,
    view: str,
    pixel_size: float,
) -> None:
    """One quantity of one view from `place` on: [found], or [true, found] on one scale and the difference."""
    row, column = place
    colours = DELTA_MAP if phase else BETA_MAP
    axes = panels.axes[row][column:]
    name, unit = ("phase φ", " (rad)") if phase else ("absorption 2kB", "")
    scale, power = (1.0, "") if phase else decimal_scale(max(float(np.abs(i).max()) for i in shown))
    unit = f" ({power})" if power else unit
    pitch = (pixel_size, pixel_size)
    colours, limits = around_zero(colours, value_limits([image / scale for image in shown]))
    for panel, image in zip(axes, shown):
        drawn = image_panel(panel, image / scale, pitch, colours, limits)
    panels.bar(drawn, column + len(shown) - 1, (row, row), name + unit)
    scale_bar(axes[0], shown[0].shape[1] * pixel_size)
    title = name[0].upper() + name[1:]
    titles = [f"{title}, {view}"] if len(shown) == 1 else [f"{title}, truth, {view}", "Reconstruction", "Difference"]
    for i, text in enumerate(titles):
        letter(axes[i], row * len(panels.axes[row]) + column + i, text)
    if len(shown) == 2:
        difference = (shown[1] - shown[0]) / scale
        limit = largest(difference)
        signed = image_panel(axes[2], difference, pitch, SIGNED_MAP, (-limit, limit))
        panels.bar(signed, 2, (row, row), "difference" + unit, "both")


def value_limits(images: list[np.ndarray]) -> tuple[float, float]:
    """A colour range that holds all images and zero, so that empty space has the map's end colour."""
    low, high = min(float(i.min()) for i in images), max(float(i.max()) for i in images)
    low, high = min(low, 0.0), max(high, 0.0)
    return (low, high) if high > low else (low, low + 1.0)


@styled
def slices_figure(
    reconstruction: Volume,
    truth: Volume | None,
    positions: tuple[int, int, int],
    quantity: Quantity = DELTA,
    names: tuple[str, str] = ("Truth", "Reconstruction"),
    seen: np.ndarray | None = None,
) -> Figure:
    """δ, or µ, in three orthogonal planes at voxel `positions` (z, y, x): truth,
    reconstruction and difference; names: of these two. seen: voxels [Z, Y, X] bool that a dashed line encloses."""
    volumes = [(name, v.delta) for name, v in zip(names, (truth, reconstruction)) if v is not None]
    scale, power = decimal_scale(quantity.factor * max(float(np.abs(v).max()) for _, v in volumes))
    scale /= quantity.factor
    colours, limits = around_zero(DELTA_MAP, value_limits([v / scale for _, v in volumes]))
    widths, heights = plane_sizes(reconstruction.grid)
    panels = PanelGrid(1 if truth is None else 3, widths, heights, (2,))
    for row, (name, values) in enumerate(volumes):
        drawn = slice_row(panels.axes[row], values / scale, reconstruction.grid, positions, colours, limits, seen)
        slice_titles(panels.axes[row], 3 * row, name, reconstruction.grid, positions)
    label = quantity.label(power)
    panels.bar(drawn, 2, (0, len(volumes) - 1), label)
    if truth is not None:
        difference = (reconstruction.delta - truth.delta) / scale
        limit = largest(difference, 99.9)
        drawn = slice_row(panels.axes[2], difference, truth.grid, positions, SIGNED_MAP, (-limit, limit), seen)
        slice_titles(panels.axes[2], 6, "Difference", truth.grid, positions)
        panels.bar(drawn, 2, (2, 2), f"difference of {label}", "both")
    return panels.figure


LIKELY = {0.1: "dotted", 0.5: "solid", 0.9: "dashed"}
"""Probabilities of matter that contours are drawn at, with their styles."""


@styled
def matter_figure(found: MatterMap) -> Figure:
    """The probability that a voxel is matter, in the three planes with most of it, with contours at `LIKELY`."""
    values, grid = found.values, found.found.grid
    planes = richest_planes(Volume(values, values, grid))
    panels = PanelGrid(1, *plane_sizes(grid), (2,))
    drawn = slice_row(panels.axes[0], values, grid, planes, DELTA_MAP, (0.0, 1.0), values, levels=LIKELY)
    slice_titles(panels.axes[0], 0, "Matter", grid, planes)
    panels.bar(drawn, 2, (0, 0), "probability of matter")
    return panels.figure


def matter_block(found: MatterMap) -> Block:
    """The figure with its caption."""
    values = found.values.astype(np.float64)
    cell = math.prod(found.found.grid.voxel_size)
    unsure = float(((values > min(LIKELY)) & (values < max(LIKELY))).sum())
    text = (
        "The probability that a voxel is matter, by how often voxels of its value were matter in the rehearsals, in "
        "the planes with most of it. Contours: dotted, 10 %; solid, 50 %; dashed, 90 %. "
        f"Expected are {scientific(values.sum() * cell)} m³ of matter; {in_percent(unsure / values.size)} of the "
        f"volume lies between 10 % and 90 %. The Dice coefficient expected of what exceeds half of the "
        f"material's value is {found.expected_dice:.2f}."
    )
    return drawn_block("Where matter is", text, "The probability of matter.", matter_figure(found))


def richest_planes(volume: Volume) -> tuple[int, int, int]:
    """Voxel positions (z, y, x) of the planes with the most matter (largest Σ|δ|)."""
    mass = np.abs(volume.delta)
    z, y, x = (int(np.argmax(mass.sum(axis=axes, dtype=np.float64))) for axes in ((1, 2), (0, 2), (0, 1)))
    return z, y, x


def _slice(values: np.ndarray, axis: int, index: int) -> np.ndarray:
    plane = np.take(values, index, axis=axis)
    return plane.T if axis == 2 else plane  # [Z, Y] is shown with z along columns and y down


def plane_sizes(grid: Grid) -> tuple[list[float], list[float]]:
    """Widths and heights [m] of the three planes of `slice_row`."""
    x, y, z = (n * d for n, d in zip(grid.shape[::-1], grid.voxel_size))
    return [x, x, z], [y, z, y]


def slice_row(
    axes: list[Axes],
    values: np.ndarray,
    grid: Grid,
    positions: tuple[int, int, int],
    colours: str,
    limits: tuple[float, float],
    seen: np.ndarray | None = None,
    *,
    levels: Mapping[float, str] = {0.5: "dashed"},
) -> AxesImage:
    """Draw the three orthogonal planes of `values` [Z, Y, X] at voxel `positions` (z, y, x), and contours of `seen`
    [Z, Y, X], bool or numbers, at `levels`, each with the style of its line."""
    edge = dict(zip("xyz", grid.voxel_size))
    widths, _ = plane_sizes(grid)
    for panel, (_, axis, (across, down)), width in zip(axes, PLANES, widths):
        plane = _slice(values, axis, positions[axis])
        drawn = image_panel(panel, plane, (edge[across], edge[down]), colours, limits)
        ink = "white" if colours != SIGNED_MAP else "black"
        scale_bar(panel, width, ink)
        if seen is None:
            continue
        inside = np.pad(_slice(seen, axis, positions[axis]), 1, mode="edge")  # contours want two rows
        if drawn_at := [level for level in sorted(levels) if inside.min() < level < inside.max()]:
            i, j = ((np.arange(n) - 0.5) * edge[name] for n, name in zip(inside.shape, (down, across)))
            panel.autoscale(False)
            styles = [levels[level] for level in drawn_at]
            panel.contour(j, i, inside, levels=drawn_at, colors=ink, linewidths=0.7, linestyles=styles)
    return drawn


def slice_titles(axes: list[Axes], first: int, name: str, grid: Grid, positions: tuple[int, int, int]) -> None:
    """Letters from number `first` on, and where each plane lies."""
    centres = grid.axes()[::-1]
    unit, factor = length_unit(max(n * d for n, d in zip(grid.shape[::-1], grid.voxel_size)))
    for i, (panel, (plane, axis, _)) in enumerate(zip(axes, PLANES)):
        where = centres[axis][positions[axis]] * factor
        fixed = "zyx"[axis]
        letter(panel, first + i, f"{name}, {plane} at {fixed} = {plain(where, 4)} {unit}".replace("-", "−"))
