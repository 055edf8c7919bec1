"""The same flow in richer bases of time and space, which fits then make use of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ..representations import Flow, Lattice, TimeBasis

Change = Callable[[Flow], Flow | None]
"""A flow in a richer basis; None for one that it does not suit."""


def freer_flows(extents: tuple[float, float, float], cells: tuple[int, int], most_degree: int) -> list[Change]:
    """Changes that are tried in turn: a higher degree in time each, then more cells in space.

    extents: of the field `(x, y, z)`; cells: along its longest edge, at first and at most.
    """
    degrees = [lambda f, d=d: of_degree(f, d) if f.basis.degree == d - 1 else None for d in range(1, most_degree + 1)]
    finer = [count for count in (3 * cells[0] // 2, 2 * cells[0]) if count <= cells[1]]
    return [*degrees, *(lambda f, c=c: on_lattice(f, Lattice.around(extents, c)) for c in finer)]


def of_degree(flow: Flow, degree: int) -> Flow:
    """The same flow in a basis of time of a higher degree, which holds it."""
    old = flow.basis
    basis = TimeBasis(old.first, old.last, degree, old.pieces)
    times = np.linspace(old.first, old.last, 4 * (basis.count + old.count))
    weights = old.weights(times)

    def raised(tensor: Tensor) -> Tensor:
        values = np.einsum("tk,k...->t...", weights, tensor.numpy())
        return torch.from_numpy(basis.fitted(times, values)).to(tensor)

    found = {name: raised(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], flow.lattice, basis, flow.reference, flow.steps, found.get("sources"))


def on_lattice(flow: Flow, lattice: Lattice) -> Flow:
    """The least-squares approximation of the same flow on another lattice, along each axis."""
    matrices = []
    for axis in range(3):
        count, first, cell = lattice.counts[2 - axis], lattice.first[axis], lattice.cell
        places = torch.linspace(first, first + cell * (count - 1), 8 * count, dtype=torch.float64)
        points = torch.zeros(len(places), 3, dtype=torch.float64)
        points[:, axis] = places
        old, new = (one.weights(points, axis, 0)[0] for one in (flow.lattice, lattice))
        matrices.append(torch.linalg.lstsq(new, old).solution)
    x, y, z = matrices

    def moved(tensor: Tensor) -> Tensor:
        return torch.einsum("...zyx,cz,by,ax->...cba", tensor.double(), z, y, x).to(tensor)

    found = {name: moved(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], lattice, flow.basis, flow.reference, flow.steps, found.get("sources"))
