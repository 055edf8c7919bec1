"""Trainable Objects, and how they are initialised."""

from .gaussians import GaussianCloud
from .initialise import approximate, cloud_from_volume, freed, random_cloud

__all__ = ["GaussianCloud", "approximate", "cloud_from_volume", "freed", "random_cloud"]
