"""Files: one module a format. Readers check what they read; writers replace a file whole or not at all."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
