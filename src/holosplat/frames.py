"""Frames that are read when they are asked for, so that a series need not fit in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from .checks import require

BLOCK_BYTES = 2**26
"""Frames read at once where all pass by in turn: 64 MB."""

Index = int | slice | np.ndarray | list[int]


class Frames(ABC):
    """N frames [H, W] of float32, read when they are asked for: by number, slice, or array of numbers or bools.

    A subclass sets `shape` and reads. It holds no open file, so that it can be pickled, and used after a fork.
    """

    shape: tuple[int, int, int]
    dtype = np.dtype(np.float32)
    ndim = 3

    @abstractmethod
    def read(self, numbers: np.ndarray) -> np.ndarray:
        """The frames `numbers` [K], of 0 … N - 1 in any order, as float32 [K, H, W], all finite."""
        ...

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Index) -> np.ndarray:
        numbers = np.arange(len(self))[index]
        return self.read(numbers.reshape(-1)).reshape(*numbers.shape, *self.shape[1:])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.read(np.arange(len(self))).astype(dtype or self.dtype, copy=False)


class Picked(Frames):
    """The frames `index` of others."""

    def __init__(self, frames: Frames, index: Index) -> None:
        self._frames = frames
        self._numbers = np.arange(len(frames))[index].reshape(-1)
        self.shape = (len(self._numbers), *frames.shape[1:])

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        return self._frames.read(self._numbers[numbers])


class Cropped(Frames):
    """The rows and columns `rows`, `columns` (from start to stop) of other frames."""

    def __init__(self, frames: Frames, rows: slice, columns: slice) -> None:
        self._frames, self._rows, self._columns = frames, rows, columns
        self.shape = (len(frames), rows.stop - rows.start, columns.stop - columns.start)

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        found = np.empty((len(numbers), *self.shape[1:]), dtype=np.float32)
        for i, n in enumerate(numbers):  # one by one: the whole frames may be larger than memory
            found[i] = self._frames.read(np.array([n]))[0, self._rows, self._columns]
        return found


class Binned(Frames):
    """Other frames on pixels `factor` times larger."""

    def __init__(self, frames: Frames, factor: int) -> None:
        self._frames, self._factor = frames, factor
        self.shape = (len(frames), frames.shape[1] // factor, frames.shape[2] // factor)

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        found = np.empty((len(numbers), *self.shape[1:]), dtype=np.float32)
        for i, n in enumerate(numbers):  # one by one: the fine frames may be larger than memory
            found[i] = binned(self._frames.read(np.array([n])), self._factor)[0]
        return found


class Divided(Frames):
    """Other frames over `light`, [1, H, W] for all or [N, H or 1, W] for each."""

    def __init__(self, frames: Frames, light: np.ndarray) -> None:
        self._frames, self._light = frames, light
        self.shape = frames.shape

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        light = self._light if len(self._light) == 1 else self._light[numbers]
        return self._frames.read(numbers) / light


def divided(frames: np.ndarray | Frames, light: np.ndarray) -> np.ndarray | Frames:
    """Frames over `light`, as `Divided`: of an array at once, of others when they are read."""
    return frames / light if isinstance(frames, np.ndarray) else Divided(frames, light)


def picked(frames: np.ndarray | Frames, index: Index) -> np.ndarray | Frames:
    """The frames `index` [K]: of an array the array's own, of others those that will be read."""
    return frames[index] if isinstance(frames, np.ndarray) else Picked(frames, index)


def binned(frames: np.ndarray, factor: int) -> np.ndarray:
    """Frames [N, H, W] on pixels `factor` times larger (means of `factor × factor`); odd rows and columns are cut.

    The cut is even on both sides, or one pixel more below and on the right.
    """
    (h, w), shape = (n // factor for n in frames.shape[1:]), frames.shape[1:]
    require(min(h, w) > 0, f"frames of {tuple(shape)} pixels cannot be binned by {factor}.")
    top, left = ((n - m * factor) // 2 for n, m in zip(shape, (h, w)))
    cut = frames[:, top : top + h * factor, left : left + w * factor]
    return cut.reshape(len(frames), h, factor, w, factor).mean((2, 4))


def blocks(frames: np.ndarray | Frames) -> Iterator[np.ndarray]:
    """All frames in turn, as arrays [K, H, W] of at most about `BLOCK_BYTES`, at least one frame each."""
    at_once = max(1, BLOCK_BYTES // max(1, 4 * frames.shape[1] * frames.shape[2]))
    for start in range(0, len(frames), at_once):
        yield frames[start : start + at_once]
