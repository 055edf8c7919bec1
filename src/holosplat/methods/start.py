"""The cloud a fit starts from, and the material it is made of."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..backends import resolve
from ..baselines import holographic_tv
from ..baselines.two_materials import Shares, absorption, at_one_ratio, told_apart, two_levels
from ..checks import require
from ..geometry import Grid
from ..matter import DeltaBeta, KnownRatio, Matter
from ..model.instrument import MOST_CHANNELS
from ..optics.noise import noise_share
from ..optics.retrieval import retrieve_thickness
from ..representations import (
    GaussianCloud,
    approximate,
    at_pitch,
    cloud_from_shares,
    cloud_from_volume,
    freed,
    random_cloud,
)
from ..scan import Scan
from .gaussian_options import GaussianOptions
from .method import Task
from .sharp_level import material_of_levels

Retrieve = Callable[[Scan], tuple[Tensor, Grid]]
"""Occupancy [Z, Y, X] and its grid, by a scan."""


def starting_cloud(task: Task, options: GaussianOptions) -> GaussianCloud:
    """The cloud to start from without a network, by the training frames of `task`.

    Where nothing is known of the matter, δ and β are free (`options.separate`, and at a random start), or those of the
    one material or the two that frames suggest.
    """
    require(
        len(task.prior.materials) <= MOST_CHANNELS,
        f"Gaussians are of {MOST_CHANNELS} materials at most, but {len(task.prior.materials)} are known; give fewer, "
        "or --method auto where frames show their surfaces.",
    )
    return (_random if options.start == "random" else _from_phase_retrieval)(task, options)


def cloud_of(volume: Tensor, grid: Grid, material: DeltaBeta, task: Task, options: GaussianOptions) -> GaussianCloud:
    """Gaussians that approximate occupancy [Z, Y, X] of one `material` on `grid`, on the pixels of `task`."""
    scan, pitch = task.scan, task.scan.views.finest
    most = min(options.max_start, math.ceil(options.start_per_pixel * len(scan) * math.prod(scan.views.shape)))
    whole, spacing = at_pitch(volume, grid, pitch), _spacing_px(scan, options) * pitch
    cloud = cloud_from_volume(*whole, material, spacing, pitch, most, options.filled)
    return _approximate(cloud, volume, grid, task, options)


def _from_phase_retrieval(task: Task, options: GaussianOptions) -> GaussianCloud:
    scan, backend = task.scan, options.volume.backend
    material = material_of_levels(task, backend, options.estimate)
    how = replace(options.volume, upper=options.volume.upper if task.bounded else 0.0)

    def retrieve(frames: Scan) -> tuple[Tensor, Grid]:
        return holographic_tv(frames, material, how, task.on_progress, task.unlike_null)

    volume, grid = retrieve(scan)
    shares = _shares(task, options, material, (volume, grid), retrieve)
    if shares is None:
        return cloud_of(volume, grid, material, task, options)
    pitch, (volume, grid) = scan.views.finest, (shares.values, shares.grid)
    whole, spacing = at_pitch(volume, grid, pitch), _spacing_px(scan, options) * pitch
    cloud = cloud_from_shares(*whole, shares.materials, spacing, pitch, options.max_start, options.filled)
    return _approximate(cloud, volume, grid, task, options)


def _approximate(
    cloud: GaussianCloud, volume: Tensor, grid: Grid, task: Task, options: GaussianOptions
) -> GaussianCloud:
    """`cloud` after it has learned the volume."""
    rates = tuple(vars(options.approximate_rates).values())
    cloud = cloud.on(resolve(options.volume.backend))
    cloud = approximate(cloud, volume, grid, options.approximate_steps, task.on_progress, rates)
    return freed(cloud) if options.separate and not task.prior.fixes_ratio else cloud


def _shares(
    task: Task, options: GaussianOptions, material: DeltaBeta, found: tuple[Tensor, Grid], retrieve: Retrieve
) -> Shares | None:
    """Where materials are, if several are known, or nothing is and the volume `found` of `material` shows two."""
    (volume, grid), scan, prior, backend = found, task.scan, task.prior, options.volume.backend
    pixel, how = round(scan.views.finest / grid.voxel_size[0]) or 1, options.two_materials
    known = prior.materials if len(prior.materials) > 1 else ()
    levels = tuple(abs(material.delta) for material in known) or None
    if task.matter == "levels" and not prior.fixes_ratio and options.most_materials == 2 and not options.separate:
        levels = two_levels(volume * abs(material.delta), pixel, how)
    if levels is None:
        return None
    for _ in range(how.rounds):
        size = volume * abs(material.delta)
        levels = levels if known else two_levels(size, pixel, how) or levels
        values = told_apart(size, levels, pixel, how)
        deltas = [material.sign * level for level in levels]
        betas = [m.beta for m in known] or absorption(scan, values, grid, deltas, backend, how)
        shares = Shares(values, grid, tuple(DeltaBeta(*pair) for pair in zip(deltas, betas)))
        volume, grid = retrieve(at_one_ratio(scan, shares, material.ratio, backend))
    return replace(shares, values=told_apart(volume * abs(material.delta), levels, pixel, how), grid=grid)


def _spacing_px(scan: Scan, options: GaussianOptions) -> float:
    """Distance between Gaussians [pixels]: few large ones follow the noise less than many small ones."""
    return options.spacing_px * min(2.0, 1 + options.spacing_noise * noise_share(scan.measured))


def _random(task: Task, options: GaussianOptions) -> GaussianCloud:
    """The thesis' start; amplitudes are in units of the known material, or else of water."""
    from ..materials import WATER  # which needs xraydb, and that a database

    task.on_progress("random start", 0.0)
    scan, prior = task.scan, task.prior
    material = WATER.delta_beta(scan.exposures.reference_energy)
    if prior.materials:
        material = prior.materials[0]
    elif prior.sign < 0 and not prior.fixes_ratio:
        material = DeltaBeta(-material.delta, -material.beta)
    elif isinstance(prior, KnownRatio):
        material = DeltaBeta(prior.delta_sign * material.delta, prior.delta_sign * material.delta / prior.ratio)
    frames, pitch, optics = torch.from_numpy(scan.frames), scan.views.finest, scan.exposures.optical
    refraction = optics.refraction(*material)
    retrieved = retrieve_thickness(frames, optics.views.pixel_size, optics.distance, optics.energy_kev, *refraction)
    h, w = scan.views.shape
    disc = np.pi / 4 * min(h, w) ** 2 / (h * w)
    thickness = max(float(retrieved.mean()) / disc, 0.1 * pitch)
    matter = Matter.one(*material) if prior.fixes_ratio else Matter.free(*material)
    if len(prior.materials) == 2:
        matter = Matter.several(*prior.materials)
    return random_cloud(options.random_count, scan.views, matter, thickness, task.seed)
