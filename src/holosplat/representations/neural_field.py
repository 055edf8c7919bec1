"""Matter as a neural field: an encoding of positions and a small perceptron, integrated along rays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool3d, softplus

from ..checks import at_least, require
from ..geometry import Grid, Poses, Views
from ..volume import LineIntegrals, Volume
from .encodings import Encoding
from .voxel_lines import resampling

CHUNK = 1 << 18
"""Positions evaluated at once where no gradient is needed."""
AnyViews = TypeVar("AnyViews", bound=Views | Poses)

FIRST_VALUE = 0.05
"""What a field starts from, roughly, everywhere."""


@dataclass(frozen=True)
class Matter:
    """What a field's values mean. delta, beta: as of `GaussianCloud`; channels: 1 (one occupancy) or 2 (δ, β free);
    upper: largest occupancy (0: none)."""

    delta: float
    beta: float
    channels: int = 1
    upper: float = 1.0

    def __post_init__(self) -> None:
        require(self.channels in (1, 2), f"channels must be 1 or 2, but they are {self.channels}.")
        require(self.delta > 0, f"delta must be positive, but it is {self.delta:g}.")
        at_least(self, 0, "upper")


@dataclass(frozen=True)
class Network:
    """Options of the network: the encoding, and `layers` hidden layers of `hidden` units (ReLU) behind it."""

    encoding: Encoding = field(default_factory=Encoding)
    hidden: int = 32
    layers: int = 2

    def __post_init__(self) -> None:
        at_least(self, 1, "hidden", "layers")


@dataclass(frozen=True)
class Samples:
    """Where rays of one view look: S pairs of a pixel (flat index [S] int64, ascending) and a depth step [S] int64."""

    pixel: Tensor
    depth: Tensor


class NeuralField(nn.Module):
    """A field of δ and β on the box of `grid` (cubic voxels), zero where `mask` [Z, Y, X] says that nothing is.

    One channel is an occupancy, `upper · sigmoid` of the network's output, or its softplus without a bound; two are
    `(δ/delta, β/beta)`, both through softplus. Line integrals are sums over samples a voxel edge apart, on rays a
    voxel edge apart; linear between rays on finer rasters. Works in any float type, on any device.
    """

    def __init__(self, grid: Grid, matter: Matter, network: Network, mask: Tensor, seed: int = 0) -> None:
        super().__init__()
        require(np.allclose(grid.voxel_size, grid.voxel_size[0]), "a neural field needs a grid of cubic voxels.")
        shape = tuple(mask.shape)
        require(shape == grid.shape, f"the mask must have the grid's shape {grid.shape}, but it has {shape}.")
        self.grid, self.matter, self.network = grid, matter, network
        self.pitch = grid.voxel_size[0]
        generator = torch.Generator().manual_seed(seed)
        self.encoding = network.encoding.build(float(max(grid.shape)), generator)
        widths = [self.encoding.width, *[network.hidden] * network.layers]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.output = nn.Linear(network.hidden, matter.channels)
        self._start(generator)
        corner = torch.tensor([o - 0.5 * self.pitch for o in grid.origin], dtype=torch.float64)
        self.register_buffer("corner", corner / self.pitch)
        self.register_buffer("mask", mask.bool().clone())

    def _start(self, generator: torch.Generator) -> None:
        """Weights after He et al. (2015), drawn from `generator`; an output that is small everywhere."""
        with torch.no_grad():
            for layer in self.hidden:
                assert isinstance(layer, nn.Linear)
                layer.weight.copy_(
                    torch.randn(layer.weight.shape, generator=generator) * (2 / layer.in_features) ** 0.5
                )
                layer.bias.zero_()
            self.output.weight.copy_(torch.randn(self.output.weight.shape, generator=generator) * 0.1)
            self.output.bias.fill_(math.log(FIRST_VALUE))

    @property
    def stored_bytes(self) -> int:
        """Size of the parameters as float16, and of the mask in bits."""
        return 2 * sum(p.numel() for p in self.parameters()) + self.get_buffer("mask").numel() // 8

    @property
    def materials(self) -> tuple[tuple[float, float], ...]:
        """(δ, β) of a value of one, for each channel."""
        m = self.matter
        return ((m.delta, m.beta),) if m.channels == 1 else ((m.delta, 0.0), (0.0, m.beta))

    def forward(self, positions: Tensor) -> Tensor:
        """Values [N, C] at positions [N, 3] `(x, y, z)` in voxel edges from the box's corner, mask or not."""
        found = self.encoding(positions)
        for layer in self.hidden:
            found = torch.relu(layer(found))
        raw = self.output(found)
        bounded = self.matter.channels == 1 and self.matter.upper > 0
        return self.matter.upper * torch.sigmoid(raw) if bounded else softplus(raw)

    def at(self, time: float) -> NeuralField:
        """The field itself: it does not move."""
        return self

    def raster(self, views: AnyViews) -> AnyViews:
        """The same views on pixels of a voxel edge, a whole number of them where `views` hold one."""
        ratio = views.pixel_size / self.pitch
        h, w = (max(1, math.ceil(n * ratio - 1e-6)) for n in views.shape)
        return replace(views, shape=(h, w), pixel_size=self.pitch)

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the parameters and in the rotations and shifts of `Poses`.

        The gradient of poses is that of the samples as they move through the field; it leaves out what a sample adds or
        takes where it enters or leaves the mask.
        """
        rays = self.raster(views)
        images = torch.stack([self.thickness(rays, v, self.samples(rays, v)) for v in range(len(views))])
        return LineIntegrals(spread(images, rays, views) * self.pitch, self.materials)

    def thickness(self, rays: Views | Poses, v: int, samples: Samples, jitter: Tensor | None = None) -> Tensor:
        """Line integrals [C, H, W] in voxel edges along the rays of view `v`, on pixels of a voxel edge.

        jitter: [S] in [0, 1), where in its depth step each sample lies; in its middle for None.
        """
        image = self.output.weight.new_zeros(self.matter.channels, rays.shape[0] * rays.shape[1])
        for part in _chunks(len(samples.pixel), CHUNK if not torch.is_grad_enabled() else len(samples.pixel)):
            offset = 0.5 if jitter is None else jitter[part]
            values = self(self._positions(rays, v, samples.pixel[part], samples.depth[part] + offset))
            image = image.index_add(1, samples.pixel[part], values.T)
        return image.reshape(-1, *rays.shape)

    @torch.no_grad()
    def samples(self, rays: Views | Poses, v: int, chosen: Tensor | None = None) -> Samples:
        """Samples on rays of view `v` (its flat pixels `chosen`, ascending), in depth steps the mask has."""
        mask = self.get_buffer("mask")
        every = torch.arange(rays.shape[0] * rays.shape[1], device=mask.device) if chosen is None else chosen
        steps = torch.arange(2 * self._reach(), device=mask.device)
        limits = torch.tensor(self.grid.shape[::-1], device=mask.device)
        pixels, depths = [], []
        for part in _chunks(len(every), max(1, 8 * CHUNK // len(steps))):
            pixel = every[part].repeat_interleave(len(steps))
            depth = steps.repeat(len(every[part]))
            cell = self._positions(rays, v, pixel, depth + 0.5).floor().long()
            inside = ((cell >= 0) & (cell < limits)).all(dim=1)
            x, y, z = torch.where(inside[:, None], cell, 0).unbind(1)
            kept = inside & mask[z, y, x]
            pixels.append(pixel[kept])
            depths.append(depth[kept])
        return Samples(torch.cat(pixels), torch.cat(depths))

    def _reach(self) -> int:
        """Depth steps from the box's centre to beyond its corners."""
        return math.ceil(0.5 * math.hypot(*self.grid.shape)) + 1

    def _positions(self, rays: Views | Poses, v: int, pixel: Tensor, depth: Tensor) -> Tensor:
        """Positions [N, 3] in voxel edges from the box's corner, of depth steps [N] on the rays of pixels [N]."""
        like = self.output.weight
        (h, w), rotation = rays.shape, torch.as_tensor(rays.rotations[v]).cpu()
        shift_x, shift_y = torch.as_tensor(rays.shifts[v]).cpu() / self.pitch
        centre = torch.as_tensor(self.grid.centre / self.pitch)
        # x_obj = Rᵀ x_lab is affine in (column, row, depth)
        first = torch.stack([0.5 - 0.5 * w + shift_x, 0.5 - 0.5 * h + shift_y, rotation[2] @ centre - self._reach()])
        origin = rotation.T @ first - self.get_buffer("corner").cpu().double()
        axes = rotation.to(like)
        lab = torch.stack((pixel % w, pixel // w, depth.to(like)), dim=1).to(like)
        return torch.addmm(origin.to(like), lab, axes)

    @torch.no_grad()
    def values(self, grid: Grid) -> Tensor:
        """Values [C, Z, Y, X] at the centres of the voxels of `grid`, zero outside the box and the mask."""
        like, mask = self.output.weight, self.get_buffer("mask")
        corner, shape = self.get_buffer("corner"), torch.tensor(self.grid.shape[::-1], device=like.device)
        x, y, z = (torch.as_tensor(a / self.pitch, device=like.device) - c for a, c in zip(grid.axes(), corner))
        found = like.new_zeros(math.prod(grid.shape), self.matter.channels)
        for part in _chunks(len(found), CHUNK):
            flat = torch.arange(part.start, part.stop, device=like.device)
            i, j, k = flat // (len(x) * len(y)), flat // len(x) % len(y), flat % len(x)
            at = torch.stack((x[k], y[j], z[i]), dim=1)
            cell = at.floor().long()
            inside = ((cell >= 0) & (cell < shape)).all(dim=1)
            a, b, c = torch.where(inside[:, None], cell, 0).unbind(1)
            kept = inside & mask[c, b, a]
            found[flat[kept]] = self(at[kept].to(like))
        return found.T.reshape(-1, *grid.shape)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`: means of samples no further apart than a voxel edge of the field."""
        fx, fy, fz = (max(1, round(size / self.pitch)) for size in grid.voxel_size)
        fine = grid.divided((fx, fy, fz))
        z, y, x = grid.shape
        values = self.values(fine).reshape(-1, z, fz, y, fy, x, fx).mean(dim=(2, 4, 6)).float().cpu().numpy()
        return Volume(values[0] * self.matter.delta, values[-1] * self.matter.beta, grid)

    @torch.no_grad()
    def prune(self, threshold: float, grow: int, within: Tensor) -> None:
        """The mask becomes what exceeds `threshold` in δ's channel, grown by `grow` voxels, inside `within` [Z, Y, X].

        It stays as it is if nothing exceeds the threshold: a field can start from less.
        """
        kept = grown(self.values(self.grid)[0] > threshold, grow) & within
        if bool(kept.any()):
            self.get_buffer("mask").copy_(kept)


def spread(images: Tensor, rays: Views | Poses, views: Views | Poses) -> Tensor:
    """Images [V, C, h, w] on `rays` brought to the pixels of `views`: linear on finer ones, means on larger ones."""
    if (rays.shape, rays.pixel_size) == (views.shape, views.pixel_size):
        return images
    fine, coarse = views.pixel_size, rays.pixel_size
    rows, columns = (
        resampling((n, coarse, -0.5 * (n - 1) * coarse), (m, fine, -0.5 * (m - 1) * fine))
        for n, m in zip(rays.shape, views.shape)
    )
    return rows.to(images) @ images @ columns.to(images).T


def grown(mask: Tensor, by: int) -> Tensor:
    """A mask [Z, Y, X] grown by `by` voxels along every axis and diagonal."""
    return max_pool3d(mask[None, None].float(), 2 * by + 1, stride=1, padding=by)[0, 0] > 0


def _chunks(count: int, length: int) -> Iterator[slice]:
    yield from (slice(i, min(i + length, count)) for i in range(0, count, max(1, length)))
