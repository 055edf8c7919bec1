"""The options of matter in motion that is no body: what it may do in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..checks import require
from ..io.reading import Reading
from ..ranges import Weight, ranged

if TYPE_CHECKING:
    from ..motion.carried import CarriedOptions


@dataclass(frozen=True)
@ranged
class CarriedFlags:
    """What matter in motion may do, with --time-frame all."""

    fading: Weight = 0.0
    """Standard deviation expected of what the logarithm of δ changes by over all times, where matter fades or grows
    denser (0: it does not). About a third is a change by a third."""

    def options(self) -> CarriedOptions:
        """The options of the method."""
        from ..motion.carried import CarriedOptions

        return CarriedOptions(fading=self.fading)

    def require_all(self, reading: Reading) -> None:
        """`InputError` where something of it is asked of one time."""
        require(
            self.fading == 0 or reading.part.time_frame == "all",
            "--fading is of matter in motion; say --time-frame all, too, or leave it.",
        )
