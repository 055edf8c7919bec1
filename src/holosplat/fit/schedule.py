"""How the fit proceeds: steps, views a step, learning rates, warm-up, validation."""

from __future__ import annotations

from dataclasses import dataclass

from ..checks import at_least, require


@dataclass(frozen=True)
class Schedule:
    """Options of the optimisation loop.

    steps: gradient steps; views_per_step: views drawn for each (0: all training views);
    rate_*: Adam's rates at the start, lengths in detector pixels, the others relative; `decay`: the fraction of
    the rates that is left at the last step (exponential in between);
    warmup_steps: steps at the start in which only the material (amplitudes) moves;
    detach_worst: the thesis' rule, views whose loss exceeds the batch's median give no gradient;
    oversample: wave samples per detector pixel (0: from the width of the first fringe);
    volume_every: steps between evaluations of the terms on the voxelised volume (weighted up accordingly);
    volume_edge: voxels along an edge of the (random) block of volume that such a step looks at;
    validation_views: training views set aside to choose the best state and to stop early; validate_every:
    steps between looks at them; patience: looks without improvement before the fit stops (0: never).
    """

    steps: int = 400
    views_per_step: int = 0
    rate_position: float = 0.02
    rate_scale: float = 0.01
    rate_rotation: float = 0.01
    rate_amplitude: float = 0.02
    decay: float = 0.1
    warmup_steps: int = 0
    detach_worst: bool = False
    oversample: int = 0
    volume_every: int = 1
    volume_edge: int = 160
    validation_views: int = 0
    validate_every: int = 25
    patience: int = 0

    def __post_init__(self) -> None:
        at_least(self, 0, "steps", "views_per_step", "warmup_steps", "oversample", "validation_views", "patience")
        at_least(self, 1, "volume_every", "validate_every")
        at_least(self, 2, "volume_edge")
        require(0 < self.decay <= 1, f"decay must lie in (0, 1], but it is {self.decay}.")

    def rates(self, step: int) -> tuple[float, float, float, float]:
        """Learning rates of centres, log-scales, quaternions and amplitudes at `step`."""
        factor = self.decay ** (step / max(1, self.steps - 1))
        moving = 0.0 if step < self.warmup_steps else factor
        return (
            self.rate_position * moving,
            self.rate_scale * moving,
            self.rate_rotation * moving,
            self.rate_amplitude * factor,
        )
