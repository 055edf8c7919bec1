"""Poses of few views, estimated with the matter as a nuisance."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..geometry import Grid, Views
from ..optics.sampling import fringe_sampling
from ..representations import SurfaceMesh
from .beside import BLUR
from .derivatives import in_pixels, predicted
from .evidence import weighed
from .following import SHARP, SOFT, of_poses
from .newton import blurred
from .poses import DISTANCE, FLUX, MAGNIFICATION, PoseSearch
from .untold import motions, null

KINDS = {"shift": (0, 1), "angle": (2, 3), "roll": (4,), "distance": (DISTANCE,), "magnification": (MAGNIFICATION,)}
"""Places of the numbers of each kind."""
SLOPES = {**{place: place for place in range(5)}, MAGNIFICATION: 5}
"""Places of these numbers among the derivatives of `projections`."""
SIDE = 64
"""Pixels along a frame's shorter side from which on accuracy is computed on larger pixels, which hardly change it."""


def beside_unknown(
    search: PoseSearch, pixels: int, surfaces: SurfaceMesh | None, rehearsed: np.ndarray
) -> tuple[str, ...]:
    """Makes the covariances of the training views those beside matter that is not known, and as large as errors are.

    Where no frames are held out, that could judge, numbers also go back to the plan as far as frames do not tell them
    (`evidence.weighed`); returned are the kinds that do so altogether. Distances are left as they are.

    pixels: of the last images; surfaces: in the poses that were found, or None for voxels; rehearsed: [V, 7] errors of
    the numbers in a rehearsal (`rehearsal.rehearsed`), of which each kind is made as uncertain as they are.
    """
    uncertain, train = search.options.uncertain, np.flatnonzero(~search.scan.is_test)
    free = {kind: places for kind, places in KINDS.items() if kind != "distance" and getattr(uncertain, kind) > 0}
    places = sorted(place for kind in free.values() for place in kind)
    if not places:
        return ()
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
        return ()
    numbers = search.numbers[train]
    numbers[:, at] = torch.from_numpy(judged.numbers)
    search.numbers[train] = numbers
    return tuple(kind for kind, scale in zip(free, judged.scales) if scale == 0)


def _larger(away: np.ndarray, covariance: np.ndarray, kinds: list[list[int]]) -> np.ndarray:
    """[V · K] how many times larger than `covariance` says the errors `away` [V, K] of each kind are; 1 at least."""
    said, found = np.diag(covariance).reshape(away.shape), np.ones(away.shape)
    for each in kinds:
        found[:, each] = max(1.0, float(np.sqrt(np.square(away[:, each]).mean() / said[:, each].mean())))
    return found.reshape(-1)


def _information(
    search: PoseSearch, pixels: int, surfaces: SurfaceMesh | None, train: np.ndarray, places: list[int]
) -> Tensor:
    """That of `following.of_poses`, on pixels `pixels` times larger."""
    scan = search.scan.binned(pixels)
    exposures, grid = search.exposures(scan.exposures)[train], Grid.of_views(in_pixels(scan.views))
    if surfaces is None:
        volume = interpolate(search.volume[None, None], size=grid.shape, mode="trilinear", align_corners=False)[0, 0]
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
        left=blurred(torch.from_numpy(scan.frames)[train] / lit - images, blur).square().mean((1, 2)),
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
