"""Initialisation of Gaussians: from the volume of a classical reconstruction, from moments, or at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate, max_pool3d, pad
from torch.optim.adam import adam

from ..checks import NoMatterError, require
from ..geometry import Grid, Views
from ..matter import Matter
from ..memory import memory_kept
from .gaussians import GaussianCloud, raw_of

SMALLEST = 1e-3
"""Smallest starting amplitude: softplus needs some slope to start from."""


NEXT_TO_NOTHING = 1e-4
"""Amplitude of the material that a Gaussian is not of: so little that softplus hardly lets it grow."""

FILLED = 0.05
"""Share of matter from which on a block becomes a Gaussian, unless the caller says otherwise."""
CALM = 0.2
"""Change of a block's occupancy towards its neighbours, as a share of it, below which nothing changes there."""
RATES = (0.02, 0.02, 0.02, 0.05)
"""Adam's first rates of centres, log-scales, quaternions and amplitudes while a cloud learns a volume."""


def cloud_from_volume(
    occupancy: Tensor,
    grid: Grid,
    material: tuple[float, float],
    spacing: float,
    unit_length: float,
    max_count: int = 1_000_000,
    filled: float = FILLED,
) -> GaussianCloud:
    """A single-material cloud that approximates `occupancy` [Z, Y, X] on `grid`: one Gaussian a filled block.

    Blocks have an edge of about `spacing` [m] (a whole number of voxels). Each block of which more than the share
    `filled` is matter becomes one isotropic Gaussian at its centre of mass, with its mass, and with half a block as
    standard deviation, so that full blocks add up to a flat density (rms ripple below 2 %). Where that would be more
    than `max_count`, eight blocks in one make one Gaussian wherever nothing changes in them and beside them (`CALM`),
    as in the inside of bulky bodies; and if they are still too many, all blocks are larger.
    material: (δ, β) of an occupancy of one; unit_length [m]: the cloud's unit, the pixel size.
    """
    voxel = grid.voxel_size[0]
    edge = max(1, round(spacing / voxel))
    volume = occupancy.float().clamp_min(0)
    mass, centre, size = _blocks(volume, edge, filled, max_count)
    while len(mass) > max_count:
        edge += 1
        mass, centre, size = _blocks(volume, edge, filled, max_count)
    if not len(mass):
        raise NoMatterError
    position = centre * voxel + torch.tensor(grid.origin, dtype=torch.float32)
    sigma = 0.5 * size * voxel
    peak = mass * (size * voxel) ** 3 / ((2 * np.pi) ** 1.5 * sigma**3)
    log_scales = torch.log(sigma / unit_length)[:, None].repeat(1, 3)
    return GaussianCloud(
        (position / unit_length, log_scales, _identity(len(mass)), raw_of(peak.clamp_min(SMALLEST))[:, None]),
        unit_length,
        Matter.one(*material),
    )


def cloud_from_shares(
    occupancies: Tensor,
    grid: Grid,
    materials: Sequence[tuple[float, float]],
    spacing: float,
    unit_length: float,
    max_count: int = 1_000_000,
    filled: float = FILLED,
) -> GaussianCloud:
    """A cloud of materials that approximates `occupancies` [C, Z, Y, X] on `grid`; each Gaussian is of one.

    The Gaussians of each are those of `cloud_from_volume`, with almost nothing of the others. materials: (δ, β) of
    each; the rest as there. Errors: `InputError` if there is nothing of one of them.
    """
    parts = []
    for channel, (occupancy, material) in enumerate(zip(occupancies, materials)):
        require(
            bool((occupancy > filled).any()),
            f"the start found nothing of the material of δ {material[0]:.3g}; check all materials, or name fewer.",
        )
        one = cloud_from_volume(occupancy, grid, material, spacing, unit_length, max_count // len(materials), filled)
        raw = raw_of(torch.full((len(one), len(materials)), NEXT_TO_NOTHING))
        raw[:, channel] = one.raw_amplitudes[:, 0]
        parts.append((one.centres, one.log_scales, one.quaternions, raw))
    return GaussianCloud([torch.cat(arrays) for arrays in zip(*parts)], unit_length, Matter.several(*materials))


def at_pitch(volume: Tensor, grid: Grid, pitch: float) -> tuple[Tensor, Grid]:
    """The volume […, Z, Y, X] interpolated to voxels of `pitch` [m] if its own are coarser (by a whole number)."""
    factor = round(grid.voxel_size[0] / pitch)
    if factor <= 1:
        return volume, grid
    finer = grid.divided((factor, factor, factor))
    channels = volume.reshape(1, -1, *volume.shape[-3:])
    fine = interpolate(channels, size=finer.shape, mode="trilinear", align_corners=False)
    return fine.reshape(*volume.shape[:-3], *finer.shape), finer


def approximate(
    cloud: GaussianCloud,
    occupancy: Tensor,
    grid: Grid,
    steps: int,
    on_progress: Callable[[str, float], None],
    rates: Sequence[float] = RATES,
) -> GaussianCloud:
    """The cloud after `steps` of Adam towards `occupancy` on `grid`, by mean squared difference.

    occupancy: [Z, Y, X], or [C, Z, Y, X] of each of the cloud's channels. It starts a hologram fit where the classical
    reconstruction ended. `on_progress(stage, fraction)`. rates: first ones of centres, log-scales, quaternions and
    amplitudes.
    """
    leaves = [p.detach().clone().requires_grad_() for p in cloud.parameters().values()]
    cloud = cloud.replaced(leaves)
    states = [[torch.zeros_like(leaf), torch.zeros_like(leaf), torch.zeros((), device=leaf.device)] for leaf in leaves]
    occupancy = occupancy.to(leaves[0].device)
    power = float(occupancy.square().sum())
    with memory_kept():
        for step in range(steps):
            on_progress("Gaussians for the volume", step / steps)
            density = cloud.density(grid)
            # The gradient of Σ (density - occupancy)² / power, without the arrays that autograd would keep; as a dot
            # product, for backward with a gradient makes torch import sympy, which takes more than a second.
            misses = (density.detach() - occupancy).mul_(2 / power)
            torch.dot(density.flatten(), misses.flatten()).backward()
            for leaf, rate, state in zip(leaves, rates, states):
                _adam_step(leaf, rate * 0.1 ** (step / steps), state)
    return cloud.detached()


def _adam_step(leaf: Tensor, rate: float, state: Sequence[Tensor]) -> None:
    """A step of Adam (Kingma & Ba 2015) along the gradient of `leaf`, which is dropped; state: running means of the
    gradient and of its square, and the number of steps.

    The function, not the class `torch.optim.Adam`: to make one imports torch's compiler, which takes 1.5 s.
    """
    assert leaf.grad is not None
    mean, square, steps = ([value] for value in state)
    with torch.no_grad():
        adam(
            [leaf],
            [leaf.grad],
            mean,
            square,
            [],
            steps,
            fused=True,
            amsgrad=False,
            maximize=False,
            lr=rate,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-12,
        )
    leaf.grad = None


def random_cloud(count: int, views: Views, matter: Matter, thickness: float, seed: int) -> GaussianCloud:
    """`count` Gaussians, uniform in the ball that every view sees, as the thesis starts.

    Their size is the mean distance between neighbours and their summed mass that of a slab of `thickness` [m]
    of each channel of `matter` over the ball's cross-section.
    """
    require(count > 0, f"the number of Gaussians must be positive, but it is {count}.")
    generator = torch.Generator().manual_seed(seed)
    radius = 0.5 * min(views.shape)
    direction = torch.randn(count, 3, generator=generator)
    distance = radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    centres = distance * direction / direction.norm(dim=1, keepdim=True)
    sigma = 0.5 * radius * (4.19 / count) ** (1 / 3)
    mass = np.pi * radius**2 * thickness / views.finest / count
    peak = torch.full((count, len(matter)), mass / ((2 * np.pi) ** 1.5 * sigma**3))
    log_scales = torch.full((count, 3), float(np.log(sigma)))
    return GaussianCloud((centres, log_scales, _identity(count), raw_of(peak)), views.finest, matter)


def freed(cloud: GaussianCloud) -> GaussianCloud:
    """The same single-material cloud with δ and β free: its amplitude in both channels."""
    centres, log_scales, quaternions, raw = (p.detach().clone() for p in cloud.parameters().values())
    return cloud.replaced((centres, log_scales, quaternions, raw[:, :1].repeat(1, 2)), cloud.matter.freed())


def _blocks(occupancy: Tensor, edge: int, filled: float, max_count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean occupancy [N], centre of mass [N, 3] as (x, y, z) and edge [N] of the blocks that hold matter, in voxels."""
    mass, centre = _block_moments(occupancy, edge)
    single = mass > filled
    if int(single.sum()) <= max_count or min(mass.shape) < 2:  # a slice by itself has no larger blocks
        return mass[single], centre[:, single].T, torch.full((int(single.sum()),), float(edge))
    change = max_pool3d(mass[None], 3, 1, 1)[0] + max_pool3d(-mass[None], 3, 1, 1)[0]
    calm = single & (change <= CALM * mass)
    together = -max_pool3d(-calm.float()[None], 2)[0] > 0
    inside = torch.zeros_like(calm)
    z, y, x = (2 * n for n in together.shape)
    inside[:z, :y, :x] = together.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    large, middle = _block_moments(occupancy, 2 * edge)
    z, y, x = together.shape
    large, middle, alone = large[:z, :y, :x], middle[:, :z, :y, :x], single & ~inside
    return (
        torch.cat([mass[alone], large[together]]),
        torch.cat([centre[:, alone].T, middle[:, together].T]),
        torch.cat([torch.full((int(alone.sum()),), float(edge)), torch.full((int(together.sum()),), 2.0 * edge)]),
    )


def _block_moments(occupancy: Tensor, edge: int) -> tuple[Tensor, Tensor]:
    """Mean occupancy [z, y, x] of blocks of `edge³` voxels, and their centres of mass [3, z, y, x] as (x, y, z)."""
    missing = [(-n) % edge for n in occupancy.shape]
    full = pad(occupancy, (0, missing[2], 0, missing[1], 0, missing[0]))

    def mean(values: Tensor) -> Tensor:
        return avg_pool3d(values[None, None], edge)[0, 0]

    mass = mean(full)
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in full.shape), indexing="ij")
    centre = torch.stack([mean(full * axis) / mass.clamp_min(1e-9) for axis in axes[::-1]])
    return mass, centre


def _identity(count: int) -> Tensor:
    return torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)


HALVES = torch.tensor([[x, y, z] for z in (-0.25, 0.25) for y in (-0.25, 0.25) for x in (-0.25, 0.25)]).double()
"""Centres `(x, y, z)` of the eight halves of a cell, in the order of an array [2, 2, 2] of (z, y, x)."""
HALF = 1 / 48
"""Variance along an axis of a half cell that is full."""
SMOOTH = 1 / 8
"""Variance added along each axis. Gaussians as narrow as their matter leave gaps between the cells of up to three
quarters of a full density; with 1/12 volumes on the same cells, which are Gaussians' means nearly, read 3 % too high,
with 1/6 edges are blurred half as much again (looked at on one scene of 256² pixels; no script keeps it)."""


def moments(halves: Tensor, filled: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [N], centre `(x, y, z)` [N, 3] and covariance [N, 3, 3] of the matter in each cell, float64, in cells.

    halves: occupancy [2Z, 2Y, 2X] of half cells, each taken to be filled evenly; filled: share of matter from which on
    a cell counts. The centre of the first cell is (0, 0, 0).
    """
    nz, ny, nx = (n // 2 for n in halves.shape)
    cells = halves.clamp_min(0).reshape(nz, 2, ny, 2, nx, 2).permute(0, 2, 4, 1, 3, 5)
    mass = cells.mean(dim=(3, 4, 5))
    here = mass > filled
    weights = cells[here].reshape(-1, 8).double()
    mass = weights.mean(dim=1)
    weights = weights / (8 * mass[:, None])
    halves = HALVES.to(weights)
    offset = weights @ halves
    second = torch.einsum("nk,ki,kj->nij", weights, halves, halves)
    covariance = second - offset[:, :, None] * offset[:, None] + HALF * torch.eye(3).to(weights)
    return mass, here.nonzero().flip(1) + offset, covariance


def cloud_of_moments(
    mass: Tensor, centre: Tensor, covariance: Tensor, cell: float, unit_length: float, matter: Matter
) -> GaussianCloud:
    """A Gaussian for each `mass` [N], `centre` [N, 3] from the origin and `covariance` [N, 3, 3], float64, in cells.

    Covariances grow by `SMOOTH`. cell: edge of a cell [m]; unit_length [m]: the cloud's unit. matter: of one channel.
    """
    from scipy.spatial.transform import Rotation  # which takes long to load

    spread, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a mirror
    x, y, z, w = Rotation.from_matrix(axes.numpy()).as_quat().T
    sigma = (spread.clamp_min(0) + SMOOTH).sqrt()
    peak = mass / ((2 * np.pi) ** 1.5 * sigma.prod(dim=1))
    scale = cell / unit_length
    found = (
        scale * centre,
        torch.log(scale * sigma),
        torch.from_numpy(np.stack([w, x, y, z], axis=1)),
        raw_of(peak.clamp_min(SMALLEST))[:, None],
    )
    return GaussianCloud([values.float() for values in found], unit_length, matter)
