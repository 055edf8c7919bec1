"""Trainable Objects, and how they are initialised."""

from .encodings import Encoding
from .gaussians import GaussianCloud
from .initialise import approximate, at_pitch, cloud_from_volume, freed, random_cloud
from .neural_field import Matter, Network, NeuralField
from .voxel_lines import VoxelLines
from .voxels import VoxelGrid

__all__ = [
    "Encoding",
    "GaussianCloud",
    "Matter",
    "Network",
    "NeuralField",
    "VoxelGrid",
    "VoxelLines",
    "approximate",
    "at_pitch",
    "cloud_from_volume",
    "freed",
    "random_cloud",
]
