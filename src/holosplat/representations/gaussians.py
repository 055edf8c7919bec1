"""Anisotropic 3D Gaussians that add up: the density of one material, of each of two, or free δ and β."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, softplus

from ..backends import device
from ..checks import positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..projectors.splat import splat, voxelise
from ..volume import LineIntegrals, Unmoved, Volume

PARAMETERS = ("centres", "log_scales", "quaternions", "raw_amplitudes")
"""The names of the trainable tensors."""


class GaussianCloud(Unmoved):
    """N Gaussians; `n(x) - 1` is the sum of `a exp(-½ (x-c)ᵀ Σ⁻¹ (x-c))`, `Σ = R(q) diag(s²) R(q)ᵀ`.

    Parameters are float32 tensors in units of `unit_length` [m], the scan's pixel size, so that they are of
    order one (a 100 nm Gaussian in metres would underflow):
    centres [N, 3] `(x, y, z)`; log_scales [N, 3], natural logarithms of the standard deviations;
    quaternions [N, 4] `(w, x, y, z)`, normalised on use; raw_amplitudes [N, C], peak values through softplus.

    The peak values are those of the channels of `matter`: occupancies of its materials, or δ and β in its units.
    Errors: `InputError` if the arrays do not fit together, or not to the matter.
    """

    kind: ClassVar[str] = "gaussians"
    """The name of this kind of Object in files."""
    names: ClassVar[tuple[str, ...]] = PARAMETERS
    """The names of the trainable tensors, in the order in which the cloud is made of them."""
    _repr_html_ = of_object

    def __init__(self, parameters: Iterable[Tensor], unit_length: float, matter: Matter) -> None:
        self.centres, self.log_scales, self.quaternions, self.raw_amplitudes = parameters
        self.unit_length, self.matter = float(unit_length), matter
        n, channels = len(self.centres), len(matter)
        shapes = [tuple(getattr(self, name).shape) for name in PARAMETERS]
        wanted = [(n, 3), (n, 3), (n, 4), (n, channels)]
        require(
            shapes == wanted,
            f"a Gaussian cloud of {channels} channels of matter needs shapes (N, 3), (N, 3), (N, 4), (N, {channels}), "
            f"but got {shapes}.",
        )
        self.backend = "cpu"

    def __len__(self) -> int:
        return len(self.centres)

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors by name."""
        return {name: getattr(self, name) for name in self.names}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> GaussianCloud:
        """The cloud with other tensors in the place of those named."""
        return self.replaced(parameters.get(name, mine) for name, mine in self.parameters().items())

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3] in units of `unit_length`."""
        return torch.exp(self.log_scales)

    @property
    def amplitudes(self) -> Tensor:
        """Peak values [N, C] in units of the material's δ (and β)."""
        return softplus(self.raw_amplitudes)

    @property
    def strength(self) -> Tensor:
        """The peak value of each Gaussian [N], by which faint ones are found."""
        return self.amplitudes.amax(dim=1)

    def values_times(self, factor: float, index: Tensor) -> dict[str, Tensor]:
        """The parameters behind the amplitudes of the Gaussians `index` that make these `factor` times as large."""
        return {"raw_amplitudes": raw_of(self.amplitudes.detach()[index] * factor)}

    @property
    def described(self) -> str:
        """How large the cloud is, in words."""
        return f"{len(self)} Gaussians"

    def replaced(self, parameters: Iterable[Tensor], matter: Matter | None = None) -> Self:
        """A cloud of other tensors in the same units, of the same matter or another."""
        cloud = type(self)(parameters, self.unit_length, matter or self.matter)
        cloud.backend = self.backend
        return cloud

    def detached(self) -> GaussianCloud:
        """A copy that carries no gradients."""
        return self.replaced(p.detach().clone() for p in self.parameters().values())

    def on(self, backend: str) -> GaussianCloud:
        """The cloud for another backend (resolved: `cpu`, `cuda`, `reference`), on that backend's device."""
        cloud = self.replaced(p.to(device(backend)) for p in self.parameters().values())
        cloud.backend = backend
        return cloud

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same cloud of."""
        return {**self.parameters(), "unit_length": self.unit_length, "matter": self.matter.as_dict()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> GaussianCloud:
        """The cloud that `state` described; `InputError` where it does not fit together."""
        matter = Matter.from_dict(state["matter"])
        unit = positive("unit_length", state["unit_length"], "metres")
        return cls([state[name] for name in cls.names], unit, matter)

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid around all centres, of `unit_length` a voxel, or coarser where those would be over `most_voxels`."""
        return Grid.around(self.centres.detach().double().cpu().numpy(), self.unit_length, most_voxels)

    def thickness(self, views: Views | Poses) -> Tensor:
        """Line integrals [V, C, H, W] of the amplitudes, in units of `unit_length`.

        Views are checked, Poses (on the cloud's device) are taken as they are, without waiting for a GPU. Gradients
        reach the cloud's parameters, and the rotations, shifts, scales and sources of Poses that require them.
        """
        poses = Poses.of(views, self.centres.device) if isinstance(views, Views) else views
        scale = self.unit_length / poses.pitch
        return splat(
            *self._scaled(scale),
            amplitudes=self.amplitudes if scale == 1 else self.amplitudes / scale,
            rotations=poses.rotations,
            shifts=poses.shifts / poses.pitch,
            shape=poses.shape,
            pixels=poses.scales,
            sources=None if poses.sources is None else poses.sources / poses.pitch,
            backend=self.backend,
            trusted=not isinstance(views, Views),
        )

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the parameters and in Poses, as `thickness` is."""
        return LineIntegrals(self.thickness(views), self.matter.in_lengths(self.unit_length))

    def density(self, grid: Grid) -> Tensor:
        """Amplitudes [C, Z, Y, X] on `grid` (cubic voxels), averaged over voxels; differentiable."""
        pitch = grid.voxel_size[0]
        require(np.allclose(grid.voxel_size, pitch), "Gaussians are voxelised on cubic voxels only.")
        middle = torch.as_tensor(grid.centre, dtype=torch.float64, device=self.centres.device)
        return self.density_around(middle, grid.shape, pitch, trusted=False)

    def density_around(self, middle: Tensor, shape: tuple[int, int, int], pitch: float, trusted: bool = True) -> Tensor:
        """As `density`, on `shape` voxels of `pitch` [m] around `middle` [3] `(x, y, z)` [m], float64, on the device.

        `trusted`: the cloud's values are taken as they are, without waiting for a GPU; else they are checked.
        """
        scale = self.unit_length / pitch
        centres, scales, quaternions = self._scaled(scale)
        offset = (middle / pitch).to(centres.dtype)
        arrays = (centres - offset, scales, quaternions, self.amplitudes)
        return voxelise(*arrays, shape, backend=self.backend, trusted=trusted)

    def _scaled(self, scale: float) -> tuple[Tensor, Tensor, Tensor]:
        """Centres, scales and quaternions in pixels of which `unit_length` holds `scale`."""
        if scale == 1:
            return self.centres, self.scales, self.quaternions
        return self.centres * scale, self.scales * scale, self.quaternions

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`."""
        with torch.no_grad():
            return self.matter.volume(self.density(grid).cpu().numpy(), grid)

    def masses(self) -> Tensor:
        """Integrals [N, C] of each Gaussian, in units of `unit_length³` × amplitude: `a (2π)^{3/2} s₁s₂s₃`."""
        return self.amplitudes * (2 * np.pi) ** 1.5 * self.scales.prod(dim=1, keepdim=True)


def raw_of(amplitudes: Tensor) -> Tensor:
    """The raw amplitudes whose softplus is `amplitudes` (> 0)."""
    return amplitudes + torch.log(-torch.expm1(-amplitudes.clamp_min(1e-6)))


def unit_quaternions(quaternions: Tensor) -> Tensor:
    """Quaternions [N, 4] of length one."""
    return normalize(quaternions, dim=1)
