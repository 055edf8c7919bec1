"""Alignment from the frames: the axis of rotating objects, and the poses of single views."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
