"""A cloud under optimisation: its parameters, their Adam state, and the one function that resizes both."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..representations.gaussians import GaussianCloud


class Trainable:
    """A Gaussian cloud whose parameters Adam (Kingma & Ba 2015) moves, each tensor at its own rate."""

    def __init__(self, cloud: GaussianCloud) -> None:
        self._adopt(cloud, [])

    def _adopt(self, cloud: GaussianCloud, moments: list[dict[str, Any]]) -> None:
        leaves = [p.detach().clone().contiguous().requires_grad_() for p in cloud.parameters]
        self.cloud = cloud.replaced(leaves)
        self.optimiser = torch.optim.Adam([{"params": [leaf]} for leaf in leaves], lr=0.0, eps=1e-12, fused=True)
        for leaf, state in zip(leaves, moments):
            self.optimiser.state[leaf] = state

    def step(self, rates: tuple[float, ...]) -> None:
        """One Adam step with the rates of the four parameters; clears the gradients."""
        for group, rate in zip(self.optimiser.param_groups, rates):
            group["lr"] = rate
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)

    def resize(self, keep: Tensor, added: tuple[Tensor, ...] | None = None) -> None:
        """Keep the Gaussians `keep` (indices [K]) with their optimiser state, then append `added` with a fresh one.

        added: the four parameter tensors of the new Gaussians, or None.
        """
        old = self.cloud.parameters
        fresh = added or tuple(p.detach()[:0] for p in old)
        parameters = [torch.cat([p.detach()[keep], a.detach()]) for p, a in zip(old, fresh)]
        moments = [self._resized_moments(p, keep, a) for p, a in zip(old, fresh)]
        self._adopt(self.cloud.replaced(parameters), [m for m in moments if m])

    def _resized_moments(self, parameter: Tensor, keep: Tensor, added: Tensor) -> dict[str, Any]:
        state = self.optimiser.state.get(parameter, {})
        return {
            name: torch.cat([value[keep], torch.zeros_like(added)]) if value.dim() > 0 else value.clone()
            for name, value in state.items()
        }

    def state_dict(self) -> dict[str, Any]:
        """Parameters and optimiser state, as `load` takes them."""
        moments = [_copied(self.optimiser.state.get(p, {})) for p in self.cloud.parameters]
        return {"parameters": [p.detach().clone() for p in self.cloud.parameters], "moments": moments}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state (of any number of Gaussians)."""
        self._adopt(self.cloud.replaced(state["parameters"]), [_copied(m) for m in state["moments"] if m])


def _copied(moments: dict[str, Any]) -> dict[str, Any]:
    return {name: value.clone() for name, value in moments.items()}
