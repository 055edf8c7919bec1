"""How large a network is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..checks import at_least, require
from ..ranges import Natural, ranged

MOST_LEVELS = 10
"""Levels of a U-Net, at most: the coarsest of eleven is of one pixel where the finest has a thousand."""


@dataclass(frozen=True)
@ranged
class Size:
    """How large a network is; about a million weights by default."""

    image: tuple[Natural, ...] = (16, 24, 32, 32)
    """Channels of the views' encoder, from its finest level to its coarsest."""
    features: int = 12
    """Channels that are lifted along the rays, of each view."""
    volume: tuple[Natural, ...] = (16, 40, 80)
    """Channels of the volumes' U-Nets, from the finest level to the coarsest."""

    def __post_init__(self) -> None:
        at_least(self, 1, "features")
        for name in ("image", "volume"):
            require_levels(name, getattr(self, name))


def require_levels(name: str, widths: Sequence[int]) -> None:
    """`InputError` unless a U-Net has as many levels as images and volumes can be halved."""
    count = len(widths)
    require(2 <= count <= MOST_LEVELS, f"{name} must have 2 to {MOST_LEVELS} levels, but it has {count}.")
