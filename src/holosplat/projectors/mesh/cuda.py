"""Depths of closed meshes on a GPU: the reference, on its device."""

from .reference import mean_depths

__all__ = ["mean_depths"]
