"""A model under optimisation: its free parameters, their optimiser, and the one function that resizes both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ..checks import require
from ..model import Model
from .optimiser import Leaves, Optimiser
from .problem import Problem


class Trainable:
    """The model of a problem whose free parameters an optimiser moves; all the others stay as they are.

    optimiser: makes the optimiser of the leaves that it is given. Errors: `InputError` for free names that the
    model lacks.
    """

    def __init__(self, problem: Problem, optimiser: Callable[[Leaves], Optimiser]) -> None:
        every = problem.model.parameters()
        free = tuple(every) if problem.free is None else problem.free
        unknown = sorted(set(free) - set(every))
        require(not unknown, f"free must be names of {', '.join(every)}, but it has {', '.join(unknown)}.")
        self.leaves: Leaves = {name: _leaf(every[name]) for name in free}
        self.model: Model = problem.model.with_parameters(self.leaves)
        self.optimiser = optimiser(self.leaves)

    def resize(self, part: str, keep: Tensor, added: Mapping[str, Tensor] | None = None) -> None:
        """Keep the rows `keep` (indices [K]) of all parameters of `part`, then append the rows `added`.

        added: new rows by name (without the part's own), or None for no new ones. The optimiser's state of rows that
        are kept stays, that of new ones is fresh. All parameters of the part must be free, with as many rows each.
        """
        names = [name for name in self.leaves if name.startswith(f"{part}.")]
        old = {name: self.leaves[name].detach() for name in names}
        fresh = {name: old[name][:0] if added is None else added[name.partition(".")[2]].detach() for name in names}
        for name in names:
            self.leaves[name] = _leaf(torch.cat([old[name][keep], fresh[name]]))
        self.optimiser.resize(names, keep, fresh)
        self.model = self.model.with_parameters({name: self.leaves[name] for name in names})

    def snapshot(self) -> Leaves:
        """Copies of the free parameters as they are now."""
        return {name: leaf.detach().clone() for name, leaf in self.leaves.items()}

    def state_dict(self) -> dict[str, Any]:
        """Parameters and optimiser state, as `load` takes them."""
        parameters = {name: leaf.detach().cpu().clone() for name, leaf in self.leaves.items()}
        return {"parameters": parameters, "optimiser": self.optimiser.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state, with any number of rows."""
        for name, leaf in self.leaves.items():
            self.leaves[name] = _leaf(state["parameters"][name].to(leaf.device, leaf.dtype))
        self.model = self.model.with_parameters(self.leaves)
        self.optimiser.load(state["optimiser"])


def _leaf(parameter: Tensor) -> Tensor:
    return parameter.detach().clone().contiguous().requires_grad_()
