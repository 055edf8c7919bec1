"""Where frames are beside matter of any kind that stays as it is: its own projections, moved by small steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..model import Alignment, Instrument, Model
from ..progress import Advance
from ..representations import Stored
from ..scan import Exposures
from .derivatives import NUMBERS, Predicted
from .newton import Normal, Step, step

SMALL = (0.05, 0.05, 1e-3, 1e-3, 1e-3, 0.01, 1e-3)
"""Steps by which derivatives of frames are taken: shifts [pixels], turns [rad], logarithms of distance and
magnification."""
BLUR = 0.5
"""Frames are compared after a Gaussian of this standard deviation [pixels]: edges are sharp."""
STEPS = 3
"""Newton's steps, from poses that are right to some tenths of a pixel."""


def aligned(numbers: Tensor) -> Alignment:
    """The corrections that `numbers` [V, 8] of `NUMBERS` are."""
    magnified = numbers[:, 6].exp() - 1 if bool((numbers[:, 6] != 0).any()) else None
    return Alignment(numbers[:, 2:5], numbers[:, :2], numbers[:, 5].exp() - 1, magnified=magnified)


class Beside:
    """Frames of `matter`, and how they change with the numbers of `planned` exposures."""

    def __init__(self, matter: Stored, planned: Exposures, oversample: int) -> None:
        self._parts = [
            Model(matter, Instrument(planned[[v]], oversample, backend=matter.backend)) for v in range(len(planned))
        ]

    def predicted(self, numbers: Tensor, magnified: bool = False) -> Predicted:
        """Frames at `numbers` [V, 8], and their derivatives by one-sided differences; view by view to bound memory.

        magnified: whether the derivative by the magnification is asked for, else it is zero.
        """
        steps = SMALL if magnified else SMALL[:-1]
        views = [_one(part, numbers[[v]], steps) for v, part in enumerate(self._parts)]
        return Predicted(torch.stack([frame for frame, _ in views]), torch.stack([slopes for _, slopes in views]))

    def frames(self, numbers: Tensor) -> Tensor:
        """Frames [V, H, W] at `numbers`."""
        with torch.no_grad():
            return torch.stack([_frame(part, numbers[[v]]) for v, part in enumerate(self._parts)])

    def placed(
        self,
        measured: Tensor,
        numbers: Tensor,
        expected: Tensor,
        steps: int = STEPS,
        tell: Advance = lambda part: None,
    ) -> Step:
        """The numbers of `measured` frames [V, H, W] after some steps from `numbers`, with their covariances.

        expected: standard deviations [8] about the plan, 0 for what stays. No steps at all: covariances where they are.
        """
        found = Step(numbers, torch.zeros(len(numbers), len(NUMBERS), len(NUMBERS), dtype=torch.float64))
        for done in range(max(1, steps)):
            normal = Normal.of(measured, self.predicted(found.numbers, bool(expected[6] > 0)), BLUR)
            moved = step(normal, found.numbers, expected)
            found = moved if steps else replace(moved, numbers=numbers)
            tell((done + 1) / max(1, steps))
        return found


@torch.no_grad()
def _one(model: Model, numbers: Tensor, steps: Sequence[float]) -> tuple[Tensor, Tensor]:
    """The frame [H, W] of one view, and its derivatives [8, H, W]."""
    here, slopes = _frame(model, numbers), list[Tensor]()
    for k, small in enumerate(steps):
        moved = numbers.clone()
        moved[:, k] += small
        slopes.append((_frame(model, moved) - here) / small)
    slopes += [torch.zeros_like(here)] * (len(SMALL) - len(steps))
    return here, torch.stack([*slopes, here])


def _frame(model: Model, numbers: Tensor) -> Tensor:
    frames = replace(model, alignment=aligned(numbers)).frames()[0].cpu()
    return frames * float(numbers[0, -1].exp())
