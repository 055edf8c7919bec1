"""The formats of volumes, by the suffixes of their files, and volumes of shares that others wrote."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..checks import finite, in_range, require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..progress import Advance
from ..ranges import Small, ranged
from ..volume import Object, Volume
from .file_order import in_order
from .ome_tiff import TIFF_SUFFIXES, read_ome_tiff, write_ome_tiff
from .ome_zarr import ZARR_SUFFIX, read_ome_zarr, require_zarr, write_ome_zarr
from .plain_values import both, read_mrc, read_nrrd, write_mrc, write_nrrd
from .stacks import all_images
from .volumes import REFRACTION, VOXEL_RANGE_M, Contents, Stored, read_stored, write_voxels
from .vti import read_vti, write_vti

HDF5_SUFFIXES = (".h5", ".hdf5")


def _alone(path: Path) -> tuple[Path, ...]:
    return (path,)


@dataclass(frozen=True)
class VolumeFormat:
    """A format of volumes of δ and β. write: an object on a grid; files: all that it makes; needs: a package, which it
    asks for."""

    write: Callable[[Path, Object, Grid, Advance, Contents], None]
    read: Callable[[Path], Stored]
    files: Callable[[Path], tuple[Path, ...]] = _alone
    needs: Callable[[], Any] = lambda: None


def _write_tiff(path: Path, obj: Object, grid: Grid, on_progress: Advance, of: Contents) -> None:
    write_ome_tiff(path, obj.voxelise(grid), of)
    on_progress(1.0)


FORMATS = {
    **dict.fromkeys(HDF5_SUFFIXES, VolumeFormat(write_voxels, read_stored)),
    **dict.fromkeys(TIFF_SUFFIXES, VolumeFormat(_write_tiff, read_ome_tiff)),
    ZARR_SUFFIX: VolumeFormat(write_ome_zarr, read_ome_zarr, needs=require_zarr),
    ".vti": VolumeFormat(write_vti, read_vti),
    ".nrrd": VolumeFormat(write_nrrd, read_nrrd, both),
    ".mrc": VolumeFormat(write_mrc, read_mrc, both),
}


def volume_format(path: Path, called: str = "a volume") -> VolumeFormat:
    """The format that the suffix of `path` names; `InputError` for any other, and where its package is missing.

    called: what the message calls the path.
    """
    found = FORMATS.get(path.suffix.lower())
    require(
        found is not None,
        f"{called} must be a file whose name ends with {', '.join(FORMATS)}, by which its format is chosen, but it is "
        f"{path}; name another one.",
    )
    assert found is not None
    found.needs()
    return found


def write_volume_file(
    path: Path, obj: Object, grid: Grid, on_progress: Advance = lambda fraction: None, of: Contents = REFRACTION
) -> None:
    """Write δ and β (or what arrays are `of`) of `obj` on `grid` in the format that the suffix of `path` names."""
    volume_format(path).write(path, obj, grid, on_progress, of)


def of_time(path: Path, frame: int) -> Path:
    """The path with the number of a time, _t0000 say, before its suffixes, of which .ome.zarr and .ome.tif are two."""
    stem, ome, _ = path.stem.partition(".ome")
    return path.with_name(f"{stem}_t{frame:04d}{ome}{path.suffix}")


def read_volume_file(path: Path) -> Volume:
    """δ and β of a volume file of any format, by its suffix."""
    return volume_format(path).read(path).volume(path)


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
    """The volume of one file that says what it is (`read_volume_file`); or of TIFF files, one of many pages, or many in
    the order of their names, about the origin.

    meaning: of TIFF files that do not say it themselves. Errors: `InputError` for other files, for several without a
    meaning, for formats that say it with one, and for images of different sizes.
    """
    if meaning is None:
        require(
            len(paths) == 1, f"a volume must be one file, but there are {len(paths)}; for images, give --voxel-size."
        )
        return read_volume_file(paths[0])
    for path in paths:
        require(
            path.suffix.lower() in TIFF_SUFFIXES,
            f"--voxel-size and the like are of TIFF images, but {path} is none; leave them out where files say it.",
        )
    values = np.concatenate([_pages(path) for path in in_order(paths)])
    if meaning.stacked == "y":
        values = values.transpose(1, 0, 2)
    values = values.astype(np.float64)
    grid = Grid.centred((values.shape[0], values.shape[1], values.shape[2]), meaning.voxel_size)
    return Volume(meaning.of.delta * values, meaning.of.beta * values, grid)


def _pages(path: Path) -> np.ndarray:
    """The pages [P, rows, columns] of a TIFF file."""
    require(path.is_file(), f"{path} must be a TIFF file, but there is none; correct the path.")
    pages = all_images(path)
    shapes = sorted({page.shape for page in pages})
    grey = len(shapes) == 1 and len(shapes[0]) == 2 and all(page.dtype.kind in "iuf" for page in pages)
    require(grey, f"{path} must hold grey images of one size, but it holds {', '.join(map(str, shapes)) or 'none'}.")
    return finite(f"{path}", np.stack(pages))
