"""How a network does on scenes of another seed, while it learns and at its end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from ..io.atomic import write_rows
from ..learning.network import Guess
from ..learning.start import unexplained
from ..learning.weights import Card
from .ranges import Ranges
from .sample import Sample, sample_of
from .shown import dice, example_of_views

COUNTS = (2, 3, 4, 6)
"""Numbers of views."""
OTHER_SEED = 1
"""Added to the seed of the scenes that are learnt from."""
MOST = 95
"""Per cent of the scenes that leave less unexplained than what counts as typical."""
FILE = "validation.csv"
COLUMNS = ("step", "views", "dice_guess", "dice")


@dataclass
class Validation:
    """Scenes of another seed, and what networks scored on them: rows of step, number of views, Dice of the guess and of
    the corrected one."""

    columns: ClassVar[tuple[str, ...]] = COLUMNS
    """Of the file."""

    samples: Sequence[Sample]
    rows: list[tuple[float, ...]] = field(default_factory=list)

    @classmethod
    def of(cls, ranges: Ranges, seed: int, count: int, on_progress: Callable[[float], None]) -> Validation:
        """The first `count` scenes of the seed that follows `seed`, simulated."""
        samples = []
        for index in range(count):
            samples.append(sample_of(ranges, seed + OTHER_SEED, index))
            on_progress((index + 1) / count)
        return cls(samples)

    def judge(self, network: nn.Module, step: int) -> None:
        """A row for each number of views."""
        for count in self._counts():
            scores = [self._scores(network, sample, count)[:2] for sample in self.samples]
            self.rows.append((step, count, *np.mean(scores, axis=0)))

    def last(self) -> str:
        """The newest rows in words."""
        counts = len(self._counts())
        return ", ".join(f"{int(views)} views {best:.3f}" for _, views, _, best in self.rows[-counts:])

    def write(self, folder: Path) -> None:
        """Write all rows, whole or not at all."""
        write_rows(folder / FILE, self.columns, ([f"{value:.6g}" for value in row] for row in self.rows))

    def card(self, network: nn.Module, trained_on: dict[str, Any], made_by: dict[str, str]) -> Card:
        """What `network` scores here, as a card."""
        scores, typical = {}, {}
        for count in self._counts():
            found = np.array([self._scores(network, sample, count) for sample in self.samples])
            scores[str(count)] = {"dice": float(found[:, 1].mean()), "scenes": float(len(found))}
            typical[str(count)] = float(np.percentile(found[:, 2], MOST))
        return Card(trained_on, {}, made_by, scores, typical)

    def _counts(self) -> list[int]:
        most = min(int((~sample.is_test).sum()) for sample in self.samples)
        return [count for count in COUNTS if count <= most]

    def _scores(self, network: nn.Module, sample: Sample, count: int) -> tuple[float, float, float]:
        """Dice of the guess and of the corrected one from the first `count` views, and what that leaves unexplained."""
        assert isinstance(network, Guess)
        shown = example_of_views(sample, count).on(str(next(network.parameters()).device))
        with torch.inference_mode():
            first, second = network(shown.images, shown.taps)
            left = unexplained(torch.sigmoid(second), shown.images, shown.taps)
        return dice(first, shown.occupancy), dice(second, shown.occupancy), left
