"""The problem of a fit: a model and the terms of its loss, its schedule, the batches of its steps, and steps as CUDA
graphs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ..geometry import Grid
from ..model import Model
from ..ranges import Natural, Several, SomeShare, checked_dataclass


@checked_dataclass
class Schedule:
    """Options of the optimisation loop; the rates themselves belong to the method."""

    steps: int = 300
    """Gradient steps: 200 leave sharp edges unfinished, 400 gain nothing on the cases of the benchmark."""
    views_per_step: int = 0
    """Frames drawn for each step (0: all training frames, which few views afford)."""
    views_at_once: int = 0
    """Of these, frames whose waves are in memory at a time (0: all)."""
    decay: SomeShare = 0.1
    """Share of the rates that is left at the last step (exponential in between)."""
    warmup_steps: int = 0
    """Steps at the start in which only the material moves (amplitudes), as the thesis has it."""
    detach_worst: bool = False
    """The thesis' rule: frames whose loss exceeds the batch's median give no gradient."""
    oversample: int = 0
    """Wave samples per detector pixel (0: from the width of the first fringe)."""
    volume_every: Natural = 1
    """Steps between evaluations of the terms on the voxelised volume, which are weighted up accordingly."""
    volume_edge: Several = 160
    """Voxels along an edge of the (random) block of volume that such a step looks at."""
    validation_views: int = 0
    """Training frames set aside to choose the best state and to stop early."""
    validate_every: Natural = 25
    """Steps between looks at them."""
    patience: int = 0
    """Looks without improvement before the fit stops (0: never)."""
    seconds: float = 0.0
    """The fit stops after so many seconds, its rates in step with that (0: by steps alone, and then reproducible)."""

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


@dataclass(frozen=True)
class Batch:
    """The frames and the block of volume of one step.

    index: frames [K] int64, of one time or several; None for all of them in order
    middle: centre [3] `(x, y, z)` [m] of the block of volume, float64
    progress: share [] of the steps that are done
    volume: weight of the terms on the volume, 0 where this step does not look at it

    The tensors live on the fit's device, where a captured step reads them again.
    """

    index: Tensor | None
    middle: Tensor
    progress: Tensor
    volume: int


class LossPart(NamedTuple):
    """One summand of the loss: `weight · value`, value a tensor []; its name is a column of metrics.csv.

    A weight of None shows a value that is part of another summand already.
    """

    name: str
    weight: float | Tensor | None
    value: Tensor


FIXED: Mapping[str, float] = MappingProxyType({})
"""`Term.resolved` of a term whose weights and widths do not depend on the frames."""


class Term(Protocol):
    """What a model costs in one batch. A term reads the model's frames, its object, its alignment or its light."""

    @property
    def names(self) -> Sequence[str]:
        """The names of all parts that it can have, as columns of metrics.csv."""
        ...

    @property
    def resolved(self) -> Mapping[str, float]:
        """Weights and widths that follow from the frames, by name, for config.json; `FIXED` where there are none."""
        ...

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts of the loss, which are added up; none where the term does not look at this batch.

        Nothing in a call waits for the device or depends on values that are not tensors there, but `batch.volume`.
        """
        ...


@dataclass(frozen=True)
class Problem:
    """What is to be minimised, as plain data.

    model: the model to begin with
    terms: the summands of the loss, in the order in which they are added
    free: names of the parameters that are fitted, such as `object.centres`; None for all of them
    """

    model: Model
    terms: tuple[Term, ...]
    free: tuple[str, ...] | None = None

    def resolved(self) -> dict[str, float]:
        """The weights and widths that options have become by noise, prior and number of views."""
        found: dict[str, float] = {}
        for term in self.terms:
            found |= term.resolved
        return found

    def loss(self, model: Model, batch: Batch) -> tuple[Tensor, Tensor, list[str]]:
        """The loss of `model`; the values [1 + K] of the loss and its parts, detached; and their names."""
        parts = [part for term in self.terms for part in term(model, batch)]
        first, *others = [part.weight * part.value for part in parts if part.weight is not None]
        loss = sum(others, start=first)
        values = torch.stack([loss.detach(), *(part.value.detach() for part in parts)])
        return loss, values, ["loss", *(part.name for part in parts)]


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


Work = Callable[[Batch], Tensor]
"""One step: forward, backward and update of the parameters in place; returns the values [K] of its terms."""

WARM_UP = 3
"""Steps that run eagerly before one is captured: they compile kernels, plan Fourier transforms and fill caches."""


class CapturedStep:
    """Runs `work`, at first eagerly and then as CUDA graphs, one for each kind of step (with and without the volume).

    A graph reads the batch's tensors, and whatever else `work` uses, at the addresses of its capture; `forget` must be
    called before any of them moves (when Gaussians come or go).
    """

    def __init__(self, work: Work) -> None:
        self._work = work
        self._stream = torch.cuda.Stream()
        self._inputs: dict[int, Batch] = {}
        self._eager: dict[int, int] = {}
        self._graphs: dict[int, tuple[torch.cuda.CUDAGraph, Tensor]] = {}

    def forget(self) -> None:
        """Drop all graphs; the next steps warm up anew."""
        self._eager, self._graphs = {}, {}

    def __call__(self, batch: Batch) -> Tensor:
        """The values of one step, in an array of their own."""
        kind = batch.volume
        inputs = self._held(batch)
        if kind not in self._graphs and self._eager.get(kind, 0) >= WARM_UP:
            self._graphs[kind] = self._capture(inputs)
        if kind in self._graphs:
            graph, values = self._graphs[kind]
            graph.replay()
            return values.clone()
        self._eager[kind] = self._eager.get(kind, 0) + 1
        return self._on_stream(inputs)

    def _held(self, batch: Batch) -> Batch:
        """The batch's values in the tensors that the graph of its kind reads."""
        if batch.volume not in self._inputs:
            index = None if batch.index is None else batch.index.clone()
            self._inputs[batch.volume] = replace(
                batch, index=index, middle=batch.middle.clone(), progress=batch.progress.clone()
            )
        held = self._inputs[batch.volume]
        for old, new in ((held.index, batch.index), (held.middle, batch.middle), (held.progress, batch.progress)):
            if old is not None and new is not None:
                old.copy_(new, non_blocking=True)
        return held

    def _on_stream(self, inputs: Batch) -> Tensor:
        # Autograd ties gradients to the stream they first appear on, so warm-up and capture share one.
        current = torch.cuda.current_stream()
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            values = self._work(inputs)
        current.wait_stream(self._stream)
        return values

    def _capture(self, inputs: Batch) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self._stream):
            values = self._work(inputs)
        return graph, values
