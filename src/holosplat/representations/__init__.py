"""Trainable Objects, and how they are initialised."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

from torch import Tensor

from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..plugins import Extended
from ..volume import LineIntegrals, TrainableObject
from .flow import Fading, Flow, Lattice, TimeBasis
from .gaussians import GaussianCloud
from .initialise import approximate, at_pitch, cloud_from_shares, cloud_from_volume, freed, random_cloud
from .isosurface import isosurface
from .moving_gaussians import MovingGaussians
from .surfaces import MovingSurfaces, SurfaceMesh
from .voxels import BandLimitedVoxels, VoxelGrid, VoxelLines


@runtime_checkable
class Stored(TrainableObject, Protocol):
    """An Object that can be fitted and stored: the result of a reconstruction."""

    kind: ClassVar[str]
    """Its name in files."""
    matter: Matter
    backend: str

    @property
    def described(self) -> str:
        """How large it is, in words."""
        ...

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Stored:
        """The same object with other tensors in the place of those named."""
        ...

    def project(self, views: Views | Poses, /) -> LineIntegrals:
        """Line integrals, differentiable in the parameters and, where poses ask for it, in these."""
        ...

    def state(self) -> dict[str, Any]:
        """Tensors, plain values, and dictionaries of them."""
        ...

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Stored:
        """The object that `state` described."""
        ...

    def on(self, backend: str) -> Stored:
        """The object for another backend (resolved)."""
        ...

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid that holds all of its matter."""
        ...


@runtime_checkable
class InMotion(Stored, Protocol):
    """One that is of several times."""

    def at(self, time: float) -> Stored:
        """The object as it is at `time` [s]."""
        ...

    @property
    def basis(self) -> TimeBasis:
        """Of its courses of time, from the first time to the last."""
        ...


KINDS: Extended[type[Stored]] = Extended(
    {kind.kind: kind for kind in (GaussianCloud, VoxelGrid, SurfaceMesh, MovingSurfaces, MovingGaussians)},
    "holosplat.kinds",
)
"""Every kind of Object that files hold, by name; other packages add theirs (docs/adding.md)."""

__all__ = [
    "KINDS",
    "BandLimitedVoxels",
    "Fading",
    "Flow",
    "GaussianCloud",
    "InMotion",
    "Lattice",
    "MovingGaussians",
    "MovingSurfaces",
    "Stored",
    "SurfaceMesh",
    "TimeBasis",
    "VoxelGrid",
    "VoxelLines",
    "approximate",
    "at_pitch",
    "cloud_from_shares",
    "cloud_from_volume",
    "freed",
    "isosurface",
    "random_cloud",
]
