"""`refine_surfaces`: a reconstruction by Gaussians in, closed surfaces fitted to the same frames out."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ..checks import at_least, in_range, require
from ..fit.surfaces import STAGE, Progress, SurfaceFit, fit_surfaces
from ..geometry import Grid
from ..representations import GaussianCloud, SurfaceMesh, isosurface
from ..scan import Scan


@dataclass(frozen=True)
class Extraction:
    """How surfaces are cut out of the occupancy that the Gaussians add up to.

    level: occupancy at the surface; spacing: edge of the voxels, and about the length of the triangles' sides
    [pixels]; least_volume: bodies and cavities of fewer voxels are left out; smoothing: steps that smooth away the
    voxels' traces.
    """

    level: float = 0.5
    spacing: float = 1.0
    least_volume: float = 8.0
    smoothing: int = 10

    def __post_init__(self) -> None:
        in_range("level", self.level, 0.01, 0.99)
        in_range("spacing", self.spacing, 0.25, 8.0, unit="pixels")
        at_least(self, 0, "least_volume", "smoothing")


@dataclass(frozen=True)
class SurfaceSettings:
    """Everything about surfaces but the scan and the Gaussians: how they are cut out, and how they are fitted."""

    extraction: Extraction = field(default_factory=Extraction)
    fit: SurfaceFit = field(default_factory=SurfaceFit)


def extract_surfaces(cloud: GaussianCloud, scan: Scan, options: Extraction = Extraction()) -> SurfaceMesh:
    """The surfaces where the occupancy of `cloud` crosses the level, in the field of view of `scan`.

    Errors: `InputError` if the cloud is not of one material, or there is no such surface.
    """
    has = "two materials" if cloud.second else "δ and β apart"
    require(
        cloud.single_material,
        f"surfaces need one material of known δ and β, but this run has {has}; "
        "reconstruct with --material or --delta-beta.",
    )
    grid = Grid.of_views(scan.views, 1 / options.spacing)
    with torch.no_grad():
        density = cloud.density(grid)[0].cpu().numpy()
    mesh = isosurface(density, grid, options.level, options.least_volume, options.smoothing)
    vertices = torch.from_numpy(mesh.vertices / cloud.unit_length)
    return SurfaceMesh(vertices, torch.from_numpy(mesh.faces), cloud.unit_length, cloud.delta, cloud.beta)


def refine_surfaces(
    cloud: GaussianCloud,
    scan: Scan,
    settings: SurfaceSettings = SurfaceSettings(),
    on_progress: Progress = lambda stage, fraction, record: None,
) -> SurfaceMesh:
    """Surfaces cut out of `cloud` and fitted to the training frames of `scan`; errors: of both parts."""
    on_progress(f"{STAGE}: extraction", 0.0, {})
    start = extract_surfaces(cloud, scan, settings.extraction)
    return fit_surfaces(scan, start, settings.fit, on_progress)
