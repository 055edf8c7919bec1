"""Trainable Objects, and how they are initialised."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from torch import Tensor

from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..volume import LineIntegrals, TrainableObject
from .aligned_network import AlignedNetwork, PixelAligned
from .deformed_voxels import Deformation, DeformedVoxels
from .encodings import Encoding
from .fading import Fading
from .flow import Flow, Lattice
from .gaussians import GaussianCloud
from .hexplane import HexPlaneField, HexPlanes
from .initialise import approximate, at_pitch, cloud_from_two, cloud_from_volume, freed, random_cloud
from .isosurface import isosurface
from .moving_gaussians import MovingGaussians
from .moving_surfaces import MovingSurfaces
from .moving_voxels import LowRankVoxels, OnVoxels, VoxelSeries
from .neural_field import Network, NeuralField
from .paths import TimeBasis
from .photographed import AlphaCloud, RadianceField
from .pixel_aligned import PixelAlignedField
from .space_time import SpaceTime, SpaceTimeField
from .surfaces import SurfaceMesh
from .voxel_lines import VoxelLines
from .voxels import VoxelGrid


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

    @property
    def stored_bytes(self) -> int:
        """Size of what has to be stored of it."""
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


KINDS: dict[str, type[Stored]] = {
    kind.kind: kind
    for kind in (
        *(GaussianCloud, VoxelGrid, SurfaceMesh, MovingSurfaces, MovingGaussians, NeuralField),
        *(SpaceTimeField, AlphaCloud, RadianceField, PixelAlignedField),
        *(VoxelSeries, LowRankVoxels, HexPlaneField, DeformedVoxels),
    )
}
"""Every kind of Object that files hold, by name."""
MOVING = (MovingSurfaces, MovingGaussians, SpaceTimeField, VoxelSeries, LowRankVoxels, HexPlaneField, DeformedVoxels)
"""Those that are of several times."""

__all__ = [
    "KINDS",
    "MOVING",
    "AlignedNetwork",
    "AlphaCloud",
    "Deformation",
    "DeformedVoxels",
    "Encoding",
    "Fading",
    "Flow",
    "GaussianCloud",
    "HexPlaneField",
    "HexPlanes",
    "Lattice",
    "LowRankVoxels",
    "MovingGaussians",
    "MovingSurfaces",
    "Network",
    "NeuralField",
    "OnVoxels",
    "PixelAligned",
    "PixelAlignedField",
    "RadianceField",
    "SpaceTime",
    "SpaceTimeField",
    "Stored",
    "SurfaceMesh",
    "TimeBasis",
    "VoxelGrid",
    "VoxelLines",
    "VoxelSeries",
    "approximate",
    "at_pitch",
    "cloud_from_two",
    "cloud_from_volume",
    "freed",
    "isosurface",
    "random_cloud",
]
