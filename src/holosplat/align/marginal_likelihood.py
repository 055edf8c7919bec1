"""Poses of few views, with the matter integrated out: how far frames determine them, and shrinkage to the plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..geometry import Grid, Views
from ..inference import Decision
from ..matter import DeltaBeta
from ..optics.noise import left_of
from ..optics.retrieval.spectra import Raster, radian, response
from ..optics.sampling import fringe_sampling
from ..projectors.voxels import LatticeProjector
from ..representations import SurfaceMesh
from ..scan import Exposures
from .derivatives import beside, blurred, gaussian, in_pixels, motions, null, predicted, projections
from .fixed_matter import BLUR
from .poses import DISTANCE, FLUX, MAGNIFICATION, PoseSearch

DEPTH = 4
"""Powers of the matter's covariance in which its part of the frames is looked for: with eight, standard errors of few
noisy views are smaller by 3 % or less; with three they are larger by a quarter."""
SINGULAR = 1e-6
"""Directions of that search whose size is less than this part of the largest are those of others."""


@dataclass(frozen=True)
class Leeway:
    """How far matter may be from what it was found to be: a Gaussian field with these standard deviations.

    edges: of edges, along their normals [voxels]; insides: of occupancies within and near the matter; width: standard
    deviation of the Gaussian that white noise is smoothed with to give such a field [voxels]
    """

    edges: float
    insides: float
    width: float


SHARP = Leeway(0.5, 0.0, 2.0)
"""Surfaces of one density: edges that are half a voxel off, over patches of some voxels."""
SOFT = Leeway(1.0, 0.3, 1.0)
"""Voxels, of which few views hardly tell the depth: a third of what is there may be elsewhere."""


class Following:
    """How frames of weak objects change with line integrals, and with occupancies that are near `volume` [Z, Y, X].

    grid: of the volume, lengths in pixels of the views' pitch. Frames are blurred by `blur` [pixels]. The object is
    taken to be weak: its frames are line integrals, filtered (Cloetens et al. 1999, eq. 3).
    """

    def __init__(
        self, volume: Tensor, grid: Grid, exposures: Exposures, material: DeltaBeta, leeway: Leeway, blur: float
    ) -> None:
        views, (delta, beta) = exposures.views, material
        self._projector = LatticeProjector(grid, in_pixels(views))
        of_waves = response(exposures.optical, beta / delta, Raster(views.shape, views.pitch))
        self._waves = (-of_waves * gaussian(views.shape, blur) * views.pitch / radian(exposures, delta)).float()
        transform = gaussian(grid.shape, leeway.width)
        point = torch.zeros(grid.shape)
        point[0, 0, 0] = 1
        self._field = transform / _filtered(point, transform).norm()  # keeps the variance of white noise
        near = _filtered(volume, gaussian(grid.shape, 1.0)).clamp(0, 1)
        self._deviations = (
            leeway.edges * torch.stack(torch.gradient(near)).square().sum(0).sqrt() + leeway.insides * near
        )

    def frames(self, lines: Tensor) -> Tensor:
        """Changes of frames [..., V, H, W] by those of line integrals [pixels]; symmetric."""
        return torch.fft.irfft2(torch.fft.rfft2(lines) * self._waves, s=lines.shape[-2:])

    def spread(self, frames: Tensor) -> Tensor:
        """The covariance, by the matter's leeway, of frames, times images [V, H, W]."""
        field = self._deviations * self._projector.backproject(self.frames(frames).contiguous())
        field = self._deviations * _filtered(field, self._field.square())
        return self.frames(self._projector.project(field.contiguous()))


def of_poses(
    volume: Tensor,
    grid: Grid,
    exposures: Exposures,
    material: DeltaBeta,
    *,
    left: Tensor,
    leeway: Leeway,
    blur: float,
    places: list[int],
) -> Tensor:
    """[V · K, V · K] float64: information of K numbers of V views, beside matter that may follow them.

    places: of these numbers, among shifts [pixels], turns and the logarithm of the magnification, of which
    `projections` has the derivatives; left: [V] mean squares of what is unexplained of blurred frames, which are
    noise, as in `Normal.of`.

    With C the changes of the frames by the numbers and K those that the matter's leeway makes likely, in units of the
    noise, it is `Cᵀ (1 + K)⁻¹ C` (the Schur complement of the matter in the joint Hessian). The inverse is looked for
    among `C, K C, K² C …`, all columns together, and so never told too much.
    """
    follows = Following(volume, grid, exposures, material, leeway, blur)
    root = (1 / (4 * math.pi * blur**2) / left.clamp_min(1e-18)).sqrt().float()[:, None, None]
    slopes = follows.frames(projections(volume, grid, in_pixels(exposures.views))[1][:, places].transpose(0, 1))
    views = len(exposures)
    columns = torch.zeros(views, len(places), *slopes.shape[1:])
    for v in range(views):
        columns[v, :, v] = root[v] * slopes[:, v]
    powers = [columns.flatten(0, 1)]
    for _ in range(DEPTH):
        powers.append(torch.stack([root * follows.spread(root * image) for image in _unit(powers[-1])]))
    units = torch.cat([_unit(part) for part in powers[:-1]]).flatten(1).double()
    spread = torch.cat(powers[1:]).flatten(1).double()
    inner, moved = units @ units.T, units @ spread.T
    sizes, ways = torch.linalg.eigh(inner)
    kept = sizes > SINGULAR * sizes[-1]
    ways = ways[:, kept] / sizes[kept].sqrt()
    middle = ways.T @ (inner + 0.5 * (moved + moved.T)) @ ways
    across = powers[0].flatten(1).double() @ units.T @ ways
    return across @ torch.linalg.solve(middle, across.T)


def _unit(images: Tensor) -> Tensor:
    """Each image over its length."""
    return images / images.flatten(1).norm(dim=1).clamp_min(1e-30)[:, None, None, None]


def _filtered(field: Tensor, transform: Tensor) -> Tensor:
    return torch.fft.irfftn(torch.fft.rfftn(field) * transform, s=field.shape)


NAME, NONE = "errors of the plan", "none"
STRONG = 3.0
"""Logarithm of the ratio of evidences from which a plan counts as wrong: 20 to 1, strong (Kass & Raftery 1995)."""
SCALES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Sizes of the plan's errors, as shares of what is uncertain, that are tried."""
SWEEPS = 3
"""Times that the size of each kind's errors is chosen beside those of the others."""


@dataclass(frozen=True)
class Weighed:
    """Estimates of K parameters of each of V views.

    numbers: [V, K] as far as the frames determine them
    covariance: [V · K, V · K] of what was found, with what is uncertain as the prior
    off: [V · K, V · K] mean squares and products of what `numbers` are off by: the covariance, and how far they are
        from the likeliest with this prior, for what stays as planned may be as wrong as the estimates indicate
    scales: of each kind of numbers, the likeliest size of the plan's errors as a share of what is uncertain, 0 for none
    """

    numbers: np.ndarray
    covariance: np.ndarray
    off: np.ndarray
    scales: tuple[float, ...]


def weighed(
    found: np.ndarray,
    information: np.ndarray,
    expected: np.ndarray,
    kinds: list[list[int]],
    motions: np.ndarray,
) -> Weighed:
    """The likeliest parameters of V views, with errors of the plan of the size of largest evidence.

    found: [V, K]; information: [V · K, V · K] of them, beside matter that is not known; expected: [K] their standard
    deviations; kinds: the places of those that are wrong by the same share of these; motions: [V · K, M] what common
    motions do to all, which no frame determines and which are left out.

    With found numbers normal about the true ones, and these about the plan, the evidence of a size of the plan's errors
    has a closed form (MacKay 1992). The largest is taken; for each kind with errors it must be larger by `STRONG`. Each
    combination of parameters then shrinks to the plan as far as the frames do not determine it.
    """
    units = np.tile(expected, len(found))
    kept = beside(motions / units[:, None])
    scaled = _project_out(units[:, None] * information * units, motions / units[:, None])
    told, values = kept.T @ scaled @ kept, kept.T @ (found.reshape(-1) / units)
    shares = np.zeros((len(kinds), found.size))
    for row, places in zip(shares.reshape(len(kinds), *found.shape), kinds):
        row[:, places] = 1

    def spread_of(scales: tuple[float, ...]) -> np.ndarray:
        return (kept.T * (np.square(scales) @ shares)) @ kept

    def gain(scales: tuple[float, ...]) -> float:
        return _evidence(told, values, spread_of(scales)) - STRONG * np.count_nonzero(scales)

    scales = (1.0,) * len(kinds)
    for k in list(range(len(kinds))) * SWEEPS:
        scales = max((scales[:k] + (tried,) + scales[k + 1 :] for tried in SCALES), key=gain)
    spread = spread_of(scales)
    shrunk = spread @ np.linalg.solve(told @ spread + np.eye(len(told)), told @ values)
    whole = np.linalg.inv(told + np.eye(len(told)))
    away = whole @ told @ values - shrunk
    covariance, off = (
        units[:, None] * (kept @ part @ kept.T) * units for part in (whole, whole + np.outer(away, away))
    )
    return Weighed((units * (kept @ shrunk)).reshape(found.shape), covariance, off, scales)


def _evidence(told: np.ndarray, values: np.ndarray, spread: np.ndarray) -> float:
    """Log density, up to a constant, of `values`, whose errors have the information `told`, about 0 ± `spread`."""
    both = told @ spread + np.eye(len(told))
    return float(-0.5 * np.linalg.slogdet(both)[1] - 0.5 * values @ np.linalg.solve(both, told @ values))


def _project_out(information: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Information of what is left when the best of all `motions` is taken out."""
    across = information @ motions
    return information - across @ np.linalg.pinv(motions.T @ across, rcond=1e-9, hermitian=True) @ across.T


KINDS = {"shift": (0, 1), "angle": (2, 3), "roll": (4,), "distance": (DISTANCE,), "magnification": (MAGNIFICATION,)}
"""Places of the numbers of each kind."""
SLOPES = {**{place: place for place in range(5)}, MAGNIFICATION: 5}
"""Places of these numbers among the derivatives of `projections`."""
SIDE = 64
"""Pixels along a frame's shorter side from which on accuracy is computed on larger pixels, which hardly change it."""


def beside_unknown(
    search: PoseSearch, pixels: int, surfaces: SurfaceMesh | None, rehearsed: np.ndarray
) -> Decision | None:
    """Makes the covariances of the training views those beside matter that is not known, and as large as errors are.

    Where no frames are held out, that could judge, numbers also go back to the plan as far as frames do not tell them
    (`weighed`), and the decision which kinds of them are wrong at all is returned. Distances are left as they are.

    pixels: of the last images; surfaces: in the poses that were found, or None for voxels; rehearsed: [V, 7] errors of
    the numbers in a rehearsal (`views.rehearsed`), of which each kind is made as uncertain as they are.
    """
    uncertain, train = search.options.uncertain, np.flatnonzero(~search.scan.is_test)
    free = {kind: places for kind, places in KINDS.items() if kind != "distance" and getattr(uncertain, kind) > 0}
    places = sorted(place for kind in free.values() for place in kind)
    if not places:
        return None
    while min(search.scan.views.shape) // pixels > SIDE:
        pixels *= 2
    units = torch.tensor([pixels if place in range(2) else 1.0 for place in places]).double().repeat(len(train))
    information = (_information(search, pixels, surfaces, train, places) / units[:, None] / units).numpy()
    expected, kinds = (
        uncertain.deviations()[places].numpy(),
        [[places.index(at) for at in each] for each in free.values()],
    )
    found = search.numbers[train][:, places].numpy()
    common = _motions(search.scan.views[train], places)
    judged = weighed(found, information, expected, kinds, common)
    wider = 1 / _larger(rehearsed[train][:, places], judged.covariance, kinds)
    judged = weighed(found, wider[:, None] * information * wider, expected, kinds, common)
    at = torch.tensor(places)
    covariances = search.covariances[train]
    covariances[:, at] = covariances[:, :, at] = 0
    moves = not search.scan.is_test.any()
    blocks = torch.from_numpy(judged.off if moves else judged.covariance).reshape(
        len(train), len(places), len(train), len(places)
    )
    covariances[:, at[:, None], at] = torch.stack([blocks[v, :, v] for v in range(len(train))])
    search.covariances[train] = covariances
    if not moves:
        return None
    numbers = search.numbers[train]
    numbers[:, at] = torch.from_numpy(judged.numbers)
    search.numbers[train] = numbers
    names = list(free)
    wrong = ", ".join(kind for kind, scale in zip(names, judged.scales) if scale > 0)
    return Decision(NAME, wrong or NONE, "marginal likelihood")


def _larger(away: np.ndarray, covariance: np.ndarray, kinds: list[list[int]]) -> np.ndarray:
    """[V · K] how many times larger than `covariance` says the errors `away` [V, K] of each kind are; 1 at least."""
    said, found = np.diag(covariance).reshape(away.shape), np.ones(away.shape)
    for each in kinds:
        found[:, each] = max(1.0, float(np.sqrt(np.square(away[:, each]).mean() / said[:, each].mean())))
    return found.reshape(-1)


def _information(
    search: PoseSearch, pixels: int, surfaces: SurfaceMesh | None, train: np.ndarray, places: list[int]
) -> Tensor:
    """That of `of_poses`, on pixels `pixels` times larger."""
    scan = search.scan.binned(pixels)
    exposures, grid = search.exposures(scan.exposures)[train], Grid.of_views(in_pixels(scan.views))
    if surfaces is None:
        volume = search.volume_on(grid)
    else:
        with torch.no_grad():
            delta = surfaces.voxelise(Grid.of_views(scan.views)).delta
        volume = torch.from_numpy(delta / search.material.delta).float()
    lit = search.numbers[train, FLUX].exp().float()[:, None, None]
    blur = search.options.blur if surfaces is None else BLUR
    images = predicted(volume, grid, exposures, search.material, fringe_sampling(exposures)).frames
    return of_poses(
        volume,
        grid,
        exposures,
        search.material,
        left=blurred(left_of(scan.measured[train] / lit, images), blur).square().mean((1, 2)),
        leeway=SOFT if surfaces is None else SHARP,
        blur=blur,
        places=[SLOPES[place] for place in places],
    )


def _motions(views: Views, places: list[int]) -> np.ndarray:
    """[V · K, M] common motions, which no frame determines: those of the object that only move the parameters
    `places`, and its size."""
    free = np.tile(np.isin(np.arange(5), places), len(views))
    moved = motions(in_pixels(views))
    moved = moved[free] @ null(moved[~free])
    size = np.zeros((len(views), len(places), 1))
    found = np.zeros((len(views), len(places), moved.shape[1]))
    pose = [k for k, place in enumerate(places) if place < 5]
    found[:, pose] = moved.reshape(len(views), len(pose), -1)
    if MAGNIFICATION in places:
        size[:, places.index(MAGNIFICATION)] = 1
        found = np.concatenate([found, size], axis=2)
    return found.reshape(len(views) * len(places), -1)
