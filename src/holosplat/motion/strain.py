"""The energy of bodies in motion beside a known shape at rest."""

from __future__ import annotations

import numpy as np
import torch

from ..checks import require
from ..mesh import TriangleMesh
from ..representations import MovingSurfaces
from ..specimens.membrane.model import Elasticity, Membrane

RED_CELL = Elasticity(global_area=0.0, volume=0.0)
"""Shear, dilation and bending of a red cell's membrane (docs/cells.md): what is stored in it, without what keeps its
area and volume in a simulation."""


def strain_energy(
    bodies: MovingSurfaces, times: np.ndarray, rest: TriangleMesh, elasticity: Elasticity = RED_CELL
) -> np.ndarray:
    """[T, B] J of each body at `times` [s]: 0 in the shape of `rest` [m], in any pose.

    Energies compare triangles with themselves, so that all bodies must have the triangles of `rest`, in its order;
    motion along a surface, which frames do not see, counts as strain. Errors: `InputError` for other triangles.
    """
    parts = [bodies.body(k) for k in range(bodies.count)]
    wanted = torch.tensor(rest.faces)
    require(
        all(torch.equal(faces, wanted) for _, faces in parts),
        f"strain energy needs bodies of the triangles of the shape at rest, {len(rest.faces)} each, but these have "
        "others; follow bodies of a known shape.",
    )
    membrane, found = Membrane(rest, elasticity), []
    for time in times:
        nodes = np.stack([mesh.vertices for mesh in bodies.bodies(float(time))])
        found.append(membrane.energy(torch.from_numpy(nodes)).numpy())
    return np.array(found)
