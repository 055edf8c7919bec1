"""How a fit proceeds: steps, frames a step, learning rates, warm-up, validation."""

from __future__ import annotations

from dataclasses import replace

from ..checks import at_least, require
from ..ranges import checked_dataclass


@checked_dataclass
class Schedule:
    """Options of the optimisation loop; the rates themselves belong to the method."""

    steps: int = 300
    """Gradient steps: 200 leave sharp edges unfinished, 400 gain nothing on the cases of the benchmark."""
    views_per_step: int = 0
    """Frames drawn for each step (0: all training frames, which few views afford)."""
    views_at_once: int = 0
    """Of these, frames whose waves are in memory at a time (0: all)."""
    decay: float = 0.1
    """Share of the rates that is left at the last step (exponential in between)."""
    warmup_steps: int = 0
    """Steps at the start in which only the material moves (amplitudes), as the thesis has it."""
    detach_worst: bool = False
    """The thesis' rule: frames whose loss exceeds the batch's median give no gradient."""
    oversample: int = 0
    """Wave samples per detector pixel (0: from the width of the first fringe)."""
    volume_every: int = 1
    """Steps between evaluations of the terms on the voxelised volume, which are weighted up accordingly."""
    volume_edge: int = 160
    """Voxels along an edge of the (random) block of volume that such a step looks at."""
    validation_views: int = 0
    """Training frames set aside to choose the best state and to stop early."""
    validate_every: int = 25
    """Steps between looks at them."""
    patience: int = 0
    """Looks without improvement before the fit stops (0: never)."""
    seconds: float = 0.0
    """The fit stops after so many seconds, its rates in step with that (0: by steps alone, and then reproducible)."""

    def __post_init__(self) -> None:
        at_least(self, 1, "volume_every", "validate_every")
        at_least(self, 2, "volume_edge")
        require(0 < self.decay <= 1, f"decay must lie in (0, 1], but it is {self.decay}.")

    def with_effort(self, effort: float) -> Schedule:
        """The same with `effort` times the steps, at least one."""
        return replace(self, steps=max(1, round(effort * self.steps)))

    def share(self, step: int, seconds: float) -> float:
        """What share of the fit is done after `step` steps and `seconds` [s]: 1 and it ends."""
        by_time = seconds / self.seconds if self.seconds > 0 else 0.0
        return max(step / self.steps if self.steps else 1.0, by_time)

    def factor(self, step: int, seconds: float) -> float:
        """What the first rates are multiplied by at `step`."""
        by_time = seconds / self.seconds if self.seconds > 0 else 0.0
        return self.decay ** max(step / max(1, self.steps - 1), by_time)
