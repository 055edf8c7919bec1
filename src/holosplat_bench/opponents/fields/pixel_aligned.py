"""Matter as a pixel-aligned network sees it: a field that hangs on images of its views, on voxels to be projected."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.backends import in_main_memory
from holosplat.checks import positive, require, require_shapes
from holosplat.display import of_object
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.representations.voxels import VoxelGrid
from holosplat.tables import from_table, to_table
from holosplat.volume import LineIntegrals, Volume

from .aligned_network import INPUTS, AlignedNetwork, InParts, PixelAligned, called

DEFAULT = AlignedNetwork()


class PixelAlignedField:
    """Matter on the voxels of `grid` (cubes) inside `mask` [Z, Y, X], as a network says it from images of `views`.

    images: [V, 3, H, W] of the views that are encoded (`learning.images`), on their pixels; weights: of
    `PixelAligned`. A single material has the occupancy `upper · sigmoid` of the first number (upper 0: its softplus,
    without a bound). Where δ and β are free, δ is the softplus of the first and β that of the sum of both. Between the
    centres of voxels the field is as `VoxelGrid` has it, and so are its line integrals. It is computed where the images
    are, on which side the weights must be; fits have them in main memory, and training on a GPU has them there.
    Errors: `InputError` where the arrays do not fit together.
    """

    kind: ClassVar[str] = "pixel-aligned-field"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        images: Tensor,
        views: Views,
        mask: Tensor,
        grid: Grid,
        matter: Matter,
        *,
        network: AlignedNetwork = DEFAULT,
        upper: float = 1.0,
    ) -> None:
        require(np.allclose(grid.voxel_size, grid.voxel_size[0]), "a pixel-aligned field needs a grid of cubic voxels.")
        require(
            len(matter.channels) == 1 or not matter.occupancies,
            "a pixel-aligned field is of one material, or has δ and β free, but there are two; choose another method.",
        )
        wanted = (len(views), INPUTS, *views.shape)
        require(tuple(images.shape) == wanted, f"images must have the shape {wanted}, but it is {tuple(images.shape)}.")
        shape = tuple(mask.shape)
        require(shape == grid.shape, f"the mask must have the grid's shape {grid.shape}, but it has {shape}.")
        require(upper >= 0, f"upper must not be negative, but it is {upper:g}.")
        self._net = PixelAligned(network)
        require_shapes("weights/{} of the network", weights, dict(self._net.named_parameters()))
        self.weights = {name: weights[name].detach() for name, _ in self._net.named_parameters()}
        self.images, self.views, self.mask, self.grid, self.matter = images, views, mask.bool(), grid, matter
        self.network, self.upper, self.backend = network, float(upper), "cuda" if images.is_cuda else "cpu"
        cells = self.mask.cpu().flatten().nonzero()[:, 0]
        self._places = places_of(grid, views, cells, images.dtype).to(images.device)
        self._cells = cells.to(images.device)
        self._still = VoxelGrid(images.new_zeros(len(matter), *grid.shape), grid, matter).on(self.backend)
        self._last: tuple[bytes, VoxelGrid] | None = None

    def parameters(self) -> dict[str, Tensor]:
        """The weights of the network by name."""
        return dict(self.weights)

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> PixelAlignedField:
        """The same field with other weights; it shares the projectors that are ready."""
        field = copy.copy(self)
        field.weights = {name: parameters.get(name, mine) for name, mine in self.weights.items()}
        field._last = None
        return field

    def values(self) -> Tensor:
        """Values [C, Z, Y, X] at the centres of the voxels, zero outside the mask; differentiable in the weights."""
        features = called(self._net, "encoded", self.weights, self.images)
        if len(self._cells):
            told = InParts.apply(self._net, self._places, features, *self.weights.values())
            found = self._bounded(told)  # type: ignore[arg-type]
        else:
            found = self.images.new_zeros(0, len(self.matter))
        whole = found.new_zeros(self.mask.numel(), len(self.matter))
        return whole.index_copy(0, self._cells, found).T.reshape(-1, *self.grid.shape)

    def _bounded(self, raw: Tensor) -> Tensor:
        """Values [N, C] of the network's numbers [N, 2]."""
        if not self.matter.single:
            return softplus(torch.stack([raw[:, 0], raw.sum(1)], 1))
        return self.upper * torch.sigmoid(raw[:, :1]) if self.upper > 0 else softplus(raw[:, :1])

    def at(self, time: float) -> VoxelGrid:
        """The matter on voxels; it does not move. Without gradients it is kept, for frames are judged one by one."""
        if torch.is_grad_enabled():
            return self._still.with_parameters({"values": self.values()})
        known = self._fingerprint()
        if self._last is None or self._last[0] != known:
            self._last = known, self._still.with_parameters({"values": self.values()})
        return self._last[1]

    def _fingerprint(self) -> bytes:
        """Of the weights, which fits change in place."""
        found = hashlib.blake2b()
        for weight in self.weights.values():
            found.update(weight.detach().cpu().contiguous().numpy().tobytes())
        return found.digest()

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the weights."""
        return self.at(0.0).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`."""
        with torch.no_grad():
            return self.at(0.0).voxelise(grid)

    def on(self, backend: str) -> PixelAlignedField:
        """The field for another backend (resolved); it runs on the CPU."""
        field = self.with_parameters({name: weight.cpu() for name, weight in self.weights.items()})
        field.backend = in_main_memory(backend)
        return field

    @property
    def described(self) -> str:
        """How large the field is, in words."""
        weights = sum(weight.numel() for weight in self.weights.values())
        return f"a field of {weights} weights on {len(self.images)} views"

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """The grid of the field, whatever its size."""
        return self.grid

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same field of."""
        scales = self.views.relative
        return {
            "weights": dict(self.weights),
            "images": self.images,
            "mask": self.mask,
            "rotations": torch.from_numpy(self.views.rotations),
            "shifts": torch.from_numpy(self.views.shifts),
            "scales": torch.from_numpy(scales),
            "pitch": self.views.pitch,
            "voxel_size": list(self.grid.voxel_size),
            "origin": list(self.grid.origin),
            "matter": self.matter.as_dict(),
            "network": to_table(self.network),
            "upper": self.upper,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> PixelAlignedField:
        """The field that `state` described; `InputError` where it does not fit together."""
        images, mask = state["images"], state["mask"]
        rotations, shifts, scales = (state[name].numpy() for name in ("rotations", "shifts", "scales"))
        views = Views(
            rotations,
            shifts,
            (int(images.shape[2]), int(images.shape[3])),
            float(state["pitch"]),
            None if (scales == 1).all() else scales,
        )
        size, origin = (tuple(float(v) for v in state[name]) for name in ("voxel_size", "origin"))
        return cls(
            state["weights"],
            images,
            views,
            mask,
            Grid(tuple(mask.shape), size, origin),  # type: ignore[arg-type]
            Matter.from_dict(state["matter"]),
            network=from_table(AlignedNetwork, state["network"], "network"),
            upper=float(state["upper"]),
        )


def places_of(grid: Grid, views: Views, cells: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Where the centres of the voxels `cells` [N] (flat) of `grid` lie in each view: [V, N, 3], as `PixelAligned` takes
    them, reckoned in float64. Depths are those along the beam from the middle of the grid."""
    z, y, x = (torch.from_numpy(np.ascontiguousarray(axis)) for axis in grid.axes()[::-1])
    nz, ny, nx = grid.shape
    points = torch.stack([x[cells % nx], y[cells // nx % ny], z[cells // (nx * ny)]], 1)
    h, w = views.shape
    middle = torch.as_tensor(np.asarray(grid.centre, dtype=np.float64))
    half = 0.5 * positive("voxel size", grid.voxel_size[0], "metres") * max(nx, nz)
    found = torch.empty(len(views), len(cells), 3, dtype=dtype)
    for place, rotation, shift, pixel in zip(found, views.rotations, views.shifts, views.pixel_sizes):
        turn = torch.from_numpy(np.ascontiguousarray(rotation))
        across = (points @ turn[:2].T - torch.from_numpy(shift.copy())) / (0.5 * float(pixel))
        depth = (points - middle) @ turn[2] / half
        place[:, 0], place[:, 1], place[:, 2] = across[:, 0] / w, across[:, 1] / h, depth
    return found
