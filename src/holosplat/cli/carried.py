"""The options of matter in motion: how it changes between times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from ..checks import require
from ..io.reading import Reading
from ..ranges import Weight, ranged

if TYPE_CHECKING:
    from ..motion.flow_reconstruction import FlowOptions


@dataclass(frozen=True)
@ranged
class CarriedFlags:
    """How matter changes between the times of a scan."""

    motion: Literal["still", "each", "flow", "bodies"] | None = None
    """still: one object for all times; each: a run for each time; flow: one object that a flow carries; bodies: closed
    bodies on paths, as `track` (default: one time)."""
    fading: Weight = 0.0
    """Standard deviation expected of what the logarithm of δ changes by over all times, where matter fades or grows
    denser (0: it does not). About a third is a change by a third."""

    def applied(self, reading: Reading) -> Reading:
        """`reading` of the times that --motion needs. Errors: `InputError` where --time-frame is given, too."""
        if self.motion is None:
            return reading
        require(
            reading.part.time_frame is None,
            f"--motion {self.motion} takes all times, but --time-frame is {reading.part.time_frame}; leave one.",
        )
        taken = {"still": "still", "each": "each", "flow": "all", "bodies": None}[self.motion]
        return replace(reading, part=replace(reading.part, time_frame=taken))

    def options(self) -> FlowOptions:
        """The options of the method."""
        from ..motion.flow_reconstruction import FlowOptions

        return FlowOptions(fading=self.fading)

    def require_all(self, reading: Reading) -> None:
        """`InputError` where something of it is asked of one time."""
        require(
            self.fading == 0 or reading.part.time_frame == "all",
            "--fading is of matter that a flow carries; add --motion flow, or leave it.",
        )
