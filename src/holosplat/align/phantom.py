"""Phantoms of a calibration: their shapes, first poses, and least squares of all parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..baselines import TOMOGRAPHIES
from ..bodies.rest_shape import centroid
from ..checks import positive, require
from ..geometry import Grid, Views
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh, joined
from ..model import Alignment, Instrument
from ..projectors.surface import surface_occupancy
from ..representations import SurfaceMesh
from ..scan import Exposures
from ..specimens.phantoms import unit_ball
from ..volume import LineIntegrals
from .derivatives import NUMBERS, Normal, Predicted, in_pixels, step
from .initial_geometry import centres_of_mass, shifts_by_mass

FINENESS = 3
"""Bisections of an icosahedron that stands for a bead: 1280 triangles, off a ball by 0.4 % of the radius."""


@dataclass(frozen=True)
class Phantom:
    """N bodies of known shape.

    shapes: [N] closed meshes [m], each about its own centre of mass; places: [N, 3] of these centres, object frame [m];
    turn: [3, 3] of all shapes about them; free: whether the places are unknown, beside a motion of all together.
    """

    shapes: tuple[TriangleMesh, ...]
    places: np.ndarray
    turn: np.ndarray
    free: bool

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh) -> Phantom:
        """A rigid body; where its file puts it does not matter."""
        sound = mesh.volume > 0
        require(sound, f"{mesh.name} must be a closed mesh wound outwards, but it encloses no volume; repair it.")
        centre = centroid(mesh)
        return cls((mesh.transformed(np.eye(3), -centre),), np.zeros((1, 3)), np.eye(3), False)

    @classmethod
    def of_beads(cls, places: np.ndarray, radius: float) -> Phantom:
        """Balls of `radius` [m] at `places` [N, 3] [m], as polyhedra of their volume."""
        vertices, faces = unit_ball(FINENESS)
        ball = TriangleMesh(positive("the beads' radius", radius, "metres") * vertices, faces, "bead")
        require(len(places) > 0, "a phantom of beads needs one bead at least; check --beads and the material.")
        return cls((ball,) * len(places), np.array(places, dtype=np.float64), np.eye(3), True)

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def unknowns(self) -> int:
        """Numbers of the bodies that are found beside those of the views."""
        return 3 * len(self) if self.free else 0

    def moved(self, turn: np.ndarray, by: np.ndarray) -> Phantom:
        """All of it turned [3, 3] about the origin and then moved [3] [m]."""
        return replace(self, places=self.places @ turn.T + by, turn=turn @ self.turn)

    def shifted(self, by: np.ndarray) -> Phantom:
        """The bodies moved by [N, 3] [m], each by itself."""
        return replace(self, places=self.places + by)

    def mesh(self, n: int) -> TriangleMesh:
        """Body `n` where it is [m]."""
        return self.shapes[n].transformed(self.turn, self.places[n])

    def surfaces(self, material: DeltaBeta, pixel: float, only: Sequence[int] | None = None) -> SurfaceMesh:
        """All bodies, or `only` some, filled with `material`, in units of `pixel` [m]."""
        whole = joined([self.mesh(n) for n in (range(len(self)) if only is None else only)])
        matter = Matter.one(material.delta, material.beta)
        return SurfaceMesh(torch.from_numpy(whole.vertices / pixel), torch.from_numpy(whole.faces), pixel, matter)


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


STEPS = (0.05, 0.05, 1e-3, 1e-3, 1e-3)
"""Small changes of shifts [pixels] and turns [rad] by which derivatives are taken."""
STRETCH = 5e-3
"""The same for the logarithms of the distance and of the pixel size."""
NUDGE = 0.05
"""The same for the place of a bead [pixels]."""


@dataclass(frozen=True)
class Linear:
    """Frames [V, H, W] of a phantom, and their derivatives: of_views [V, 8, H, W] by the `NUMBERS` of each view (zero
    by the magnification, for there is one of all), of_all [K, V, H, W] by the places of free bodies [pixels] and, last,
    the logarithm of the pixel size."""

    frames: Tensor
    of_views: Tensor
    of_all: Tensor


def linearised(phantom: Phantom, exposures: Exposures, material: DeltaBeta, oversample: int, pixel: bool) -> Linear:
    """The frames in `exposures` and their derivatives, by differences; pixel: whether that by its size is asked for."""
    instrument, pitch = Instrument(exposures, oversample), exposures.views.pixel_size
    matter, count = phantom.surfaces(material, pitch), len(exposures)
    lines = matter.project(instrument.poses)

    def seen(channels: Tensor, through: Instrument = instrument) -> Tensor:
        return through.frames(LineIntegrals(channels, lines.materials)).detach().double()

    here = seen(lines.channels)
    columns = []
    for k, change in enumerate(STEPS):
        name, width = ("shifts", 2) if k < 2 else ("turns", 3)
        changed = torch.zeros(count, width, dtype=torch.float64)
        changed[:, k if k < 2 else k - 2] = change
        poses = Alignment(**{name: changed}).poses(instrument.poses, pitch)
        columns.append((seen(matter.project(poses).channels) - here) / change)
    farther = Instrument(replace(exposures, distance=exposures.distance * math.exp(STRETCH)), oversample)
    columns += [(seen(lines.channels, farther) - here) / STRETCH, torch.zeros_like(here), here]
    others = []
    for n in range(len(phantom) if phantom.free else 0):
        before = phantom.surfaces(material, pitch, [n]).project(instrument.poses).channels
        for k in range(3):
            by = np.zeros((len(phantom), 3))
            by[n, k] = NUDGE * pitch
            after = phantom.shifted(by).surfaces(material, pitch, [n]).project(instrument.poses).channels
            others.append((seen(lines.channels + after - before) - here) / NUDGE)
    if pixel:
        views = replace(exposures.views, pitch=pitch * math.exp(STRETCH))
        views = replace(views, shifts=views.shifts * math.exp(STRETCH))
        larger = Instrument(replace(exposures, views=views), oversample)
        there = phantom.surfaces(material, views.pixel_size).project(larger.poses)
        others.append((larger.frames(there).detach().double() - here) / STRETCH)
    together = torch.stack(others) if others else torch.zeros(0, *here.shape, dtype=torch.float64)
    return Linear(here, torch.stack(columns, dim=1), together)


@dataclass(frozen=True)
class Solution:
    """of_views: [V, 8] and of_all: [K] after a step; covariances: [K + 8 V] squared, those of all first."""

    of_views: Tensor
    of_all: Tensor
    covariances: Tensor


def solved(
    measured: Tensor, found: Linear, numbers: tuple[Tensor, Tensor], expected: tuple[Tensor, Tensor], blur: float
) -> Solution:
    """One Gauss–Newton step of all numbers together, damped by what is expected of them.

    measured: [V, H, W], NaN in pixels without a value; numbers: of views [V, 8] and of all [K], now; expected: [8] and
    [K] standard deviations about zero, 0 for those that stay. The noise of a view is what it leaves unexplained after a
    Gaussian of `blur` [pixels].
    """
    views, count = len(measured), len(numbers[1])
    columns = torch.cat([found.of_all.transpose(0, 1), found.of_views], dim=1)
    of_each = Normal.of(measured.double(), Predicted(found.frames, columns), blur)
    size, own = count + len(NUMBERS) * views, torch.arange(len(NUMBERS))
    both = Normal(torch.zeros(1, size, size, dtype=torch.float64), torch.zeros(1, size, dtype=torch.float64))
    for v in range(views):
        at = torch.cat([torch.arange(count), count + len(NUMBERS) * v + own])
        both.information[0, at[:, None], at] += of_each.information[v]
        both.slope[0, at] += of_each.slope[v]
    flat = torch.cat([numbers[1], numbers[0].flatten()])
    moved = step(both, flat[None], torch.cat([expected[1], expected[0].repeat(views)]))
    after, whole = moved.numbers[0], moved.covariances[0]
    return Solution(after[count:].reshape(views, len(NUMBERS)), after[:count], whole)
