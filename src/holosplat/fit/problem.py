"""`Problem`: a model, and the terms whose sum its parameters are to make small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..model import Model
from .batch import Batch


class Part(NamedTuple):
    """One summand of the loss: `weight · value`, value a tensor []; its name is a column of metrics.csv.

    A weight of None shows a value that is part of another summand already.
    """

    name: str
    weight: float | Tensor | None
    value: Tensor


class Term(Protocol):
    """What a model costs in one batch. A term reads the model's frames, its object, its alignment or its light.

    A term whose weights or widths follow from the frames says them in `resolved`, name → number, for config.json.
    """

    @property
    def names(self) -> Sequence[str]:
        """The names of all parts that it can have, as columns of metrics.csv."""
        ...

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
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
            found |= getattr(term, "resolved", {})
        return found

    def loss(self, model: Model, batch: Batch) -> tuple[Tensor, Tensor, list[str]]:
        """The loss of `model`; the values [1 + K] of the loss and its parts, detached; and their names."""
        parts = [part for term in self.terms for part in term(model, batch)]
        first, *others = [part.weight * part.value for part in parts if part.weight is not None]
        loss = sum(others, start=first)
        values = torch.stack([loss.detach(), *(part.value.detach() for part in parts)])
        return loss, values, ["loss", *(part.name for part in parts)]
