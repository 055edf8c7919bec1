"""Line integrals through voxels: a ray caster, a voxel-driven lattice for any pose, and sparse slice matrices."""

from ...geometry import Grid, Views
from .lattice import LatticeProjector
from .raycast import voxel_line_integrals
from .slices import SliceProjector, rows_match

__all__ = ["LatticeProjector", "SliceProjector", "projector_for", "voxel_line_integrals"]


def projector_for(grid: Grid, views: Views, backend: str = "cpu") -> SliceProjector | LatticeProjector:
    """The fastest linear projector that fits: slice matrices for views about y with matching rows, else the lattice.

    backend: `cpu`, `cuda` or `reference`.
    """
    if views.shares_axis and rows_match(grid, views):
        return SliceProjector(grid, views, backend)
    return LatticeProjector(grid, views, backend)
