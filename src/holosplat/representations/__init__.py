"""Trainable Objects, and how they are initialised."""

from .encodings import Encoding
from .gaussians import GaussianCloud
from .initialise import approximate, at_pitch, cloud_from_two, cloud_from_volume, freed, random_cloud
from .isosurface import isosurface
from .neural_field import Network, NeuralField
from .surfaces import SurfaceMesh
from .voxel_lines import VoxelLines
from .voxels import VoxelGrid

__all__ = [
    "Encoding",
    "GaussianCloud",
    "Network",
    "NeuralField",
    "SurfaceMesh",
    "VoxelGrid",
    "VoxelLines",
    "approximate",
    "at_pitch",
    "cloud_from_two",
    "cloud_from_volume",
    "freed",
    "isosurface",
    "random_cloud",
]
