"""A cloud under optimisation: its parameters, their Adam state, and the one function that resizes both."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..representations.gaussians import GaussianCloud
from . import adam

EPSILON = 1e-12
"""Small beside any gradient: Adam's steps do not depend on the loss' scale."""

Moments = dict[str, Tensor]
"""One parameter's Adam state: `step`, `exp_avg`, `exp_avg_sq`; empty before the first step."""


class Trainable:
    """A Gaussian cloud whose parameters Adam (Kingma & Ba 2015) moves, each tensor at its own rate.

    backend: what runs it (see `fit.adam`), where the cloud's tensors live.
    """

    def __init__(self, cloud: GaussianCloud, backend: str = "cpu") -> None:
        self.backend, self._count = backend, 0
        self._factors = adam.factors([0.0] * len(cloud.parameters), 1, EPSILON).to(cloud.centres.device)
        self._adopt(cloud, [{} for _ in cloud.parameters])

    def _adopt(self, cloud: GaussianCloud, moments: list[Moments]) -> None:
        leaves = [p.detach().clone().contiguous().requires_grad_() for p in cloud.parameters]
        self.cloud = cloud.replaced(leaves)
        self._first, self._second = (
            [_copied(leaf, state.get(name)) for leaf, state in zip(leaves, moments)]
            for name in ("exp_avg", "exp_avg_sq")
        )

    def step(self, rates: tuple[float, ...]) -> None:
        """One Adam step with the rates of the four parameters; clears the gradients."""
        self.prepare(rates)
        self.apply()

    def prepare(self, rates: tuple[float, ...]) -> None:
        """The first half of `step`: counts it, and takes its rates to the device."""
        self._count += 1
        self._factors.copy_(adam.factors(rates, self._count, EPSILON), non_blocking=True)

    def apply(self) -> None:
        """The second half of `step`, which runs on the device alone. Parameters without a gradient stay as they are."""
        leaves = self.cloud.parameters
        moved = [k for k, leaf in enumerate(leaves) if leaf.grad is not None]
        gradients = [g for g in (leaf.grad for leaf in leaves) if g is not None]
        groups = ([arrays[k] for k in moved] for arrays in ([p.detach() for p in leaves], self._first, self._second))
        parameters, first, second = groups
        factors = self._factors if len(moved) == len(leaves) else self._factors[[*moved, -1]]
        adam.step(parameters, gradients, first, second, factors, self.backend)
        for leaf in leaves:
            leaf.grad = None

    def resize(self, keep: Tensor, added: tuple[Tensor, ...] | None = None) -> None:
        """Keep the Gaussians `keep` (indices [K]) with their optimiser state, then append `added` with a fresh one.

        added: the four parameter tensors of the new Gaussians, or None.
        """
        old = self.cloud.parameters
        fresh = added or tuple(p.detach()[:0] for p in old)
        parameters = [torch.cat([p.detach()[keep], a.detach()]) for p, a in zip(old, fresh)]
        moments = [
            {"exp_avg": _resized(m, keep, a), "exp_avg_sq": _resized(v, keep, a)}
            for m, v, a in zip(self._first, self._second, fresh)
        ]
        self._adopt(self.cloud.replaced(parameters), moments)

    def state_dict(self) -> dict[str, Any]:
        """Parameters and optimiser state, as `load` takes them."""
        moments: list[Moments] = [
            {"step": torch.tensor(float(self._count)), "exp_avg": m.cpu().clone(), "exp_avg_sq": v.cpu().clone()}
            for m, v in zip(self._first, self._second)
        ]
        parameters = [p.detach().cpu().clone() for p in self.cloud.parameters]
        return {"parameters": parameters, "moments": moments if self._count else [{} for _ in moments]}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state (of any number of Gaussians)."""
        moments: list[Moments] = state["moments"]
        self._count = max((int(m["step"]) for m in moments if m), default=0)
        parameters = [saved.to(p.device, p.dtype) for saved, p in zip(state["parameters"], self.cloud.parameters)]
        self._adopt(self.cloud.replaced(parameters), moments)


def _resized(moment: Tensor, keep: Tensor, added: Tensor) -> Tensor:
    return torch.cat([moment[keep], torch.zeros_like(added)])


def _copied(leaf: Tensor, moment: Tensor | None) -> Tensor:
    """The moment of a parameter in memory of its own, as the parameter is held; zeros for None."""
    return torch.zeros_like(leaf) if moment is None else torch.empty_like(leaf).copy_(moment)
