"""The formats of volumes, by the suffixes of their files: what writes one, and what reads it again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import require
from ..geometry import Grid
from ..progress import Advance
from ..volume import Object, Volume
from .mrc import read_mrc, write_mrc
from .nrrd import read_nrrd, write_nrrd
from .ome_tiff import TIFF_SUFFIXES, read_ome_tiff, write_ome_tiff
from .ome_zarr import ZARR_SUFFIX, read_ome_zarr, require_zarr, write_ome_zarr
from .plain_values import both
from .volumes import REFRACTION, Contents, Stored, read_stored, write_voxels
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
