"""How large a network is."""

from __future__ import annotations

from dataclasses import dataclass

from ..checks import at_least
from ..ranges import ranged


@dataclass(frozen=True)
@ranged
class Size:
    """How large a network is; about a million weights by default."""

    image: tuple[int, ...] = (16, 24, 32, 32)
    """Channels of the views' encoder, from its finest level to its coarsest."""
    features: int = 12
    """Channels that are lifted along the rays, of each view."""
    volume: tuple[int, ...] = (16, 40, 80)
    """Channels of the volumes' U-Nets, from the finest level to the coarsest."""

    def __post_init__(self) -> None:
        at_least(self, 1, "features")
