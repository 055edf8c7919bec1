"""Truth objects: meshes made closed, red blood cells by their published shape, capsules, foam, bubbles, balls in
series, and continuous matter."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
