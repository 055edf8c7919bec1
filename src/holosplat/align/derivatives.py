"""How frames change with the pose of their view: exact derivatives of projections, carried through the wave optics; a
damped Gauss–Newton step by them; directions that frames do not determine; the changes of views as words and tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import interpolate

from ..baselines.rays import frames_of
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..model import Instrument
from ..optics.noise import left_of
from ..projectors.voxels import LatticeProjector
from ..scan import Exposures
from .row_sums import COUNT, FACTOR, RETRIEVED

NUMBERS = ("shift x", "shift y", "turn x", "turn y", "roll", "distance", "magnification", "flux")
"""What each view has: shifts [pixels], turns about the lab's axes [rad], and the logarithms of the distance and the
magnification over the planned ones, and of the flux."""
SMALL = (0.05, 0.05, 1e-3, 1e-3, 1e-3, 1e-3)
"""Steps along derivatives of line integrals by which those of frames are taken."""
STRETCH = 0.02
"""Share of the distance by which the derivative by its logarithm is taken."""


@dataclass(frozen=True)
class Predicted:
    """Frames [V, H, W] of a volume, and their derivatives [V, 8, H, W] by the numbers of `NUMBERS`."""

    frames: Tensor
    derivatives: Tensor


def predicted(
    volume: Tensor,
    grid: Grid,
    exposures: Exposures,
    material: DeltaBeta,
    oversample: int,
    magnified: bool = False,
) -> Predicted:
    """The frames of occupancies `volume` [Z, Y, X] on `grid` (lengths in pixels of the views' pitch) in `exposures`.

    Derivatives by the pose are those of `projections`, carried through the wave optics by small differences. A view
    that is magnified has smaller pixels p: its line integrals change as `projections` says, and its waves as those of
    a distance that grows with 1/p². magnified: whether this is asked for; else that derivative is zero.
    """
    pixel = exposures.views.pitch
    lines, slopes = projections(volume, grid, in_pixels(exposures.views))
    instrument = Instrument(exposures, oversample)

    def frames(images: Tensor, through: Instrument = instrument) -> Tensor:
        if oversample > 1:
            images = interpolate(images[None], scale_factor=oversample, mode="bilinear", align_corners=False)[0]
        return frames_of(through, images * pixel, material).detach()

    here = frames(lines)
    wanted = SMALL if magnified else SMALL[:-1]
    columns = [(frames(lines + step * slopes[:, k]) - here) / step for k, step in enumerate(wanted)]
    farther = Instrument(replace(exposures, distance=exposures.distance * (1 + STRETCH)), oversample)
    by_distance = (frames(lines, farther) - here) / np.log1p(STRETCH)
    scaled = columns.pop() + 2 * by_distance if magnified else torch.zeros_like(here)
    columns += [by_distance, scaled, here]
    return Predicted(here, torch.stack(columns, dim=1))


def projections(volume: Tensor, grid: Grid, views: Views) -> tuple[Tensor, Tensor]:
    """Line integrals [V, H, W] [pixels] of `volume` [Z, Y, X], and their derivatives [V, 6, H, W] by the pose.

    By shifts of the detector [1/pixel of the view], turns about the lab's axes [1/rad], which are those of
    `model.Alignment`, and the logarithm of the magnification, which moves the centres of pixels towards the middle.
    A turn about x moves matter at depth z by `-ω z` along y, and matter at y along the beam, which no line integral
    sees: so the derivative is that of the first moment `m = ∫ z f dz` along y; likewise about y. A turn about the beam
    turns the image. Derivatives along the image are central differences.
    """
    projector = LatticeProjector(grid, views)
    x, y, z = (torch.from_numpy(axis).float() for axis in grid.axes())
    lines = projector.project(volume)
    parts = [projector.project(volume * weight) for weight in (x, y[:, None], z[:, None, None])]
    along = torch.from_numpy(views.rotations[:, 2]).float()
    moments = sum(along[:, k, None, None] * part for k, part in enumerate(parts))
    assert isinstance(moments, Tensor)
    edges = torch.from_numpy(views.pixel_sizes).float()[:, None, None]
    (across, down), (moment_across, moment_down) = slopes(lines), slopes(moments)
    (h, w), shifts = views.shape, torch.from_numpy(views.shifts).float()[:, :, None, None] / edges[:, None]
    from_x, from_y = (torch.arange(w) + 0.5 - w / 2)[None, None], (torch.arange(h) + 0.5 - h / 2)[None, :, None]
    rolled = (from_y + shifts[:, 1]) * across - (from_x + shifts[:, 0]) * down
    magnified = -from_x * across - from_y * down
    turned = (moment_down / edges, -moment_across / edges)
    return lines, torch.stack([across, down, *turned, rolled, magnified], dim=1)


def slopes(images: Tensor) -> tuple[Tensor, Tensor]:
    """Central differences of images [V, H, W] along columns and along rows [1/pixel]; zero at the borders."""
    across, down = torch.zeros_like(images), torch.zeros_like(images)
    across[:, :, 1:-1] = 0.5 * (images[:, :, 2:] - images[:, :, :-2])
    down[:, 1:-1] = 0.5 * (images[:, 2:] - images[:, :-2])
    return across, down


def in_pixels(views: Views) -> Views:
    """The same views with the pitch as the unit of length."""
    return views.in_units_of(views.pitch)


@dataclass(frozen=True)
class Normal:
    """Information of frames on K parameters of each of V views, near the present ones; frames of a view add up.

    information: [V, K, K], the Hessian of half the squared residuals over their noise
    slope: [V, K], how fast these fall along each number
    """

    information: Tensor
    slope: Tensor

    @classmethod
    def of(cls, measured: Tensor, found: Predicted, blur: float) -> Normal:
        """measured: frames [V, H, W], NaN in pixels without a value; found: at the present numbers, flux included;
        blur: standard deviation of a Gaussian [pixels] by which images are compared. The noise of a view is what it
        leaves unexplained, as it is after that blur: this many independent pixels."""
        known = ~measured.isnan()
        missing = blurred(left_of(measured, found.frames), blur).flatten(1).double()
        columns = blurred(found.derivatives * known[:, None], blur).flatten(2).double()
        independent = 1 / (4 * math.pi * blur**2)
        scale = independent / (missing.square().sum(1) / known.sum((1, 2))).clamp_min(1e-18)
        information = torch.einsum("vip,vjp->vij", columns, columns) * scale[:, None, None]
        return cls(information, torch.einsum("vip,vp->vi", columns, missing) * scale[:, None])

    def in_units(self, scales: Tensor) -> Normal:
        """The same for numbers `scales` [K] times larger."""
        return Normal(self.information / (scales[:, None] * scales), self.slope / scales)


@dataclass(frozen=True)
class Step:
    """numbers: [V, K] after the step; covariances: [V, K, K] of them, by frames and prior, for a known volume."""

    numbers: Tensor
    covariances: Tensor


def step(normal: Normal, numbers: Tensor, expected: Tensor) -> Step:
    """The likeliest numbers near the present ones (Levenberg 1944, with the prior as damping); float64.

    numbers: [V, K]; expected: [K] standard deviations of the numbers about zero, 0 for those that stay.
    """
    free = expected > 0
    information, slope = normal.information[:, free][:, :, free], normal.slope[:, free]
    prior = expected[free] ** -2
    covariances = torch.linalg.inv(information + torch.diag(prior))
    moved = torch.einsum("vij,vj->vi", covariances, slope - prior * numbers[:, free])
    after = numbers.clone()
    after[:, free] += moved
    whole = torch.zeros(*numbers.shape, numbers.shape[1], dtype=numbers.dtype)
    places = torch.nonzero(free)[:, 0]
    whole[:, places[:, None], places] = covariances
    return Step(after, whole)


def blurred(images: Tensor, sigma: float) -> Tensor:
    """Images [..., H, W] convolved with a Gaussian of `sigma` [pixels], periodically."""
    raster = images.shape[-2:]
    return torch.fft.irfft2(torch.fft.rfft2(images) * gaussian(raster, sigma), s=raster)


def gaussian(raster: tuple[int, ...], sigma: float) -> Tensor:
    """The half-spectrum [..., N // 2 + 1] of a Gaussian of `sigma` [samples] on a periodic `raster` [..., N]."""
    axes = [*(torch.fft.fftfreq(count) for count in raster[:-1]), torch.fft.rfftfreq(raster[-1])]
    squares = torch.stack(torch.meshgrid(*axes, indexing="ij")).square().sum(0)
    return torch.exp(-2 * math.pi**2 * sigma**2 * squares)


def unexplained(measured: Tensor, images: Tensor) -> Tensor:
    """[V, H, W] what images leave of frames, over each frame's contrast; 0 in pixels of these that are NaN."""
    return left_of(measured, images) / contrast_of(measured)


def contrast_of(measured: Tensor) -> Tensor:
    """[V, 1, 1] standard deviation of frames [V, H, W] in pixels that are not NaN."""
    away = (measured - measured.nanmean(dim=(1, 2), keepdim=True)).square().nansum(dim=(1, 2), keepdim=True)
    return (away / ((~measured.isnan()).sum(dim=(1, 2), keepdim=True) - 1)).sqrt().clamp_min(1e-12)


def rms_of(images: Tensor) -> np.ndarray:
    """[V] root mean squares of images [V, H, W]."""
    return images.double().square().mean((1, 2)).sqrt().numpy()


def numbers_of(found: Exposures, planned: Exposures) -> Tensor:
    """[V, 7] shifts [pixels], turns [rad], and logarithms of distance and magnification, that make `planned` exposures
    `found`."""
    turns = np.einsum("vij,vkj->vik", found.views.rotations, planned.views.rotations)
    shifts = (found.views.shifts - planned.views.shifts) / planned.views.pixel_sizes[:, None]
    near = np.where(planned.distance > 0, found.distance / np.where(planned.distance > 0, planned.distance, 1), 1)
    vectors = Rotation.from_matrix(turns).as_rotvec()
    larger = np.log(planned.views.pixel_sizes / found.views.pixel_sizes)
    return torch.from_numpy(np.concatenate([shifts, vectors, np.log(near)[:, None], larger[:, None]], axis=1))


def changes(found: Exposures, planned: Exposures) -> np.ndarray:
    """[V, 7]: shifts x, y [pixels], turns about x, y, z of the lab [degrees], shares of distance and magnification."""
    numbers = numbers_of(found, planned).numpy()
    return np.concatenate([numbers[:, :2], np.rad2deg(numbers[:, 2:5]), np.expm1(numbers[:, 5:])], axis=1)


def in_words(of_views: np.ndarray) -> str:
    """Root mean squares of `changes` [V, 7], without the magnification's."""
    root = np.sqrt(np.square(of_views).mean(0))
    across = np.hypot(root[[0, 2]], root[[1, 3]]) / np.sqrt(2)
    return (
        f"changes of the plan (rms): shifts {across[0]:.3f} pixels, turns across the beam {across[1]:.3f}°, "
        f"roll {root[4]:.3f}°, distance {root[5]:.2%}"
    )


def header(what: str, digits: int, *last: str) -> str:
    """The first line of a table of changes whose lines are those of `line`; what: `view` or `beam`."""
    shift, turn = 2 * digits + 9, 2 * digits + 11  # the width of the cells of a line
    cells = [f"shift {axis}".ljust(shift) for axis in "xy"] + [f"turn {axis}".ljust(turn) for axis in "xy"]
    return "  ".join([what, *cells, *("roll".ljust(turn), *last)]).rstrip()


def line(number: int, change: np.ndarray, error: np.ndarray, digits: int, *last: str) -> str:
    """A line of a table: shifts with so many `digits`, turns with one more, each with its standard error."""
    shifts = [f"{change[k]:+{digits + 4}.{digits}f} ± {error[k]:.{digits}f}" for k in (0, 1)]
    turns = [f"{change[k]:+{digits + 4}.{digits + 1}f}° ± {error[k]:.{digits + 1}f}" for k in (2, 3, 4)]
    return "  ".join([f"{number:4d}", *shifts, *turns, *last])


def moved_onto(found: Views, planned: Views) -> Views:
    """`found` with the object turned and moved so that its views are as near to `planned` as can be.

    The common turn is the mean of all relative ones, the common motion the least-squares one: mean turn and mean shift
    of the views are then zero. Frames stay what they are.
    """
    turns = np.einsum("vji,vjk->vik", found.rotations, planned.rotations)
    rotations = found.rotations @ Rotation.from_matrix(turns).mean().as_matrix()
    design = rotations[:, :2].reshape(-1, 3)
    away = (found.shifts - planned.shifts).reshape(-1)
    motion = np.linalg.lstsq(design, away, rcond=1e-9)[0]
    return replace(found, rotations=rotations, shifts=found.shifts - (design @ motion).reshape(-1, 2))


NAMES = ("shift x", "shift y", "turn x", "turn y", "roll")
NOTHING = 1.0
"""Information, in units of the prior's, below which frames add less about a combination than the prior."""
ANGLES = 0.9
"""Share of turns about the axis that all beams are normal to, from which a combination is called an angle."""
STRETCHED = (
    "frames of no object tell the angle between two beams, for an object that is stretched explains them as well: "
    "it is as planned"
)
UNTOLD = "rows say too little of the angles between beams: they are as planned"
PART = 0.35
"""Numbers whose part in a combination is less than this share of the largest are not named."""


@dataclass(frozen=True)
class RowInformation:
    """Information of rows on the 5 parameters of V views (`NAMES`), up to a motion of the whole object.

    errors: [V, 5] standard errors, with what is expected
    ratios: [K] information of each independent combination, over that of what is expected, in growing order
    combinations: [K, V, 5] of numbers in units of their expected deviations
    """

    errors: np.ndarray
    ratios: np.ndarray
    combinations: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray, views: Views, expected: np.ndarray) -> RowInformation:
        """information: [V · 6, V · 6] of a `RowEstimate`; views: planned, lengths in pixels; expected: [5] standard
        deviations, 0 for what is known."""
        count = len(views)
        whole = information + np.diag(np.tile([0.0] * FACTOR + [RETRIEVED**-2], count))
        places = np.arange(count * COUNT).reshape(count, COUNT)
        free = np.tile(expected > 0, count)
        ours, factors = places[:, :FACTOR].reshape(-1)[free], places[:, FACTOR]
        across = whole[np.ix_(ours, factors)]
        information = whole[np.ix_(ours, ours)] - across @ np.linalg.solve(whole[np.ix_(factors, factors)], across.T)
        scales, moved = np.tile(expected, count)[free], motions(views)
        kept = beside(moved[free] @ null(moved[~free]) / scales[:, None])
        ratios, vectors = np.linalg.eigh(kept.T @ (scales[:, None] * information * scales) @ kept)
        combinations, errors = np.zeros((len(ratios), free.size)), np.zeros(free.size)
        combinations[:, free] = (kept @ vectors).T
        errors[free] = scales * np.sqrt((combinations[:, free] ** 2 / (1 + np.maximum(ratios, 0)[:, None])).sum(0))
        return cls(errors.reshape(count, -1), ratios, combinations.reshape(-1, count, FACTOR))

    def words(self, held: float) -> list[str]:
        """Combinations that stay as planned, for frames do not determine them; angles between beams also where their
        information is less than `held`."""
        shares = (self.combinations[:, :, 3] ** 2).sum(1) / (self.combinations**2).sum((1, 2)).clip(1e-12)
        said = []
        if (self.ratios < held)[shares > ANGLES].any():
            said.append(STRETCHED if self.combinations.shape[1] == 2 else UNTOLD)
        for part in self.combinations[(self.ratios < NOTHING) & (shares <= ANGLES)]:
            named = np.argwhere(np.abs(part) > PART * np.abs(part).max())
            which = ", ".join(f"{NAMES[k]} of view {v} ({part[v, k]:+.2f})" for v, k in named)
            said.append(f"rows say less than is known of this combination, which is nearly as planned: {which}")
        return said


def motions(views: Views) -> np.ndarray:
    """[5 V, 6] what three motions and three turns of the whole object do to the numbers of the views.

    Frames are the same if the object moves by t and the detectors by `R t`, or if it turns and the views turn back.
    """
    columns = np.zeros((len(views), FACTOR, 6))
    columns[:, :2, :3] = views.rotations[:, :2]
    columns[:, 2:, 3:] = views.rotations
    return columns.reshape(-1, 6)


def null(matrix: np.ndarray) -> np.ndarray:
    """Orthonormal columns that `matrix` sends to zero."""
    if not len(matrix):
        return np.eye(matrix.shape[1])
    _, sizes, rows = np.linalg.svd(matrix)
    return rows[np.count_nonzero(sizes > 1e-9) :].T


def beside(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns of the space beside that of `columns` [N, K]."""
    basis, sizes, _ = np.linalg.svd(columns)
    return basis[:, np.count_nonzero(sizes > 1e-9 * max(sizes.max(initial=0.0), 1e-12)) :]


HARDLY = 0.3
"""A direction is hardly told if more than this part of its prior standard deviation is left."""
SHARES = 0.35
"""A number belongs to a direction if it has this part of it, in units of its own prior deviation."""


def hardly_told(covariances: Tensor, expected: Tensor) -> list[str]:
    """Describe each direction of pose space that some views hardly determine, given the matter.

    covariances: [V, K, K] of `NUMBERS`, prior included; expected: [K] prior standard deviations, 0 for what stays.
    Numbers are taken in units of these, so that an undetermined direction has the variance 1.
    """
    free = torch.nonzero(expected > 0)[:, 0]
    units = expected[free]
    scaled = covariances[:, free][:, :, free] / (units[:, None] * units)
    values, ways = torch.linalg.eigh(scaled)
    found = dict[str, list[tuple[int, float]]]()
    for view in range(len(covariances)):
        left, way = float(values[view, -1].clamp_min(0).sqrt()), ways[view, :, -1]
        if left > HARDLY:
            parts = [NUMBERS[int(free[k])] for k in torch.nonzero(way.abs() >= SHARES)[:, 0]]
            found.setdefault(" with ".join(parts), []).append((view, left))
    return [
        f"hardly told: {name}, in views {', '.join(str(view) for view, _ in views)} "
        f"({max(left for _, left in views):.0%} of what was uncertain is left)"
        for name, views in found.items()
    ]
