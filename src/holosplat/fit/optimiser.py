"""Adam over named parameters with options of single groups, and a model whose free parameters it moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from ..checks import require
from ..model import Model
from ..ranges import checked_dataclass
from . import adam
from .problem import Problem

EPSILON = 1e-12
"""Small beside any gradient: Adam's steps do not depend on the loss' scale."""

Leaves = dict[str, Tensor]
"""The parameters of a fit by name, each with `requires_grad`; whoever resizes them replaces the entries."""


class Optimiser(Protocol):
    """Moves the leaves of a fit by their gradients."""

    def prepare(self, rates: Mapping[str, float]) -> None:
        """The part of a step that runs on the host: counts it, and takes the rate of each parameter to the device."""
        ...

    def apply(self, loss: Tensor) -> None:
        """The part that runs on the device: moves the leaves in place by their `grad`, and clears it."""
        ...

    @property
    def settled(self) -> bool:
        """Whether further steps are not worth it, where the optimiser knows; the fit then ends."""
        ...

    def best(self) -> Leaves | None:
        """The best parameters so far, where the optimiser keeps them; None where the last ones count."""
        ...

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """The leaves `names` were replaced by their rows `keep` [K] and the rows `added`: the state follows."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The state, in main memory."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state, of leaves that have their saved shapes already."""
        ...


@checked_dataclass
class Group:
    """How Adam moves one parameter where that differs from its default.

    betas: decay of the running means of the gradient and of its square
    epsilon: number beside the root of the mean square
    decay: share of the parameter that a step takes away, per unit of its rate (Loshchilov & Hutter 2019)
    solve: preconditioner, the gradient [same shape] in, a direction out; None for the gradient itself
    together: one step length for the whole tensor, by its largest squared entry (Nicolet, Jacobson & Jakob 2021,
        "Large steps in inverse rendering of geometry")
    """

    betas: tuple[float, float] = adam.BETAS
    epsilon: float = EPSILON
    decay: float = 0.0
    solve: Callable[[Tensor], Tensor] | None = None
    together: bool = False


class Apart:
    """Two optimisers: one of the leaves whose names begin with `prefix`, and one of all others.

    inner, outer: make those of the former and of the latter. The best parameters are those of `outer`, where it keeps
    them, beside the last ones of `inner`.
    """

    def __init__(
        self,
        leaves: Leaves,
        prefix: str,
        inner: Callable[[Leaves], Optimiser],
        outer: Callable[[Leaves], Optimiser],
    ) -> None:
        self._leaves = leaves
        self._own = [{n: leaf for n, leaf in leaves.items() if n.startswith(prefix) == mine} for mine in (True, False)]
        self._parts = [make(own) for make, own in zip((inner, outer), self._own)]

    def _refresh(self) -> None:
        """Whoever resizes or loads leaves replaces their entries."""
        for own in self._own:
            own.update({name: self._leaves[name] for name in own})

    def prepare(self, rates: Mapping[str, float]) -> None:
        """See `Optimiser`."""
        for part in self._parts:
            part.prepare(rates)

    def apply(self, loss: Tensor) -> None:
        """See `Optimiser`."""
        for part in self._parts:
            part.apply(loss)

    @property
    def settled(self) -> bool:
        """See `Optimiser`."""
        return all(part.settled for part in self._parts)

    def best(self) -> Leaves | None:
        """See `Optimiser`."""
        found = self._parts[1].best()
        return None if found is None else {**found, **{n: leaf.detach().clone() for n, leaf in self._own[0].items()}}

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """See `Optimiser`."""
        self._refresh()
        for own, part in zip(self._own, self._parts):
            if mine := [name for name in names if name in own]:
                part.resize(mine, keep, added)

    def state_dict(self) -> dict[str, Any]:
        """See `Optimiser`."""
        return {name: part.state_dict() for name, part in zip(("inner", "outer"), self._parts)}

    def load(self, state: dict[str, Any]) -> None:
        """See `Optimiser`."""
        self._refresh()
        for name, part in zip(("inner", "outer"), self._parts):
            part.load(state[name])


class Adam:
    """Adam (Kingma & Ba 2015) over named parameters, each at its own rate.

    backend: what runs it (see `fit.adam`), but for special groups and what its kernels do not take (float64), which
    plain torch moves; groups: what differs from the default, by parameter. All that changes between steps lies on the
    device, so that `apply` can be captured.
    """

    def __init__(self, leaves: Leaves, backend: str = "cpu", groups: Mapping[str, Group] | None = None) -> None:
        self._leaves, self._backend, self._count = leaves, backend, 0
        exact = [n for n, leaf in leaves.items() if backend != "reference" and leaf.dtype != torch.float32]
        self._groups = {**dict.fromkeys(exact, Group()), **(groups or {})}
        self._fused = [name for name in leaves if name not in self._groups]
        device = next(iter(leaves.values())).device
        self._factors = adam.factors([0.0] * len(self._fused), 1, EPSILON).to(device)
        self._special = torch.zeros(len(self._groups), 3, dtype=torch.float64, device=device)
        """Rate, and what the two running means fall short of, of every group."""
        self._first = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
        self._second = {name: self._spread(name, leaf) for name, leaf in leaves.items()}

    def _spread(self, name: str, leaf: Tensor) -> Tensor:
        together = name in self._groups and self._groups[name].together
        return torch.zeros((), dtype=leaf.dtype, device=leaf.device) if together else torch.zeros_like(leaf)

    def prepare(self, rates: Mapping[str, float]) -> None:
        """See `Optimiser`; a parameter without a rate stays where it is."""
        self._count += 1
        factors = adam.factors([rates.get(name, 0.0) for name in self._fused], self._count, EPSILON)
        self._factors.copy_(factors, non_blocking=True)
        if self._groups:
            rows = [(rates.get(n, 0.0), *(1 - b**self._count for b in g.betas)) for n, g in self._groups.items()]
            self._special.copy_(torch.tensor(rows, dtype=torch.float64), non_blocking=True)

    def apply(self, loss: Tensor) -> None:
        """See `Optimiser`. Parameters without a gradient stay as they are."""
        moved = [k for k, name in enumerate(self._fused) if self._leaves[name].grad is not None]
        if moved:
            names = [self._fused[k] for k in moved]
            gradients = [g for name in names if (g := self._leaves[name].grad) is not None]
            parameters = [self._leaves[name].detach() for name in names]
            first, second = ([state[name] for name in names] for state in (self._first, self._second))
            factors = self._factors if len(moved) == len(self._fused) else self._factors[[*moved, -1]]
            adam.step(parameters, gradients, first, second, factors, self._backend)
        for (name, group), factors in zip(self._groups.items(), self._special):
            if self._leaves[name].grad is not None:
                self._apply_special(name, group, factors)
        for leaf in self._leaves.values():
            leaf.grad = None

    @torch.no_grad()
    def _apply_special(self, name: str, group: Group, factors: Tensor) -> None:
        leaf, (slow, slower), (rate, short, shorter) = self._leaves[name], group.betas, factors
        assert leaf.grad is not None
        gradient = leaf.grad if group.solve is None else group.solve(leaf.grad)
        square = gradient.square().max() if group.together else gradient.square()
        self._first[name].mul_(slow).add_(gradient, alpha=1 - slow)
        self._second[name].mul_(slower).add_(square, alpha=1 - slower)
        first, second = self._first[name] / short, self._second[name] / shorter
        leaf.mul_(1 - rate * group.decay).sub_(rate * first / (second.sqrt() + group.epsilon))

    @property
    def settled(self) -> bool:
        """Never: it has rates that end."""
        return False

    def best(self) -> None:
        """None: the last parameters count."""

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """See `Optimiser`; what is added starts without a history."""
        for name in names:
            for state in (self._first, self._second):
                state[name] = torch.cat([state[name][keep], torch.zeros_like(added[name])])

    def state_dict(self) -> dict[str, Any]:
        """See `Optimiser`."""
        first, second = ({n: s.cpu().clone() for n, s in state.items()} for state in (self._first, self._second))
        return {"count": self._count, "first": first, "second": second}

    def load(self, state: dict[str, Any]) -> None:
        """See `Optimiser`."""
        self._count = int(state["count"])
        for mine, name in ((self._first, "first"), (self._second, "second")):
            for key, leaf in self._leaves.items():
                mine[key] = state[name][key].to(leaf.device, leaf.dtype, copy=True)


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
