"""Matter: the `Volume` on a grid, and the `Object` protocol that every model of matter answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from .checks import finite, shaped
from .display import of_volume
from .geometry import Grid, Poses, Views

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Volume:
    """The refractive index n = 1 - δ + iβ on a grid.

    delta, beta: [Z, Y, X] float32, dimensionless.
    grid: voxel size and place.

    Errors: `InputError` where the shapes are not that of the grid, and for values that are not finite.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> grid = hs.Grid.centred((8, 8, 8), voxel_size=1e-6)
        >>> delta = np.zeros(grid.shape)
        >>> delta[2:6, 2:6, 2:6] = 5.8e-7
        >>> volume = hs.Volume(delta, delta / 2200, grid)
        >>> volume.delta.shape, volume.delta.dtype
        ((8, 8, 8), dtype('float32'))
    """

    delta: np.ndarray
    beta: np.ndarray
    grid: Grid

    def __post_init__(self) -> None:
        for name in ("delta", "beta"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            object.__setattr__(self, name, finite(name, shaped(name, array, self.grid.shape)))

    _repr_html_ = of_volume


@dataclass(frozen=True)
class LineIntegrals:
    """Line integrals along the beam by channels of matter; unpacks to `(B, D)`, of β and δ, each [V, H, W] in metres.

    channels: [V, C, H, W].
    materials: for each channel, the (δ, β) [m] that a unit of it integrates to: `D = Σ δ_c T_c`, `B = Σ β_c T_c`.
    """

    channels: torch.Tensor
    materials: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, B: torch.Tensor, D: torch.Tensor) -> LineIntegrals:
        """From the integrals of β and δ themselves, each [V, H, W] in metres."""
        import torch

        return cls(torch.stack((D, B), dim=1), ((1.0, 0.0), (0.0, 1.0)))

    @classmethod
    def of_any(cls, lines: LineIntegrals | tuple[torch.Tensor, torch.Tensor]) -> LineIntegrals:
        """From the projections of an `Object`: line integrals by channels, or the integrals `(B, D)` [V, H, W] in
        metres."""
        return lines if isinstance(lines, LineIntegrals) else cls.of(*lines)

    def __getitem__(self, index: int) -> torch.Tensor:
        """0: B, 1: D."""
        if not 0 <= index < 2:
            raise IndexError(index)
        factors = [material[1 - index] for material in self.materials]
        total = sum(f * channel for f, channel in zip(factors, self.channels.unbind(1)) if f != 0)
        return self.channels.new_zeros(self.channels[:, 0].shape) if isinstance(total, int) else total


@runtime_checkable
class Object(Protocol):
    """Anything made of matter: mesh scenes, voxel volumes, Gaussian clouds, and whatever moves."""

    def at(self, time: float) -> Object:
        """The object as it is at `time` [s]; a static one returns itself."""
        ...

    def project(self, views: Views, /) -> LineIntegrals | tuple[torch.Tensor, torch.Tensor]:
        """Line integrals `(B, D)` of β and δ along the beam, each [V, H, W] in metres, or `LineIntegrals`."""
        ...

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over (or sampled on) the voxels of `grid`."""
        ...


@runtime_checkable
class Component(Protocol):
    """A part of a model whose numbers can be fitted: they have names, and other ones can take their place."""

    def parameters(self) -> Mapping[str, torch.Tensor]:
        """The tensors that can be fitted, by name."""
        ...

    def with_parameters(self, parameters: Mapping[str, torch.Tensor]) -> Component:
        """The same part with other tensors in the place of those named; the others stay."""
        ...


@runtime_checkable
class TrainableObject(Object, Component, Protocol):
    """An Object whose numbers can be fitted; it projects poses without waiting for a device."""

    def with_parameters(self, parameters: Mapping[str, torch.Tensor]) -> TrainableObject:
        """The same object with other tensors in the place of those named."""
        ...

    def project(self, views: Views | Poses, /) -> LineIntegrals | tuple[torch.Tensor, torch.Tensor]:
        """Line integrals as of `Object`, differentiable in the parameters."""
        ...
