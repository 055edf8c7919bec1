"""`export`: the volume of a reconstruction in the formats of other programs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ..geometry import Grid
from ..io.formats import write_volume_file
from ..io.volumes import LIKELY, SEEN
from ..optics.sampling import views_seeing
from ..progress import Advance
from ..scan import Exposures
from .matter_map import MatterMap
from .reconstruction import Reconstruction


def export(
    reconstruction: Reconstruction,
    path: str | Path,
    grid: Grid,
    on_progress: Advance = lambda fraction: None,
    exposures: Exposures | None = None,
    matter: MatterMap | None = None,
) -> None:
    """Write δ and β of a reconstruction on `grid` to `path`, whose suffix names the format.

    Suffixes: .h5 or .hdf5 (HDF5), .vti (ParaView), .nrrd (3D Slicer), .mrc (ChimeraX), .tif or .tiff (OME-TIFF), .zarr
    (OME-Zarr, a folder). If the frames show absorption alone, the file holds the attenuation coefficient µ [1/m] in
    place of δ. `on_progress(fraction)` is called after each part of the volume. exposures: of the training frames; HDF5
    then also holds /views, the number of views that show each voxel. matter: of rehearsals; HDF5 then also holds
    /matter, the probability that a voxel is matter. Errors: `InputError` for another suffix, and where the package of a
    format is missing.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.known(water), hs.Voxels())
        >>> hs.export(result, "cell.vti", hs.Grid.of_views(views))
        >>> print(hs.info("cell.vti").rows["shape"])
        16 × 16 × 16 voxels (z, y, x)
    """
    beside = {} if exposures is None else {SEEN: partial(views_seeing, exposures)}
    beside |= {} if matter is None else {LIKELY: matter.on}
    write_volume_file(Path(path), reconstruction.object, grid, on_progress, reconstruction.contents, beside)
