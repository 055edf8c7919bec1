"""Line integrals through voxel volumes: a ray caster for any pose, sparse slice matrices for one rotation axis."""

from ...geometry import Grid, Views
from .raycast import RayProjector, voxel_line_integrals
from .slices import SliceProjector, rows_match

__all__ = ["RayProjector", "SliceProjector", "projector_for", "voxel_line_integrals"]


def projector_for(grid: Grid, views: Views) -> SliceProjector | RayProjector:
    """The fastest projector that fits: slice matrices for views about y with matching rows, else the ray caster."""
    if views.shares_axis and rows_match(grid, views):
        return SliceProjector(grid, views)
    return RayProjector(grid, views)
