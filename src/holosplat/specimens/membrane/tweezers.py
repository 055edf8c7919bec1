"""A cell stretched in optical tweezers: the test that every membrane model is put to.

Two beads stick to opposite ends of the rim and are pulled apart (Dao, Lim & Suresh 2003, J. Mech. Phys. Solids 51,
2259; Mills et al. 2004, Mech. Chem. Biosyst. 1, 169). The cell is so slow to be pulled that it is always at rest:
at each force the shape is the one of least energy, found from the shape at the force before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize

from ...checks import InputError, in_range, require
from .model import Membrane

LENGTH, ENERGY = 1e-6, 1e-18
"""Units of the search: µm and pN µm."""
OPTIONS = {"maxiter": 20_000, "maxfun": 40_000, "maxcor": 30, "ftol": 0.0, "gtol": 1e-3}
RESTARTS = 10
RESIDUAL = 5e-15
"""Greatest force left on a node of a cell at rest [N]; the loads are some pN a node."""


@dataclass(frozen=True)
class Stretched:
    """A cell under one force: force [N]; axial and transverse: its extents along and across the pull [m], as seen
    along its axis; area and volume: relative changes against rest; residual: greatest force left on a node [N]."""

    force: float
    axial: float
    transverse: float
    area: float
    volume: float
    residual: float
    nodes: torch.Tensor


def stretch(membrane: Membrane, forces: Sequence[float], patch: float = 0.05) -> list[Stretched]:
    """`membrane`, a cell with its axis along z, pulled along ±x by each of `forces` [N] in turn, which must rise.

    patch: the fraction of nodes at either end that share the force evenly. `InputError` where the search for the shape
    at rest fails.
    """
    pulls = np.array([in_range("force", force, 1e-14, 1e-8, unit="newtons") for force in forces])
    require(len(pulls) > 0 and bool(np.all(np.diff(pulls) > 0)), "forces must rise, at least one of them; sort them.")
    in_range("patch", patch, 1e-3, 0.5)
    nodes = torch.from_numpy(membrane.mesh.vertices.copy())
    direction = _patches(nodes, patch)
    found = []
    for force in pulls:
        nodes, residual = _at_rest(membrane, nodes, force * direction)
        extent = (nodes.max(0).values - nodes.min(0).values).tolist()
        area = float(membrane.surface(nodes) / membrane.rest.surface) - 1
        volume = float(membrane.volume(nodes) / membrane.rest.volume) - 1
        found.append(Stretched(float(force), extent[0], extent[1], area, volume, residual, nodes))
    return found


def _patches(nodes: torch.Tensor, fraction: float) -> torch.Tensor:
    """[P, 3]: +x over the nodes at one end and -x at the other, each end's sum 1."""
    count = max(1, round(fraction * len(nodes)))
    order = torch.argsort(nodes[:, 0], stable=True)
    direction = torch.zeros_like(nodes)
    direction[order[-count:], 0] = 1 / count
    direction[order[:count], 0] = -1 / count
    return direction


def _at_rest(membrane: Membrane, start: torch.Tensor, load: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Nodes of least energy under the dead load [P, 3] [N], by L-BFGS, and the greatest force left [N]."""

    def potential(flat: np.ndarray) -> tuple[float, np.ndarray]:
        nodes = LENGTH * torch.from_numpy(flat.reshape(-1, 3).copy())
        energy = membrane.energy(nodes) - (load * (nodes - start)).sum()
        pull = membrane.forces(nodes) + load
        return float(energy) / ENERGY, -(pull.reshape(-1) * (LENGTH / ENERGY)).numpy()

    point, residual = (start / LENGTH).reshape(-1).numpy(), np.inf
    for _ in range(RESTARTS):  # where its line search is lost in rounding, the method starts anew from there
        found = minimize(potential, point, jac=True, method="L-BFGS-B", options=OPTIONS)
        point, residual = found.x, float(np.abs(found.jac).max()) * ENERGY / LENGTH
        if residual <= RESIDUAL:
            return LENGTH * torch.from_numpy(point.reshape(-1, 3)), residual
    raise InputError(
        f"the cell must come to rest under the load, but {1e12 * residual:.2g} pN are left on a node after "
        f"{RESTARTS} searches; take smaller steps of force, or other moduli."
    )
