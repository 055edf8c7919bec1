"""The cloud that a fit starts from, of a first volume or of surfaces, and its material."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ..backends import resolve
from ..baselines import holographic_tv
from ..baselines.two_materials import Shares, absorption, at_one_ratio, told_apart, two_levels
from ..checks import require
from ..geometry import Grid
from ..matter import DeltaBeta, KnownRatio, Matter
from ..mesh import shell_labels
from ..model.instrument import MOST_CHANNELS
from ..optics.noise import noise_share
from ..optics.retrieval import retrieve_thickness
from ..projectors.surface import surface_occupancy
from ..representations import (
    GaussianCloud,
    SurfaceMesh,
    approximate,
    at_pitch,
    cloud_from_shares,
    cloud_from_volume,
    freed,
    random_cloud,
)
from ..representations.initialise import cloud_of_moments, moments
from ..scan import Scan
from .gaussian_options import GaussianOptions
from .method import Task
from .volume import material_of_levels

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
    require(
        not (options.separate and task.prior.two_sided and not task.prior.fixes_ratio),
        "Gaussians with δ and β apart lie on one side of their medium, but matter lies on both; leave separate = true.",
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
    upper = options.volume.upper if task.bounded else 0.0
    how = replace(options.volume, upper=upper, two_sided=task.prior.two_sided)

    def retrieve(frames: Scan) -> tuple[Tensor, Grid]:
        lines = task.lines(frames, material, how)
        return holographic_tv(frames, material, how, task.on_progress, task.unlike_null, lines=lines)

    volume, grid = retrieve(scan)
    if task.prior.two_sided and not task.prior.materials[1:]:
        shares = _sides(volume, grid, material, options.filled)
    else:
        shares = _shares(task, options, material, (volume, grid), retrieve)
    if shares is None:
        return cloud_of(volume, grid, material, task, options)
    pitch, (volume, grid) = scan.views.finest, (shares.values, shares.grid)
    whole, spacing = at_pitch(volume, grid, pitch), _spacing_px(scan, options) * pitch
    cloud = cloud_from_shares(*whole, shares.materials, spacing, pitch, options.max_start, options.filled)
    return _approximate(cloud, volume, grid, task, options)


def both_sides(material: DeltaBeta) -> tuple[DeltaBeta, DeltaBeta]:
    """`material`, and what lies as far on the other side of its medium: together, amplitudes of any sign."""
    return material, DeltaBeta(-material.delta, -material.beta)


def _sides(volume: Tensor, grid: Grid, material: DeltaBeta, filled: float) -> Shares:
    """Matter [Z, Y, X] in units of `material` as that of each side of its medium; a side without any is left out."""
    sides = list(zip((volume, -volume), both_sides(material)))
    values, materials = zip(*([side for side in sides if float(side[0].max()) > filled] or sides[:1]))
    return Shares(torch.stack(values).clamp_min(0), grid, materials)


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
    levels = tuple(material.sign * each.delta for each in known) or None
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
    if prior.two_sided and not prior.materials[1:]:
        matter = Matter.several(*both_sides(material))
    return random_cloud(options.random_count, scan.views, matter, thickness, task.seed)


MOST_VOXELS = 1 << 24
"""Half cells that are looked at together: an array of them is 134 MB."""
MOST_GAUSSIANS = 3_000_000
"""Gaussians at most; beyond, all are twice as large."""
FILLED = 0.02
"""Share of matter from which on a cell becomes a Gaussian."""

Moments = tuple[Tensor, Tensor, Tensor]
"""Mass, centre and covariance of the matter in each cell."""


def cloud_of_surfaces(mesh: SurfaceMesh, task: Task) -> GaussianCloud:
    """Gaussians of the matter in `mesh`, one a cell of a pixel of the frames of `task`. Errors: `InputError` where
    there is none."""
    grid, edge = Grid.of_views(task.scan.views), 1
    while True:
        cell = edge * grid.voxel_size[0]
        found = matter_in_cells(mesh, cell, grid.origin)
        if len(found[0]) <= MOST_GAUSSIANS:
            break
        edge *= 2
    mass, centre, covariance = found
    require(len(mass) > 0, "there is no matter in the surfaces to make Gaussians of.")
    centre = centre + torch.tensor(grid.origin, dtype=torch.float64) / cell
    return cloud_of_moments(mass, centre, covariance, cell, mesh.unit_length, mesh.matter)


def matter_in_cells(mesh: SurfaceMesh, cell: float, origin: tuple[float, float, float]) -> Moments:
    """Moments of the matter in cells of an edge `cell` [m], of which one has its centre at `origin` [m]; in cells from
    there."""
    vertices = mesh.vertices.detach()
    points = (vertices * mesh.unit_length - torch.tensor(origin).to(vertices)) / cell
    parts = [part for first, stop, faces in regions(points, mesh.faces) for part in _cells(points, faces, first, stop)]
    mass, centre, covariance = (torch.cat(values).cpu() for values in zip(*parts))
    return mass, centre, covariance


def regions(points: Tensor, faces: Tensor) -> list[tuple[np.ndarray, np.ndarray, Tensor]]:
    """First cell and stop [3] `(x, y, z)` of boxes that do not overlap, and the faces of the shells in each.

    points: in cells. Shells whose boxes overlap share one: the inner wall of a hollow body alone is no body.
    """
    label = shell_labels(faces.cpu().numpy(), len(points))
    corners = points[faces].cpu().numpy()
    count = int(label.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, corners.min(axis=1))
    np.maximum.at(high, label, corners.max(axis=1))
    first, stop = np.floor(low + 0.5).astype(int), np.floor(high + 0.5).astype(int) + 1
    while True:
        overlap = (first[:, None] < stop[None]).all(axis=2)
        number, group = connected_components(overlap & overlap.T, directed=False)
        if number == len(first):
            break
        label = group[label]
        first = np.array([first[group == k].min(axis=0) for k in range(number)])
        stop = np.array([stop[group == k].max(axis=0) for k in range(number)])
    shells = torch.from_numpy(label).to(faces.device)
    return [(first[k], stop[k], faces[shells == k]) for k in range(len(first))]


def _cells(points: Tensor, faces: Tensor, first: np.ndarray, stop: np.ndarray) -> Iterator[Moments]:
    """The moments of the cells of a box, some rows at a time; only triangles that reach into them are looked at."""
    width, depth = int(stop[0] - first[0]), int(stop[2] - first[2])
    rows = max(1, MOST_VOXELS // (8 * depth * width))
    y = points[:, 1][faces]
    low, high = y.amin(dim=1), y.amax(dim=1)
    for top in range(int(first[1]), int(stop[1]), rows):
        count = min(rows, int(stop[1]) - top)
        corner = torch.tensor([first[0], top, first[2]]).to(points)
        here = faces[(high >= top - 0.75) & (low <= top + count - 0.25)]
        if len(here):
            inside = surface_occupancy(2 * (points - corner) + 0.5, here, (2 * depth, 2 * count, 2 * width), lines=2)
            mass, centre, covariance = moments(inside, FILLED)
            yield mass, centre + corner, covariance
