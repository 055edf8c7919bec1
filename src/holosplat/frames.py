"""Frames that are read when they are asked for, so that a series need not fit in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .checks import require

BLOCK_BYTES = 2**26
"""Frames read at once where all pass by in turn: 64 MB."""

Index = int | slice | np.ndarray | list[int]
Taken = tuple[np.ndarray, np.ndarray | None]
"""Frames [K, H, W], and which of their pixels have no value of their own, [K, H, W] bool; None: all have one."""


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

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """The frames `numbers`, and the pixels [K, H, W] bool that have no value of their own; None where all have
        one."""
        return self.read(numbers), None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Index) -> np.ndarray:
        numbers = np.arange(len(self))[index]
        return self.read(numbers.reshape(-1)).reshape(*numbers.shape, *self.shape[1:])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.read(np.arange(len(self))).astype(dtype or self.dtype, copy=False)


class Derived(Frames):
    """Frames made from others, with the pixels that have no value."""

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        return self.with_missing(numbers)[0]


class Picked(Derived):
    """The frames `index` of others."""

    def __init__(self, frames: Frames, index: Index) -> None:
        self._frames = frames
        self._numbers = np.arange(len(frames))[index].reshape(-1)
        self.shape = (len(self._numbers), *frames.shape[1:])

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        return self._frames.with_missing(self._numbers[numbers])


class Cropped(Derived):
    """The rows and columns `rows`, `columns` (from start to stop) of other frames."""

    def __init__(self, frames: Frames, rows: slice, columns: slice) -> None:
        self._frames, self._rows, self._columns = frames, rows, columns
        self.shape = (len(frames), rows.stop - rows.start, columns.stop - columns.start)

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""

        def kept(frames: np.ndarray, missing: np.ndarray | None) -> Taken:
            place = (slice(None), self._rows, self._columns)
            return frames[place], None if missing is None else missing[place]

        return by_blocks(self._frames, kept, numbers, self.shape[1:])


class Binned(Derived):
    """Other frames on pixels `factor` times larger."""

    def __init__(self, frames: Frames, factor: int) -> None:
        require_factor(frames.shape[1:], factor)
        self._frames, self._factor = frames, factor
        self.shape = (len(frames), frames.shape[1] // factor, frames.shape[2] // factor)

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        factor = self._factor
        return by_blocks(
            self._frames, lambda frames, missing: binned_measured(frames, missing, factor), numbers, self.shape[1:]
        )


class Divided(Derived):
    """Other frames over `light`, [1, H, W] for all or [N, H or 1, W] for each."""

    def __init__(self, frames: Frames, light: np.ndarray) -> None:
        self._frames, self._light = frames, light
        self.shape = frames.shape

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        light = self._light if len(self._light) == 1 else self._light[numbers]
        frames, missing = self._frames.with_missing(numbers)
        return frames / light, missing


def by_blocks(
    source: Frames, made: Callable[[np.ndarray, np.ndarray | None], Taken], numbers: np.ndarray, shape: tuple[int, int]
) -> Taken:
    """What `made` makes of some frames of `source` and their missing pixels at a time, [K, H, W], for all `numbers`."""
    frames, missing = np.empty((len(numbers), *shape), dtype=np.float32), None
    for part in parts_of(source, len(numbers)):
        frames[part], lacks = made(*source.with_missing(numbers[part]))
        if lacks is not None:
            missing = np.zeros(frames.shape, dtype=bool) if missing is None else missing
            missing[part] = lacks
    return frames, missing


def divided(frames: np.ndarray | Frames, light: np.ndarray) -> np.ndarray | Frames:
    """Frames over `light`, as `Divided`: of an array at once, of others when they are read."""
    return frames / light if isinstance(frames, np.ndarray) else Divided(frames, light)


def picked(frames: np.ndarray | Frames, index: Index) -> np.ndarray | Frames:
    """The frames `index` [K]: of an array the array's own, of others those that will be read."""
    return frames[index] if isinstance(frames, np.ndarray) else Picked(frames, index)


def require_factor(shape: tuple[int, ...], factor: int) -> None:
    """`InputError` for a factor of larger pixels that frames of `shape` (H, W) cannot be binned by."""
    most = min(shape)
    require(1 <= factor <= most, f"frames of {tuple(shape)} pixels are binned by 1 to {most}, but not by {factor}.")


def binned(frames: np.ndarray, factor: int) -> np.ndarray:
    """Frames [N, H, W] on pixels `factor` times larger (means of `factor × factor`); odd rows and columns are cut.

    The cut is even on both sides, or one pixel more below and on the right.
    """
    shape = frames.shape[1:]
    require_factor(shape, factor)
    top, left = (n % factor // 2 for n in shape)
    return block_means(frames[:, top:, left:], factor)


def block_means(images: np.ndarray, factor: int) -> np.ndarray:
    """Means of images [..., H, W] over `factor × factor` pixels; rows and columns at the end that do not fill one are
    cut."""
    *before, h, w = images.shape
    h, w = h // factor, w // factor
    return images[..., : h * factor, : w * factor].reshape(*before, h, factor, w, factor).mean((-3, -1))


def binned_measured(frames: np.ndarray, missing: np.ndarray | None, factor: int) -> Taken:
    """As `binned`, the means of those pixels alone that have a value; a pixel made of none has none."""
    if missing is None:
        return binned(frames, factor), None
    known = binned((~missing).astype(np.float32), factor)
    sums, none = binned(np.where(missing, 0, frames), factor), known == 0
    return np.where(none, binned(frames, factor), sums / np.where(none, 1, known)), none if none.any() else None


def evenly(count: int, most: int) -> np.ndarray:
    """At most `most` of the numbers from 0 to `count` - 1, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def rfft_weights(width: int) -> np.ndarray:
    """[W//2 + 1] how many frequencies of real images, `width` = W pixels wide, each column of their `rfft2` stands for:
    the conjugate half is not stored, beside columns that are their own conjugates."""
    own = np.arange(width // 2 + 1) % (width / 2) == 0
    return np.where(own, 1.0, 2.0)


def parts_of(frames: np.ndarray | Frames, count: int) -> Iterator[slice]:
    """Slices of `count` numbers, each of so many frames as have about `BLOCK_BYTES`, at least one."""
    at_once = max(1, BLOCK_BYTES // max(1, 4 * frames.shape[1] * frames.shape[2]))
    for start in range(0, count, at_once):
        yield slice(start, min(start + at_once, count))
