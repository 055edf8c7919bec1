"""What one does with a scan: correct, join, reconstruct, evaluate."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
