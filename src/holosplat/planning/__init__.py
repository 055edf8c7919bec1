"""The contrast, resolution and data rate of an experiment, before it is done or simulated."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
