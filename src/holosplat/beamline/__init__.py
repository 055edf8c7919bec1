"""A beamline in software: specimens in the beam, pulses, camera, misalignment, series."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
