"""First poses of a phantom: its place by centres of mass, its turn by trial, and beads by their shape in a volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..baselines import TOMOGRAPHIES
from ..checks import require
from ..geometry import Grid, Views
from ..projectors.surface import surface_occupancy
from .coarse import centres_of_mass, shifts_by_mass
from .derivatives import in_pixels
from .phantom import Phantom

TRIALS = 600
"""Turns that are tried: random ones are within 25° of any, or nearly so."""
CHOSEN = 6
"""The best of them, which are improved."""
SMALLEST = 0.7
"""Degrees by which the turn is improved in the end; least squares does the rest."""
SEEN, LEAST = 0.5, 0.15
"""Share of what the fullest bead holds that another must hold, for all are of one size, and of a ball's volume."""
APART = 1.5
"""Least distance of two beads' centres [radii]; beads that touch have two."""


def placed(phantom: Phantom, thickness: np.ndarray, views: Views) -> tuple[Phantom, np.ndarray]:
    """The phantom where its shadows are, and the shifts [V, 2] [pixels] of the views beside `views`.

    thickness: [V, H, W] of the phantom's matter [m]; all of it lies in every field.
    """
    shifts = shifts_by_mass(thickness, views)
    seen = centres_of_mass(thickness) + views.shifts / views.pixel_size + shifts
    point = np.linalg.lstsq(views.rotations[:, :2].reshape(-1, 3), seen.reshape(-1), rcond=1e-9)[0]
    there = replace(views, shifts=views.shifts + shifts * views.pixel_size)
    turn = best_turn(phantom, thickness / views.pixel_size, in_pixels(there), point, views.pixel_size)
    return phantom.moved(turn, point * views.pixel_size), shifts


def best_turn(phantom: Phantom, lines: np.ndarray, views: Views, point: np.ndarray, pixel: float) -> np.ndarray:
    """The turn [3, 3] of a rigid phantom about its centre, `point` [pixels], that fits `lines` [V, H, W] best."""
    points, weights = inside(phantom, pixel)
    target = np.stack([gaussian_filter(image, 1.0) for image in lines])

    def misfit(turn: np.ndarray) -> float:
        images = shadows_of(points @ turn.T + point, weights, views)
        return float(np.square(target - images).sum())

    trials = [np.eye(3), *Rotation.random(TRIALS, rng=np.random.default_rng(0)).as_matrix()]
    values = [misfit(turn) for turn in trials]
    found = [_improved(misfit, trials[k], values[k]) for k in np.argsort(values)[:CHOSEN]]
    return min(found, key=lambda pair: pair[1])[0]


def inside(phantom: Phantom, pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] in a rigid phantom about its centre [pixels], and the volumes [P] that they stand for."""
    mesh = phantom.shapes[0]
    low, high = mesh.bounds
    shape = tuple(int(np.ceil(n)) for n in ((high - low) / pixel + 2)[::-1])
    vertices = torch.from_numpy((mesh.vertices - low) / pixel + 0.5)
    occupancy = surface_occupancy(vertices, torch.from_numpy(mesh.faces), (shape[0], shape[1], shape[2])).numpy()
    z, y, x = np.nonzero(occupancy)
    return np.stack([x, y, z], axis=1) - 0.5 + low / pixel, occupancy[z, y, x]


def shadows_of(points: np.ndarray, weights: np.ndarray, views: Views) -> np.ndarray:
    """Blurred projections [V, H, W] of points [P, 3] with volumes [P]; lengths in pixels."""
    h, w = views.shape
    images = np.empty((len(views), h, w))
    for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
        x, y = (points @ rotation[:2].T - shift + 0.5 * np.array([w - 1, h - 1])).T
        column, row = np.floor(x).astype(int), np.floor(y).astype(int)
        image = np.zeros(h * w)
        for j, i in ((0, 0), (1, 0), (0, 1), (1, 1)):
            near = np.abs(1 - j - (x - column)) * np.abs(1 - i - (y - row))
            at_x, at_y = column + j, row + i
            kept = (at_x >= 0) & (at_x < w) & (at_y >= 0) & (at_y < h)
            image += np.bincount(at_y[kept] * w + at_x[kept], (weights * near)[kept], h * w)
        images[v] = gaussian_filter(image.reshape(h, w), 1.0)
    return images


def _improved(misfit: Callable[[np.ndarray], float], turn: np.ndarray, value: float) -> tuple[np.ndarray, float]:
    """A turn [3, 3] near `turn` and its misfit: steps about six axes, each half as long once none is better."""
    degrees = 12.0
    while degrees > SMALLEST:
        steps = Rotation.from_rotvec(degrees * np.concatenate([np.eye(3), -np.eye(3)]), degrees=True).as_matrix()
        tried = steps @ turn
        values = [misfit(each) for each in tried]
        best = int(np.argmin(values))
        if values[best] < value:
            turn, value = tried[best], values[best]
        else:
            degrees /= 2
    return turn, value


def find_beads(thickness: Tensor, views: Views, radius: float) -> np.ndarray:
    """Centres [N, 3] [m] of balls of `radius` [m] in the volume of total-variation tomography of `thickness` [m].

    A centre is where a ball holds more of the occupancy than anywhere within `APART` radii, and enough (`SEEN`).
    Errors: `InputError` where there is none, and for balls of less than a pixel.
    """
    from scipy.signal import fftconvolve  # which imports all of scipy.stats

    pixel = views.pixel_size
    reach = radius / pixel
    require(reach >= 1, f"beads must have a radius of a pixel at least, but --beads is {reach:.2g} pixels; correct it.")
    grid = Grid.of_views(views)
    values = TOMOGRAPHIES["tv"](thickness, views, grid, 1.0, lambda fraction: None).numpy().astype(np.float64)
    ball = np.clip(reach + 0.5 - _distances(reach), 0, 1)
    held = fftconvolve(values, ball / ball.sum(), mode="same")
    tops = np.argwhere((held == maximum_filter(held, 3)) & (held > max(LEAST, SEEN * held.max())))
    peaks = np.zeros((0, 3))
    for top in tops[np.argsort(-held[tuple(tops.T)])]:  # the fullest first
        if np.all(np.linalg.norm(peaks - top, axis=1) > APART * reach):
            peaks = np.vstack([peaks, top])
    require(len(peaks) > 0, "the frames show no bead of this radius; check --beads, the material and the pixel size.")
    return np.array(grid.origin) + peaks[:, ::-1] * pixel


def _distances(reach: float) -> np.ndarray:
    """Distances [n, n, n] from the middle of a cube of voxels that reaches so far [voxels]."""
    squares = np.square(np.arange(-np.ceil(reach), np.ceil(reach) + 1.0))
    return np.sqrt(squares[:, None, None] + squares[:, None] + squares)
