"""Volumes of other programs: stacks of TIFF images, whose numbers and voxels the user explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import InputError, finite, in_range, require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..ranges import Small, ranged
from ..volume import Volume
from .atomic import atomic_path
from .hdf5_writing import require_room
from .tiff_guard import all_images
from .volumes import VOXEL_RANGE_M, read_volume

HDF5_SUFFIXES = (".h5", ".hdf5")
TIFF_SUFFIXES = (".tif", ".tiff")
VOLUME_SUFFIXES = (*HDF5_SUFFIXES, *TIFF_SUFFIXES)
"""Names of files that are volumes."""


@dataclass(frozen=True)
@ranged
class StackMeaning:
    """What a stack of TIFF images shows.

    voxel_size: edge of its cubic voxels [m]; of: δ and β of a value of one.
    stacked: the axis along which pages follow each other: y for slices across the rotation axis (rows of a page along
    z), z for slices along it (rows of a page along y).
    """

    voxel_size: Small
    of: DeltaBeta
    stacked: Literal["y", "z"] = "y"

    def __post_init__(self) -> None:
        in_range("voxel_size", self.voxel_size, *VOXEL_RANGE_M, unit="metres")
        require(self.stacked in ("y", "z"), f"stacked must be y or z, but it is {self.stacked!r}.")


def read_specimen(paths: Sequence[Path], meaning: StackMeaning | None) -> Volume:
    """The volume of one HDF5 file (`read_volume`), or of TIFF files: one of many pages, or many in the order of their
    names, about the origin.

    meaning: of TIFF files, which do not say it themselves. Errors: `InputError` for other files, for a stack without a
    meaning, for HDF5 with one, and for images of different sizes.
    """
    suffixes = {path.suffix.lower() for path in paths}
    if suffixes <= set(HDF5_SUFFIXES):
        require(len(paths) == 1, f"a volume must be one HDF5 file, but there are {len(paths)}; give one.")
        require(
            meaning is None,
            f"{paths[0]} says its voxel size, δ and β itself; leave --voxel-size and the like out.",
        )
        return read_volume(paths[0])
    require(
        suffixes <= set(TIFF_SUFFIXES),
        f"a volume must be one HDF5 file or TIFF images, but there are files of {', '.join(sorted(suffixes))}.",
    )
    if meaning is None:
        raise InputError(f"{paths[0]} is a TIFF image, which says no voxel size; give --voxel-size.")
    values = np.concatenate([_pages(path) for path in sorted(paths)])
    if meaning.stacked == "y":
        values = values.transpose(1, 0, 2)
    values = values.astype(np.float64)
    grid = Grid.centred((values.shape[0], values.shape[1], values.shape[2]), meaning.voxel_size)
    return Volume(meaning.of.delta * values, meaning.of.beta * values, grid)


def write_ome_tiff(path: Path, volume: Volume) -> None:
    """Write δ and β as the two channels of an OME-TIFF, float32, pages along z, with the voxels' size [µm] in it.

    Its coordinates begin at the first voxel: the origin is not in such files.
    """
    import tifffile

    values = np.stack([volume.delta, volume.beta]).astype(np.float32)
    require_room(path, values.nbytes)
    sizes = {f"PhysicalSize{axis}": 1e6 * size for axis, size in zip("XYZ", volume.grid.voxel_size)}
    units = {f"PhysicalSize{axis}Unit": "µm" for axis in "XYZ"}
    described = {"axes": "CZYX", "Channel": {"Name": ["delta", "beta"]}, **sizes, **units}
    with atomic_path(path) as temporary:
        tifffile.imwrite(temporary, values, ome=True, metadata=described, compression="zlib")


def _pages(path: Path) -> np.ndarray:
    """The pages [P, rows, columns] of a TIFF file."""
    require(path.is_file(), f"{path} must be a TIFF file, but there is none; correct the path.")
    pages = all_images(path)
    shapes = sorted({page.shape for page in pages})
    grey = len(shapes) == 1 and len(shapes[0]) == 2 and all(page.dtype.kind in "iuf" for page in pages)
    require(grey, f"{path} must hold grey images of one size, but it holds {', '.join(map(str, shapes)) or 'none'}.")
    return finite(f"{path}", np.stack(pages))
