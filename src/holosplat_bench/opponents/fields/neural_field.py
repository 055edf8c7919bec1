"""Matter as a neural field: an encoding of positions and a small perceptron, integrated along rays."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import max_pool3d, softplus

from holosplat.backends import device
from holosplat.checks import require, require_shapes
from holosplat.display import of_object
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.ranges import Natural, checked_dataclass
from holosplat.representations.voxels import resampling
from holosplat.tables import from_table, to_table
from holosplat.volume import LineIntegrals, Unmoved, Volume

from .perceptron import Encoding

CHUNK = 1 << 18
"""Positions evaluated at once where no gradient is needed."""
AnyViews = TypeVar("AnyViews", bound=Views | Poses)

FIRST_VALUE = 0.05
"""What a field starts from, roughly, everywhere."""


@checked_dataclass
class Network:
    """Options of the network: the encoding, and `layers` hidden layers of `hidden` units (ReLU) behind it."""

    encoding: Encoding = field(default_factory=Encoding)
    hidden: Natural = 32
    layers: Natural = 2


@dataclass(frozen=True)
class Samples:
    """Where rays of one view look: S pairs of a pixel (flat index [S] int64, ascending) and a depth step [S] int64."""

    pixel: Tensor
    depth: Tensor


class Perceptron(nn.Module):
    """The network behind a field: an encoding of positions, hidden layers (ReLU), and a linear output."""

    def __init__(self, options: Network, extent: float, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.encoding = options.encoding.build(extent, generator)
        widths = [self.encoding.width, *[options.hidden] * options.layers]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.output = nn.Linear(options.hidden, channels)
        self._start(generator)

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

    def forward(self, positions: Tensor) -> Tensor:
        """Numbers [N, C] at positions [N, 3] `(x, y, z)` in voxel edges from the box's corner."""
        found = self.encoding(positions)
        for layer in self.hidden:
            found = torch.relu(layer(found))
        return self.output(found)


class NeuralField(Unmoved):
    """A field of matter on the box of `grid` (cubic voxels), zero where `mask` [Z, Y, X] says that nothing is.

    upper: the largest occupancy of a single material, `upper · sigmoid` of the network's output (0: its softplus,
    without a bound); two channels have no bound. lower: the smallest value, 0, or -inf, for which values are the
    network's output itself, for matter on both sides of its medium. Line integrals are sums over samples a voxel edge
    apart, on rays a voxel edge apart; linear between rays on finer rasters. Works in any float type, on any device.
    jitter: a generator that draws where in its depth step each sample lies while gradients are taken (None: in the
    middle).
    """

    kind: ClassVar[str] = "neural-field"
    """The name of this kind of Object in files."""
    beside: ClassVar[int] = 0
    """Outputs of the network beside the channels of matter."""
    _repr_html_ = of_object

    def __init__(
        self,
        grid: Grid,
        matter: Matter,
        network: Network,
        mask: Tensor,
        seed: int = 0,
        upper: float = 1.0,
        *,
        lower: float = 0.0,
    ) -> None:
        require(np.allclose(grid.voxel_size, grid.voxel_size[0]), "a neural field needs a grid of cubic voxels.")
        shape = tuple(mask.shape)
        require(shape == grid.shape, f"the mask must have the grid's shape {grid.shape}, but it has {shape}.")
        require(matter.delta != 0, "a neural field needs matter with a δ, but it is 0.")
        require(upper >= 0, f"upper must not be negative, but it is {upper:g}.")
        require(lower in (0, -math.inf), f"lower must be 0 or -inf, but it is {lower:g}.")
        require(lower == 0 or upper == 0, f"a field without a lower bound has no upper one, but upper is {upper:g}.")
        self.grid, self.matter, self.network, self.upper, self.lower = grid, matter, network, float(upper), float(lower)
        self.pitch, self.backend = grid.voxel_size[0], "cpu"
        self.jitter: torch.Generator | None = None
        self._net = Perceptron(network, float(max(grid.shape)), len(matter) + self.beside, seed)
        if lower < 0:
            self._net.output.bias.detach().zero_()  # no matter, where values are the network's output
        self._weights = {name: weight.detach() for name, weight in self._net.named_parameters()}
        self._constants = dict(self._net.named_buffers())
        self.corner = torch.tensor([o - 0.5 * self.pitch for o in grid.origin], dtype=torch.float64) / self.pitch
        self.mask = mask.bool().clone()
        self._samples: dict[bytes, Samples] = {}

    def parameters(self) -> dict[str, Tensor]:
        """The weights of the network by name."""
        return dict(self._weights)

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> NeuralField:
        """The same field with other weights; it shares the mask and the samples that are ready."""
        field = copy.copy(self)
        field._weights = {name: parameters.get(name, mine) for name, mine in self._weights.items()}
        return field

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> NeuralField:
        """The field on another device, or in another float type, with a mask of its own."""
        field = copy.copy(self)
        for name in ("_weights", "_constants"):
            setattr(field, name, {key: value.to(device, dtype) for key, value in getattr(self, name).items()})
        field.corner, field.mask = self.corner.to(device), self.mask.to(device).clone()
        field._samples = {}
        return field

    def on(self, backend: str) -> NeuralField:
        """The field for another backend (resolved), on that backend's device."""
        field = self.to(device(backend))
        field.backend = backend
        return field

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same field of."""
        return {
            "weights": self.parameters(),
            "mask": self.mask,
            "voxel_size": list(self.grid.voxel_size),
            "origin": list(self.grid.origin),
            "network": to_table(self.network),
            "upper": self.upper,
            "two_sided": self.lower < 0,  # files hold finite numbers only
            "constants": self._constants,
            "matter": self.matter.as_dict(),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> NeuralField:
        """The field that `state` described; `InputError` where it does not fit together."""
        size, origin = (tuple(float(v) for v in state[name]) for name in ("voxel_size", "origin"))
        grid = Grid(tuple(state["mask"].shape), size, origin)  # type: ignore[arg-type]
        network = from_table(Network, state["network"], "network")
        lowest = {"lower": -math.inf if state.get("two_sided", False) else 0.0}  # older runs are of one side
        field = cls(grid, Matter.from_dict(state["matter"]), network, state["mask"], 0, float(state["upper"]), **lowest)
        for name, mine in (("weights", field._weights), ("constants", field._constants)):
            require_shapes(f"{name}/{{}} of the network", state.get(name, {}), mine)
        field._constants = dict(state.get("constants", {}))
        return field.with_parameters(state["weights"])

    @property
    def described(self) -> str:
        """How large the field is, in words."""
        return f"a field of {sum(p.numel() for p in self._weights.values())} weights"

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """The grid of the field, whatever its size."""
        return self.grid

    @property
    def _like(self) -> Tensor:
        """A weight: the float type and the device of the field."""
        return self._weights["output.weight"]

    def __call__(self, positions: Tensor) -> Tensor:
        """Values [N, C] at positions [N, 3] `(x, y, z)` in voxel edges from the box's corner, mask or not."""
        raw = self.raw(positions)
        if self.lower < 0:
            return raw
        return self.upper * torch.sigmoid(raw) if self.matter.single and self.upper > 0 else softplus(raw)

    def raw(self, positions: Tensor) -> Tensor:
        """Output of the network [N, C + `beside`] at the same positions."""
        return functional_call(self._net, {**self._weights, **self._constants}, (positions,))

    def raster(self, views: AnyViews) -> AnyViews:
        """The same views on pixels of a voxel edge, a whole number of them where `views` hold one.

        Where pixel sizes differ, those of the largest pixels are no wider than an edge, and the others narrower.
        """
        widest = 1.0 if views.scales is None or not len(views) else max(1.0, float(views.scales.max()))
        ratio = views.pitch * widest / self.pitch
        h, w = (max(1, math.ceil(n * ratio - 1e-6)) for n in views.shape)
        return replace(views, shape=(h, w), pitch=self.pitch / widest)

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the parameters and in the rotations and shifts of `Poses`.

        The gradient of poses is that of the samples as they move through the field; it leaves out what a sample adds or
        takes where it enters or leaves the mask.
        """
        views.parallel("a neural field")
        unknown = isinstance(views, Poses) and views.requires_grad
        rays = self.raster(views if unknown or isinstance(views, Views) else views.views())
        images = torch.stack([self._image(rays, v) for v in range(len(views))])
        return LineIntegrals(spread(images, rays, views) * self.pitch, self.matter.channels)

    def _image(self, rays: Views | Poses, v: int) -> Tensor:
        samples = self.kept_samples(rays, v) if isinstance(rays, Views) else self.samples(rays, v)
        drawn = self.jitter if torch.is_grad_enabled() else None
        return self.thickness(rays, v, samples, None if drawn is None else uniform(drawn, len(samples.pixel)))

    def kept_samples(self, rays: Views, v: int) -> Samples:
        """All samples of view `v`, found once; `prune` forgets them."""
        key = rays[[v]].fingerprint()
        if key not in self._samples:
            self._samples[key] = self.samples(rays, v)
        return self._samples[key]

    def thickness(self, rays: Views | Poses, v: int, samples: Samples, jitter: Tensor | None = None) -> Tensor:
        """Line integrals [C, H, W] in voxel edges along the rays of view `v`, on pixels of a voxel edge.

        jitter: [S] in [0, 1), where in its depth step each sample lies; in its middle for None.
        """
        image = self._like.new_zeros(len(self.matter), rays.shape[0] * rays.shape[1])
        for part in _chunks(len(samples.pixel), CHUNK if not torch.is_grad_enabled() else len(samples.pixel)):
            offset = 0.5 if jitter is None else jitter[part]
            values = self(self._positions(rays, v, samples.pixel[part], samples.depth[part] + offset))
            image = image.index_add(1, samples.pixel[part], values.T)
        return image.reshape(-1, *rays.shape)

    @torch.no_grad()
    def samples(self, rays: Views | Poses, v: int, chosen: Tensor | None = None) -> Samples:
        """Samples on rays of view `v` (its flat pixels `chosen`, ascending), in depth steps the mask has."""
        mask = self.mask
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
        like = self._like
        (h, w), rotation = rays.shape, torch.as_tensor(rays.rotations[v]).cpu()
        shift_x, shift_y = torch.as_tensor(rays.shifts[v]).cpu() / self.pitch
        centre = torch.as_tensor(self.grid.centre / self.pitch)
        edge = torch.as_tensor(rays.pitch / self.pitch, dtype=torch.float64)
        if rays.scales is not None:
            edge = edge * torch.as_tensor(rays.scales[v]).cpu()
        # x_obj = Rᵀ x_lab is affine in (column, row, depth)
        depth_at = rotation[2] @ centre - self._reach()
        first = torch.stack([(0.5 - 0.5 * w) * edge + shift_x, (0.5 - 0.5 * h) * edge + shift_y, depth_at])
        origin = rotation.T @ first - self.corner.cpu().double()
        axes = (torch.stack([edge, edge, torch.ones_like(edge)])[:, None] * rotation).to(like)
        lab = torch.stack((pixel % w, pixel // w, depth.to(like)), dim=1).to(like)
        return torch.addmm(origin.to(like), lab, axes)

    @torch.no_grad()
    def values(self, grid: Grid) -> Tensor:
        """Values [C, Z, Y, X] at the centres of the voxels of `grid`, zero outside the box and the mask."""
        like, mask = self._like, self.mask
        corner, shape = self.corner, torch.tensor(self.grid.shape[::-1], device=like.device)
        x, y, z = (torch.as_tensor(a / self.pitch, device=like.device) - c for a, c in zip(grid.axes(), corner))
        found = like.new_zeros(math.prod(grid.shape), len(self.matter))
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
        return self.matter.volume(values, grid)

    @torch.no_grad()
    def prune(self, threshold: float, grow: int, within: Tensor) -> None:
        """The mask becomes what exceeds `threshold` in size in δ's channel, grown by `grow` voxels, inside `within`.

        It stays as it is if nothing exceeds the threshold: a field can start from less.
        """
        kept = grown(self.values(self.grid)[0].abs() > threshold, grow) & within
        if bool(kept.any()):
            self.look_at(kept)

    def look_at(self, mask: Tensor) -> None:
        """The mask becomes `mask` [Z, Y, X], in all copies that share it; samples that were ready are found anew."""
        self.mask.copy_(mask)
        self._samples.clear()


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Numbers in [0, 1) of `shape` on the generator's device."""
    return torch.rand(*shape, generator=generator, device=generator.device)


def spread(images: Tensor, rays: Views | Poses, views: Views | Poses) -> Tensor:
    """Images [V, C, h, w] on `rays` brought to the pixels of `views`: linear on finer ones, means on larger ones."""
    if (rays.shape, rays.pitch) == (views.shape, views.pitch):
        return images
    fine, coarse = views.pitch, rays.pitch
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
