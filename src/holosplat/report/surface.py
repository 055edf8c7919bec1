"""Shaded isosurfaces without a graphics card: orthographic first-hit ray marching in numpy; forecasts drawn so.

The camera follows the frames of docs/conventions.md: it is a view, `x_lab = R x_obj`, that looks along the
beam (+z_lab), with columns to the right and rows down. A surface seen with a hologram's rotation overlays it.

Empty space is crossed with the distance to the nearest voxel of matter (Hart 1996, sphere tracing); close to
matter the ray advances by half a voxel, and the hit is bisected on the trilinear field. Everything is
deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from ..checks import require, shaped
from ..geometry import Grid, rotation_y
from ..mesh import TriangleMesh, sums_of_areas, vector_areas
from .style import CYCLE, INK, WIDTH, Block, drawn_block, letter, new_figure, styled

STEP = 0.5  # voxels a ray advances near matter
KEY_LIGHT, FILL_LIGHT = (-0.55, -0.70, -0.60), (0.80, 0.10, -0.55)  # directions to the lights, lab frame


@dataclass(frozen=True)
class Deviation:
    """Colours a surface by its distance from a true one, measured along its own normals.

    true_values: [Z, Y, X] on the same grid, its surface at `level`; limit: distances beyond ± `limit` [m]
    saturate; colours: distance / limit in [-1, 1] [N] → RGB [N, 3], positive where the surface lies outside
    of the true one.
    """

    true_values: np.ndarray
    level: float
    limit: float
    colours: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SurfaceImage:
    """rgba: [S, S, 4] float32 in [0, 1], straight alpha; pixel_size: [m]; rotation: the camera, [3, 3]."""

    rgba: np.ndarray
    pixel_size: float
    rotation: np.ndarray

    @property
    def width(self) -> float:
        """Width of the square picture [m]."""
        return self.rgba.shape[1] * self.pixel_size


@dataclass(frozen=True)
class _Field:
    """The padded volume in units of the level; a point has the index `offset + per_metre * (x, y, z)`."""

    values: np.ndarray
    offset: np.ndarray
    per_metre: np.ndarray
    voxel: float

    def at(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Trilinear samples of `values` [Z, Y, X] at object points [3, N] (x, y, z) [m]; 0 outside."""
        index = self.offset[:, None] + self.per_metre[:, None] * points
        return map_coordinates(values, index[::-1], order=1, mode="constant", cval=0.0, prefilter=False)


def camera(azimuth_deg: float = 30.0, elevation_deg: float = 25.0) -> np.ndarray:
    """Camera rotation [3, 3]: turn the object about y by `azimuth_deg`, look down by `elevation_deg`."""
    c, s = np.cos(np.deg2rad(elevation_deg)), np.sin(np.deg2rad(elevation_deg))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ rotation_y([azimuth_deg])[0]


def render_surface(
    values: np.ndarray,
    grid: Grid,
    level: float,
    rotation: np.ndarray | None = None,
    size: int = 512,
    colour: tuple[float, float, float] | Deviation = (0.75, 0.36, 0.25),
) -> SurfaceImage:
    """The shaded surface where `values` [Z, Y, X] cross `level`, `size` × `size` pixels of 2 × 2 rays each.

    level: in the unit of `values`, may be negative (then matter is below it); rotation: the camera [3, 3],
    default `camera()`; colour: RGB in [0, 1], or `Deviation`. The picture holds the whole grid; the ground is
    transparent. Raises `InputError` when the level is zero or shapes do not match.
    """
    require(level != 0 and np.isfinite(level), f"the surface level must be a number but 0; it is {level!r}.")
    shaped("surface values", values, grid.shape)
    rotation = camera() if rotation is None else np.asarray(rotation, dtype=np.float64)
    field = _field(np.asarray(values, dtype=np.float32) / np.float32(level), grid)
    half = np.abs(_corners(grid) @ rotation.T)[:, :2].max() * 1.02
    pixel = 2 * half / (2 * size)
    offsets = (np.arange(2 * size) + 0.5) * pixel - half
    x, y = (axis.ravel() for axis in np.meshgrid(offsets, offsets))
    found, depth = _first_hits(field, rotation, x, y, grid.centre)
    rgba = np.zeros((4 * size * size, 4), dtype=np.float32)
    if found.size:
        lab = np.stack([x[found], y[found], depth])
        points = rotation.T @ lab + grid.centre[:, None]
        rgba[found, :3] = _shade(field, points, lab[2] / half, rotation, colour)
        rgba[found, 3] = 1.0
    premultiplied = rgba.reshape(size, 2, size, 2, 4).mean(axis=(1, 3))
    return SurfaceImage(_straight(premultiplied), 2 * pixel, rotation)


def _straight(premultiplied: np.ndarray) -> np.ndarray:
    """Straight alpha whose transparent pixels take the colour around them, so that rims stay clean."""
    spread = gaussian_filter(premultiplied, (1.5, 1.5, 0), truncate=3.0)
    alpha, around = premultiplied[..., 3:], spread[..., 3:]
    inside = premultiplied[..., :3] / np.maximum(alpha, 1e-6)
    colour = np.where(alpha > 0, inside, spread[..., :3] / np.maximum(around, 1e-6))
    return np.clip(np.concatenate([colour, alpha], axis=-1), 0, 1)


def box_edges(grid: Grid, rotation: np.ndarray) -> list[np.ndarray]:
    """The grid's edges but the nearest corner's, which would hide matter: points [2, 2] of (x, y) [m]."""
    corners = _corners(grid) @ np.asarray(rotation).T
    nearest = int(np.argmin(corners[:, 2]))
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
    return [corners[[a, b], :2] for a, b in pairs if nearest not in (a, b)]


def _corners(grid: Grid) -> np.ndarray:
    """[8, 3] the grid's corners (x, y, z) [m] about its centre."""
    half = 0.5 * np.asarray(grid.shape[::-1]) * np.asarray(grid.voxel_size)
    return np.array(list(product((-1, 1), repeat=3))) * half


def _field(values: np.ndarray, grid: Grid) -> _Field:
    padded = np.pad(values, 1)  # closes surfaces that the grid's faces cut
    per_metre = 1.0 / np.asarray(grid.voxel_size)
    return _Field(padded, 1.0 - np.asarray(grid.origin) * per_metre, per_metre, min(grid.voxel_size))


def _first_hits(
    field: _Field, rotation: np.ndarray, x: np.ndarray, y: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the rays through (x, y) [m] that meet matter, and the depths [m] of their first hits."""
    matter = field.values > 1.0
    if not matter.any():
        return np.empty(0, dtype=np.intp), np.empty(0)
    distance = np.asarray(distance_transform_edt(~matter))  # in voxels; a cell with matter lies within √3
    start = rotation.T[:, :2] @ np.stack([x, y]) + centre[:, None]
    along = rotation.T[:, 2]
    low = (0.0 - field.offset) / field.per_metre
    high = (np.asarray(field.values.shape[::-1]) - 1.0 - field.offset) / field.per_metre
    slope = np.where(np.abs(along) < 1e-12, 1e-12, along)[:, None]
    a, b = (low[:, None] - start) / slope, (high[:, None] - start) / slope
    enter, leave = np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)
    active = np.flatnonzero(enter < leave)
    depth = enter.copy()
    hits = []
    while active.size:
        points = start[:, active] + along[:, None] * depth[active]
        index = np.rint(field.offset[:, None] + field.per_metre[:, None] * points).astype(np.intp)
        gap = distance[tuple(np.clip(i, 0, n - 1) for i, n in zip(index[::-1], distance.shape))]
        advance = np.where(gap > 3.2, gap - 2.6, STEP)  # 2.6 = √3 (a cell) + √3/2 (rounding to the voxel)
        near = np.flatnonzero(gap <= 3.2)
        inside = np.zeros(active.size, dtype=bool)
        inside[near] = field.at(field.values, points[:, near]) > 1.0
        hits.append(active[inside])
        depth[active[~inside]] += advance[~inside] * field.voxel
        active = active[~inside]
        active = active[depth[active] < leave[active]]
    found = np.sort(np.concatenate(hits))
    return found, _bisect(field, start[:, found], along, depth[found])


def _bisect(field: _Field, start: np.ndarray, along: np.ndarray, depth: np.ndarray) -> np.ndarray:
    low, high = depth - STEP * field.voxel, depth.copy()
    for _ in range(6):
        middle = 0.5 * (low + high)
        inside = field.at(field.values, start + along[:, None] * middle) > 1.0
        high, low = np.where(inside, middle, high), np.where(inside, low, middle)
    return high


def _shade(
    field: _Field,
    points: np.ndarray,
    depth: np.ndarray,
    rotation: np.ndarray,
    colour: tuple[float, float, float] | Deviation,
) -> np.ndarray:
    """RGB [N, 3] at object points [3, N]: two lights, ambient occlusion, a dark rim, a depth cue to white."""
    smooth = gaussian_filter(np.clip(field.values, 0, 2), 1.0)
    gradient = np.stack([field.at(np.gradient(smooth, axis=axis), points) for axis in (2, 1, 0)])
    normal = -rotation @ (gradient * field.per_metre[:, None])
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-30)
    facing = np.clip(-normal[2], 0, 1)
    crowd = gaussian_filter(np.clip(field.values - 0.5, 0, 1), 5.0)
    beside = points + (rotation.T @ normal) * (5.0 * field.voxel)
    open_sky = np.clip(1.25 - 1.6 * field.at(crowd, beside), 0.35, 1.0)
    key, fill = (np.clip(_unit(light) @ normal, 0, 1) for light in (KEY_LIGHT, FILL_LIGHT))
    halfway = np.clip(_unit(np.add(_unit(KEY_LIGHT), (0, 0, -1))) @ normal, 0, 1)
    light = (0.36 + 0.16 * fill) * open_sky + 0.62 * key * (0.4 + 0.6 * open_sky)
    light *= 1.0 - 0.45 * (1.0 - facing) ** 3
    if isinstance(colour, Deviation):
        base = colour.colours(_signed_distance(field, points, rotation.T @ normal, colour) / colour.limit)
    else:
        base = np.asarray(colour, dtype=np.float64)[None, :]
    shaded = base * light[:, None] + 0.10 * (halfway**30)[:, None]
    haze = np.clip(0.16 * (depth + 1.0), 0, 0.32)[:, None]
    return np.clip(shaded * (1 - haze) + haze, 0, 1)


def _signed_distance(field: _Field, points: np.ndarray, normal: np.ndarray, against: Deviation) -> np.ndarray:
    """Distance [N] [m] of points [3, N] outside (+) or inside (-) the true surface, along `normal` [3, N]."""
    offsets = np.linspace(-against.limit, against.limit, 17)
    true = np.pad(against.true_values / np.float32(against.level), 1)
    samples = np.stack([field.at(true, points + offset * normal) for offset in offsets]) - 1.0
    distance = np.where(samples[len(offsets) // 2] > 0, -against.limit, against.limit)
    nearest = np.full(distance.shape, np.inf)
    for (low, high), (a, b) in zip(pairwise(offsets), pairwise(samples)):
        crosses = (a > 0) != (b > 0)
        crossing = low + (high - low) * a / np.where(crosses, a - b, 1.0)
        better = crosses & (np.abs(crossing) < nearest)
        nearest = np.where(better, np.abs(crossing), nearest)
        distance = np.where(better, -crossing, distance)
    return distance


def _unit(vector: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


UNIT = 1e6
"""Pictures are drawn in micrometres."""


def body_colours(count: int) -> list[tuple[float, float, float]]:
    """A colour for each body: those of the palette, then lighter and darker ones of them, over and over."""
    made = []
    for k in range(count):
        base, turn = np.array(to_rgb(CYCLE[k % len(CYCLE)])), k // len(CYCLE) % 3
        mixed = base if turn == 0 else 0.5 * base + 0.5 if turn == 1 else 0.6 * base
        made.append((float(mixed[0]), float(mixed[1]), float(mixed[2])))
    return made


def paint_bodies(
    axes: Axes,
    meshes: Sequence[TriangleMesh],
    rotation: np.ndarray,
    shift: np.ndarray,
    colours: Sequence[tuple[float, float, float]],
) -> PolyCollection:
    """Draw `meshes` in `axes`, whose unit is the micrometre; rotation [3, 3], shift [2] [m]: of the view."""
    corners, paints, depths = [], [], []
    for mesh, colour in zip(meshes, colours):
        points = UNIT * (mesh.vertices @ np.asarray(rotation).T - np.array([*shift, 0.0]))
        seen_as = TriangleMesh(points, mesh.faces)
        normals = sums_of_areas(seen_as)[mesh.faces].mean(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        seen = vector_areas(seen_as)[:, 2] < 0
        corners.append(points[mesh.faces][seen])
        paints.append(_shaded(np.array(colour), normals[seen]))
        depths.append(corners[-1][:, :, 2].mean(1))
    order = np.argsort(-np.concatenate(depths))
    faces, paint = np.concatenate(corners)[order], np.concatenate(paints)[order]
    drawn = PolyCollection(list(faces[:, :, :2]), facecolors=paint, edgecolors=paint, linewidths=0.25)
    axes.add_collection(drawn, autolim=False)
    return drawn


def _shaded(colour: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """RGB [F, 3] of faces with unit `normals` [F, 3] in the lab frame: two lights, a gloss, a dark rim."""
    key, fill = _unit(KEY_LIGHT), _unit(FILL_LIGHT)
    halfway = _unit(key + [0.0, 0.0, -1.0])
    bright = 0.42 + 0.62 * np.clip(normals @ key, 0, 1) + 0.18 * np.clip(normals @ fill, 0, 1)
    bright *= 1 - 0.45 * (1 - np.clip(-normals[:, 2], 0, 1)) ** 3
    gloss = 0.12 * np.clip(normals @ halfway, 0, 1) ** 30
    return np.clip(colour * bright[:, None] + gloss[:, None], 0, 1)


BUSY = 16
"""Bodies beyond which the legend takes another column."""


@dataclass(frozen=True)
class ForecastShown:
    """A forecast, as data.

    - times: [N] s; band: [N, B] m, standard error of each body's surface along its normals, or [N, 1] of the places of
      matter along an axis, NaN where nothing tells it; of_bodies: which of the two
    - flow: what mechanics found of the flow, and what they cannot tell, in words
    - held_out: scores of frames that the run did not see, a row a time: time_s, ssim, and ssim_still, of bodies that
      stay where they were
    """

    times: np.ndarray
    band: np.ndarray
    held_out: Sequence[Mapping[str, float]] = ()
    flow: str = ""
    of_bodies: bool = True


def forecast_block(shown: ForecastShown) -> Block:
    """The figure with its caption; a sentence where nothing tells the error and no frames judge."""
    heading, told = "Forecast", bool(np.isfinite(shown.band).any())
    if not told and not shown.held_out:
        return Block(heading, "Errors were not estimated, and the scan has no frames of the forecast's times.")
    text = "Over the time of the scan. "
    of = (
        "each body's surface along its normals, root mean square over it"
        if shown.of_bodies
        else ("the places of matter along an axis, root mean square by mass")
    )
    text += (
        f"a, standard error of {of}, from fits to halves of the frames and from a forecast of the last known time. "
        if told
        else "a, errors were not estimated. "
    )
    text += (
        f"b, structural similarity of predicted frames with {len(shown.held_out)} that the run did not see, and of "
        f"frames of {'bodies that stay where they were' if shown.of_bodies else 'matter that stays as it was'}. "
        if shown.held_out
        else "b, the scan has no frames of these times."
    )
    text += f" Mechanics found of the {shown.flow}." if shown.flow else ""
    return drawn_block(heading, text.strip(), "The forecast's error and scores.", forecast_figure(shown))


@styled
def forecast_figure(shown: ForecastShown) -> Figure:
    """Errors of the bodies, and scores of the frames, over time."""
    figure = new_figure(WIDTH, 2.4)
    errors, scores = figure.subplots(1, 2)
    count = shown.band.shape[1]
    for k, colour in enumerate(body_colours(count)):
        errors.plot(1e6 * shown.times, 1e6 * shown.band[:, k], ".-", ms=3, color=colour, lw=1.0, label=str(k))
    errors.set(xlabel="time (µs)", ylabel="standard error (µm)")
    if np.isfinite(shown.band).any():
        errors.set_ylim(bottom=0)
    when = [1e6 * row["time_s"] for row in shown.held_out]
    for name, label, style in (("ssim", "forecast", "-"), ("ssim_still", "without change", ":")):
        scores.plot(when, [row[name] for row in shown.held_out], f".{style}", ms=4, color=INK, label=label)
    scores.set(xlabel="time (µs)", ylabel="SSIM of held-out frames", xlim=errors.get_xlim())
    if when:
        scores.legend(loc="lower left")
    for i, axes in enumerate((errors, scores)):
        letter(axes, i)
    if shown.of_bodies:
        handles, labels = errors.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside right center", title="body", ncols=-(-count // BUSY), handlelength=1.0,
            title_fontsize=6.5,
        )  # fmt: skip
    return figure
