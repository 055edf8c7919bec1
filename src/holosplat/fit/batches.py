"""Which frames, and which block of volume, each step of a fit looks at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from ..geometry import Grid
from .batch import Batch
from .schedule import Schedule


class Batches:
    """Draws the batches of a fit of `count` frames, reproducibly by its generator.

    grid: the volume whose blocks the terms on the volume look at, or None without such terms.
    """

    def __init__(
        self, count: int, schedule: Schedule, device: torch.device, generator: torch.Generator, grid: Grid | None
    ) -> None:
        self._count, self._schedule, self._device, self._grid = count, schedule, device, grid
        self.generator = generator
        self.order: list[int] = []
        """Frames that are still to be drawn before all have been."""

    def draw(self, step: int, share: float) -> Batch:
        """The batch of `step`, at which `share` of the fit is done."""
        views, every, on = self._views(), self._schedule.volume_every, self._device
        volume = every if self._grid is not None and step % every == 0 else 0
        middle = self._block().centre if volume else np.zeros(3)
        return Batch(
            None if len(views) == self._count else torch.from_numpy(views).to(on, non_blocking=True),
            torch.from_numpy(middle).to(on, non_blocking=True),
            torch.tensor(share).to(on, non_blocking=True),
            volume,
        )

    def parts(self, batch: Batch) -> Iterator[tuple[Batch, float]]:
        """`batch` in parts of few enough frames, and which share of its frames each has."""
        most, count = self._schedule.views_at_once, self._count if batch.index is None else len(batch.index)
        if most <= 0 or count <= most:
            yield batch, 1.0
            return
        every = torch.arange(count, device=self._device) if batch.index is None else batch.index
        for part in every.split(most):
            yield replace(batch, index=part), len(part) / count

    def _views(self) -> np.ndarray:
        """The frames of this step: all, or the next ones of a shuffled order without replacement."""
        count = self._schedule.views_per_step
        if count <= 0 or count >= self._count:
            return np.arange(self._count)
        if len(self.order) < count:  # those left over from the last round come first, and not again in this step
            on = self.generator.device
            fresh: list[int] = torch.randperm(self._count, generator=self.generator, device=on).tolist()
            left = set(self.order)
            self.order += [v for v in fresh if v not in left] + [v for v in fresh if v in left]
        drawn, self.order = self.order[:count], self.order[count:]
        return np.array(sorted(drawn))

    def _block(self) -> Grid:
        """Where this step looks at the volume: all of it, or a random block where it is large."""
        assert self._grid is not None
        shape = block_shape(self._grid, self._schedule)
        free = [n - m for n, m in zip(self._grid.shape, shape)]
        start = [int(torch.randint(f + 1, (1,), generator=self.generator)) for f in free]
        return self._grid.block((start[0], start[1], start[2]), shape)


def block_shape(grid: Grid, schedule: Schedule) -> tuple[int, int, int]:
    """Voxels (z, y, x) of the block of `grid` that a step looks at."""
    z, y, x = (min(n, schedule.volume_edge) for n in grid.shape)
    return z, y, x
