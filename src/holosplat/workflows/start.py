"""The cloud a fit starts from, and the material it is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..baselines import holographic_tv
from ..baselines.material import Backend, estimate_delta, estimate_ratio
from ..baselines.two_materials import Shares, absorption, at_one_ratio, told_apart, two_levels
from ..geometry import Grid
from ..materials import WATER, DeltaBeta
from ..optics.noise import noise_share
from ..optics.retrieval import retrieve_thickness
from ..representations import (
    GaussianCloud,
    approximate,
    at_pitch,
    cloud_from_two,
    cloud_from_volume,
    freed,
    random_cloud,
)
from ..scan import Scan
from .settings import MaterialPrior, Settings

ROUNDS = 2
"""In which the frames of two materials are turned into those of one ratio; more of them let the materials drift."""

Progress = Callable[[str, float], None]
Retrieve = Callable[[Scan], tuple[Tensor, Grid]]
"""Occupancy [Z, Y, X] and its grid, by a scan."""


def starting_cloud(
    scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress
) -> GaussianCloud:
    """The cloud to start from, by the training frames `scan`; where nothing is known of the
    matter, δ and β are free (`settings.separate`, and at a random start), or those of the one material or the two that
    frames suggest."""
    start = _random if settings.start == "random" else _from_phase_retrieval
    return start(scan, prior, settings, seed, on_progress)


def _from_phase_retrieval(
    scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress
) -> GaussianCloud:
    backend = settings.volume.backend
    material = assumed_material(scan, prior, on_progress, backend)
    options = replace(settings.volume, upper=settings.volume.upper if prior.kind != "free" else 0.0)

    def retrieve(frames: Scan) -> tuple[Tensor, Grid]:
        return holographic_tv(frames, material, options, on_progress)

    volume, grid = retrieve(scan)
    shares = _shares(scan, prior, settings, material, (volume, grid), retrieve)
    pitch = scan.views.pixel_size
    spacing = _spacing_px(scan, settings) * pitch
    if shares is None:
        whole = at_pitch(volume, grid, pitch)
        cloud = cloud_from_volume(*whole, material, spacing, pitch, settings.max_start)
    else:
        volume, grid = shares.values, shares.grid
        whole = at_pitch(volume, grid, pitch)
        cloud = cloud_from_two(*whole, shares.materials, spacing, pitch, settings.max_start)
    cloud = approximate(cloud.on(backend), volume, grid, settings.approximate_steps, on_progress)
    return freed(cloud) if prior.kind == "free" and settings.separate else cloud


def _shares(
    scan: Scan,
    prior: MaterialPrior,
    settings: Settings,
    material: DeltaBeta,
    found: tuple[Tensor, Grid],
    retrieve: Retrieve,
) -> Shares | None:
    """Where two materials are, if two are known, or nothing is and the volume `found` of `material` shows two."""
    (volume, grid), backend = found, settings.volume.backend
    pixel = round(scan.views.pixel_size / grid.voxel_size[0]) or 1
    known = prior.materials if len(prior.materials) == 2 else ()
    levels = (known[0].delta, known[1].delta) if known else None
    if prior.kind == "free" and settings.most_materials == 2 and not settings.separate:
        levels = two_levels(volume * material.delta, pixel)
    if levels is None:
        return None
    for _ in range(ROUNDS):
        delta = volume * material.delta
        levels = levels if known else two_levels(delta, pixel) or levels
        values = told_apart(delta, levels, pixel)
        betas = [m.beta for m in known] or absorption(scan, values, grid, levels, backend)
        first, second = (DeltaBeta(*pair) for pair in zip(levels, betas))
        shares = Shares(values, grid, (first, second))
        volume, grid = retrieve(at_one_ratio(scan, shares, material.ratio, backend))
    return replace(shares, values=told_apart(volume * material.delta, levels, pixel), grid=grid)


def _spacing_px(scan: Scan, settings: Settings) -> float:
    """Distance between Gaussians [pixels]: few large ones follow the noise less than many small ones."""
    return settings.spacing_px * min(2.0, 1 + settings.spacing_noise * noise_share(torch.from_numpy(scan.frames)))


def assumed_material(scan: Scan, prior: MaterialPrior, on_progress: Progress, backend: Backend = "cpu") -> DeltaBeta:
    """δ and β of one material for all matter: as known, or as the training frames `scan` suggest.

    Where two are known, it has the δ of the denser, and the ratio of an equal mixture.
    """
    if len(prior.materials) == 2:
        (denser, dark), (lighter, bright) = prior.materials
        return DeltaBeta(denser, denser * (dark + bright) / (denser + lighter))
    if prior.kind == "known":
        return DeltaBeta(prior.delta, prior.beta)
    ratio = prior.ratio if prior.kind == "ratio" else estimate_ratio(scan, on_progress, backend)
    delta = estimate_delta(scan, ratio, on_progress, backend)
    return DeltaBeta(delta, delta / ratio)


def _random(scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress) -> GaussianCloud:
    """The thesis' start; amplitudes are in units of the known material, or else of water."""
    on_progress("random start", 0.0)
    material = WATER.delta_beta(scan.exposures.reference_energy)
    if prior.kind == "known":
        material = DeltaBeta(prior.delta, prior.beta)
    elif prior.kind == "ratio":
        material = DeltaBeta(material.delta, material.delta / prior.ratio)
    frames, pitch = torch.from_numpy(scan.frames), scan.views.pixel_size
    refraction = scan.exposures.refraction(*material)
    retrieved = retrieve_thickness(frames, pitch, scan.exposures.distance, scan.exposures.energy_kev, *refraction)
    h, w = scan.views.shape
    disc = np.pi / 4 * min(h, w) ** 2 / (h * w)
    thickness = max(float(retrieved.mean()) / disc, 0.1 * pitch)
    second = prior.materials[1] if len(prior.materials) == 2 else None
    channels = 2 if prior.kind == "free" or second else 1
    return random_cloud(settings.random_count, scan.views, material, channels, thickness, seed, second)
