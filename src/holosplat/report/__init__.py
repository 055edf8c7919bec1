"""The report of a reconstruction: figures in one style, and a self-contained HTML page. No physics here."""

from __future__ import annotations

from ..lazy import exports

__getattr__, __dir__, __all__ = exports(__name__, __file__)
