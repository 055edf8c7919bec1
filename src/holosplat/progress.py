"""The functions that long acts call to say how far they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Advance = Callable[[float], None]
"""Called with the fraction that is done, 0 to 1."""

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""

FitProgress = Callable[[str, float, dict[str, float]], None]
"""Called with (stage, fraction done of it, the last record of the fit or {})."""

FitState = Callable[[str, float, dict[str, float], Callable[[], Any]], None]
"""Called after a step with (stage, fraction done of it, its record, a function that gives the object as it is now)."""
