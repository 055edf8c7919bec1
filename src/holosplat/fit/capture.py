"""A step of the fit as a CUDA graph: captured once, replayed without a word from the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from .batch import Batch

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
