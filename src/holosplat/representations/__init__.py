"""Trainable Objects, and how they are initialised."""

from .gaussians import GaussianCloud
from .initialise import approximate, at_pitch, cloud_from_volume, freed, random_cloud

__all__ = ["GaussianCloud", "approximate", "at_pitch", "cloud_from_volume", "freed", "random_cloud"]
