"""Line integrals through voxels: a ray caster, a voxel-driven lattice and rays for any pose, sparse slice matrices."""

from ...geometry import Grid, Views
from .lattice import LatticeProjector, RayProjector
from .raycast import voxel_line_integrals
from .slices import SliceProjector, rows_match

__all__ = ["LatticeProjector", "Projector", "RayProjector", "SliceProjector", "projector_for", "voxel_line_integrals"]

Projector = SliceProjector | LatticeProjector | RayProjector
"""Forward and exact adjoint."""


def projector_for(grid: Grid, views: Views, backend: str = "cpu") -> Projector:
    """The fastest linear projector that fits: rays for cones, slice matrices for views about y with matching rows, else
    the lattice.

    backend: `cpu`, `cuda` or `reference`.
    """
    if views.sources is not None:
        return RayProjector(grid, views, backend)
    if views.shares_axis and rows_match(grid, views):
        return SliceProjector(grid, views, backend)
    return LatticeProjector(grid, views, backend)
