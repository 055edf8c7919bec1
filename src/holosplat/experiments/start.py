"""The cloud a fit starts from, and the material it is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from ..baselines import holographic_tv
from ..baselines.material import Backend, estimate_delta, estimate_ratio
from ..materials import WATER, DeltaBeta
from ..optics.noise import noise_share
from ..optics.retrieval import retrieve_thickness
from ..representations import GaussianCloud, approximate, at_pitch, cloud_from_volume, freed, random_cloud
from ..scan import Scan
from .settings import MaterialPrior, Settings

Progress = Callable[[str, float], None]


def starting_cloud(
    scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress
) -> GaussianCloud:
    """The cloud to start from, by the training frames `scan`; where nothing is known of the
    matter, δ and β are free (`settings.separate`, and at a random start), or of the one ratio that frames suggest."""
    start = _random if settings.start == "random" else _from_phase_retrieval
    return start(scan, prior, settings, seed, on_progress)


def _from_phase_retrieval(
    scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress
) -> GaussianCloud:
    backend = settings.volume.backend
    material = assumed_material(scan, prior, on_progress, backend)
    options = replace(settings.volume, upper=settings.volume.upper if prior.kind != "free" else 0.0)
    volume, grid = holographic_tv(scan, material, options, on_progress)
    pitch = scan.views.pixel_size
    whole = at_pitch(volume, grid, pitch)
    cloud = cloud_from_volume(*whole, material, _spacing_px(scan, settings) * pitch, pitch, settings.max_start).on(
        backend
    )
    cloud = approximate(cloud, volume, grid, settings.approximate_steps, on_progress)
    return freed(cloud) if prior.kind == "free" and settings.separate else cloud


def _spacing_px(scan: Scan, settings: Settings) -> float:
    """Distance between Gaussians [pixels]: few large ones follow the noise less than many small ones."""
    return settings.spacing_px * min(2.0, 1 + settings.spacing_noise * noise_share(torch.from_numpy(scan.frames)))


def assumed_material(scan: Scan, prior: MaterialPrior, on_progress: Progress, backend: Backend = "cpu") -> DeltaBeta:
    """δ and β of the one material: as known, or as the training frames `scan` suggest."""
    if prior.kind == "known":
        return DeltaBeta(prior.delta, prior.beta)
    ratio = prior.ratio if prior.kind == "ratio" else estimate_ratio(scan, on_progress, backend)
    delta = estimate_delta(scan, ratio, on_progress, backend)
    return DeltaBeta(delta, delta / ratio)


def _random(scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, on_progress: Progress) -> GaussianCloud:
    """The thesis' start; amplitudes are in units of the known material, or else of water."""
    on_progress("random start", 0.0)
    material = WATER.delta_beta(scan.exposures.energy_kev)
    if prior.kind == "known":
        material = DeltaBeta(prior.delta, prior.beta)
    elif prior.kind == "ratio":
        material = DeltaBeta(material.delta, material.delta / prior.ratio)
    frames, pitch = torch.from_numpy(scan.frames), scan.views.pixel_size
    retrieved = retrieve_thickness(frames, pitch, scan.exposures.distance, scan.exposures.energy_kev, *material)
    h, w = scan.views.shape
    disc = np.pi / 4 * min(h, w) ** 2 / (h * w)
    thickness = max(float(retrieved.mean()) / disc, 0.1 * pitch)
    channels = 2 if prior.kind == "free" else 1
    return random_cloud(settings.random_count, scan.views, material, channels, thickness, seed)
