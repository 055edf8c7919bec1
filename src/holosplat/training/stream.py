"""Scenes for learning as a `torch` dataset: simulated when they are asked for, and the same for ever."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from ..checks import require
from .folder import Dataset
from .ranges import Ranges
from .sample import Sample, sample_of

Tensors = dict[str, Tensor]
"""The arrays of a `Sample` by their names."""
ENDLESS = 2**31
"""Scenes of a seed: nobody draws so many."""


class Scenes(TorchDataset[Any]):
    """Scenes 0 … count - 1 of `seed`, drawn from `ranges` and simulated one by one, without a folder.

    A scene is that of its number and seed whatever else is asked for, in whatever order and process, so that a
    `DataLoader` may shuffle them and simulate in several workers. An item is a dictionary of tensors, the arrays of
    `Sample` by name and shape, or what `shown` makes of the sample. Errors: `IndexError` beyond the last scene.
    """

    def __init__(
        self, ranges: Ranges, seed: int = 0, count: int = ENDLESS, shown: Callable[[Sample], Any] | None = None
    ) -> None:
        require(1 <= count <= ENDLESS, f"count must lie between 1 and {ENDLESS}, but it is {count}; correct it.")
        self.ranges, self.seed, self.count, self.shown = ranges, seed, count, shown

    @classmethod
    def of_folder(cls, folder: Path, shown: Callable[[Sample], Any] | None = None) -> Scenes:
        """Those of a folder of `holosplat dataset`, from its files; `InputError` where it is none, or not whole."""
        dataset = Dataset.read(folder)
        dataset.require_whole()
        return _Kept(dataset, shown)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Any:
        number = int(index) + self.count * (index < 0)
        if not 0 <= number < self.count:
            raise IndexError(f"scenes are numbered from 0 to {self.count - 1}, but {index} is asked for")
        sample = self._sample(number)
        return tensors_of(sample) if self.shown is None else self.shown(sample)

    def _sample(self, number: int) -> Sample:
        return sample_of(self.ranges, self.seed, number)


class _Kept(Scenes):
    """The same, read from files."""

    def __init__(self, dataset: Dataset, shown: Callable[[Sample], Any] | None) -> None:
        super().__init__(dataset.ranges, dataset.seed, dataset.count, shown)
        self._dataset = dataset

    def _sample(self, number: int) -> Sample:
        return self._dataset.sample(number)


def tensors_of(sample: Sample) -> Tensors:
    """The arrays of `sample` as tensors of their own."""
    return {name: torch.from_numpy(np.array(getattr(sample, name))) for name in Sample.names()}
