"""Training examples (some views of a sample, mirrored and rotated), the loss, the Dice coefficient, validation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from holosplat.geometry import Grid, Views
from holosplat.io.atomic import write_rows
from holosplat.learning.network import FINE, Guess, Taps
from holosplat.learning.start import Card, images, unexplained

from .options import LossWeights, Ranges, ViewSampling
from .sample import Sample, sample_of

UPSIDE_DOWN = np.diag([1.0, -1.0, 1.0])
QUARTER = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""Takes the object frame's z to its x, and x to -z."""


@dataclass(frozen=True)
class TrainingExample:
    """images: [V, 3, H, W]; taps: of the lattice [W/2, H/2, W/2] in images of half as many pixels; occupancy: [W, H, W]
    float32, what the network should say."""

    images: Tensor
    taps: Taps
    occupancy: Tensor

    def on(self, device: str) -> TrainingExample:
        """The same on a device."""
        return TrainingExample(self.images.to(device), self.taps.on(device), self.occupancy.to(device))


def draw_example(sample: Sample, how: ViewSampling, rng: np.random.Generator) -> TrainingExample:
    """`sample` as it is shown once: views are chosen, rows cut out, up and down exchanged, and the object is turned
    about its y axis by quarter turns, all at random."""
    training = np.flatnonzero(~sample.is_test)
    count = min(int(rng.choice(how.views)), len(training))
    pair = count == 2 and rng.random() < how.first_two
    chosen = training[:2] if pair else rng.permutation(training)[:count]
    rows = _rows(sample, how, rng)
    return make_example(sample, chosen, rows, bool(rng.random() < 0.5), int(rng.integers(4)))


def example_of_views(sample: Sample, count: int) -> TrainingExample:
    """The first `count` views for training as they are."""
    return make_example(sample, np.flatnonzero(~sample.is_test)[:count], slice(None), False, 0)


def make_example(
    sample: Sample, views: Sequence[int] | np.ndarray, rows: slice, flipped: bool, turns: int
) -> TrainingExample:
    """Some `views` and some `rows` of `sample`, upside down or not, after quarter turns about y."""
    contrast, thickness = (array[views][:, rows] for array in (sample.contrast, sample.thickness))
    rotations, shifts, occupancy = sample.rotations[views], sample.shifts[views], sample.occupancy[:, rows]
    if flipped:
        contrast, thickness, occupancy = contrast[:, ::-1], thickness[:, ::-1], occupancy[:, ::-1]
        rotations, shifts = UPSIDE_DOWN @ rotations @ UPSIDE_DOWN, shifts * [1, -1]
    for _ in range(turns):
        rotations, occupancy = rotations @ QUARTER.T, occupancy.transpose(2, 1, 0)[::-1]
    h, w = contrast.shape[1:]
    large = Views(rotations, shifts, (h // FINE, w // FINE), float(FINE))
    taps = Taps.of(Grid.centred((w // FINE, h // FINE, w // FINE), float(FINE)), large)
    seen = images(_tensor(contrast), _tensor(thickness), _tensor(sample.noise[views]))
    return TrainingExample(seen, taps, _tensor(occupancy) / 255)


def _rows(sample: Sample, how: ViewSampling, rng: np.random.Generator) -> slice:
    """An even number of rows from an even one on; all of them where beams are tilted."""
    height = sample.contrast.shape[1]
    count = min(int(rng.choice(how.rows)), height) // FINE * FINE
    if not np.allclose(sample.rotations[:, 1], [0, 1, 0]):
        return slice(None)
    first = FINE * int(rng.integers((height - count) // FINE + 1))
    return slice(first, first + count)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def loss(network: Guess, example: TrainingExample, goal: LossWeights) -> tuple[Tensor, Tensor]:
    """The training loss, and the soft Dice coefficient [2] of the guess and of the corrected one."""
    parts, scores = [], []
    for logits in network(example.images, example.taps):
        dice = soft_dice(torch.sigmoid(logits.float()), example.occupancy)
        entropy = binary_cross_entropy_with_logits(logits.float(), example.occupancy)
        parts.append(goal.entropy * entropy + goal.dice * (1 - dice))
        scores.append(dice.detach())
    return goal.first * parts[0] + parts[1], torch.stack(scores)


def soft_dice(guess: Tensor, truth: Tensor) -> Tensor:
    """`(2 Σ ab + 1) / (Σ a² + Σ b² + 1)` of shares a and b; one where both are empty."""
    return (2 * (guess * truth).sum() + 1) / (guess.square().sum() + truth.square().sum() + 1)


def dice(logits: Tensor, truth: Tensor) -> float:
    """The Dice coefficient of voxels of which more than half is matter; one where there are none in either."""
    return share_of_overlap(logits > 0, truth > 0.5)


def share_of_overlap(found: Tensor, there: Tensor) -> float:
    """The Dice coefficient of two masks; one where both are empty."""
    total = int(found.sum() + there.sum())
    return 1.0 if total == 0 else 2 * int((found & there).sum()) / total


COUNTS = (2, 3, 4, 6)
"""Numbers of views."""
OTHER_SEED = 1
"""Added to the seed of the scenes that are learnt from."""
MOST = 95
"""Per cent of the scenes that leave less unexplained than what counts as typical."""
FILE = "validation.csv"


def write_numbers(path: Path, columns: Sequence[str], rows: Sequence[Sequence[float]]) -> None:
    """Write a table of numbers, whole or not at all."""
    write_rows(path, columns, ([f"{value:.6g}" for value in row] for row in rows))


@dataclass
class Judge(ABC):
    """Data that networks were not trained on, and what they scored there: rows of the step and other numbers."""

    columns: ClassVar[tuple[str, ...]]
    """Of the file."""

    samples: Sequence[Any]
    rows: list[tuple[float, ...]] = field(default_factory=list)

    @abstractmethod
    def judge(self, network: nn.Module, step: int) -> None:
        """Rows of scores after `step` steps."""

    def write(self, folder: Path) -> None:
        """Write all rows, whole or not at all."""
        write_numbers(folder / FILE, self.columns, self.rows)


@dataclass
class Validation(Judge):
    """Scenes of another seed, and what networks scored on them: rows of step, number of views, Dice of the guess and of
    the corrected one."""

    columns: ClassVar[tuple[str, ...]] = ("step", "views", "dice_guess", "dice")

    samples: Sequence[Sample]

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
