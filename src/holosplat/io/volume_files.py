"""Volumes of other programs: stacks of TIFF images, whose numbers and voxels the user explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from ..checks import InputError, finite, in_range, require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..ranges import Small, ranged
from ..volume import Volume
from .atomic import atomic_path
from .file_order import in_order
from .hdf5_writing import require_room
from .tiff_guard import all_images, image_count, open_tiff
from .volumes import NAMES, VOXEL_RANGE_M, read_volume

HDF5_SUFFIXES = (".h5", ".hdf5")
TIFF_SUFFIXES = (".tif", ".tiff")
UNITS_M = {"µm": 1e-6, "nm": 1e-9, "mm": 1e-3, "m": 1.0}
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
    values = np.concatenate([_pages(path) for path in in_order(paths)])
    if meaning.stacked == "y":
        values = values.transpose(1, 0, 2)
    values = values.astype(np.float64)
    grid = Grid.centred((values.shape[0], values.shape[1], values.shape[2]), meaning.voxel_size)
    return Volume(meaning.of.delta * values, meaning.of.beta * values, grid)


def read_truth(path: Path) -> Volume:
    """δ and β of a volume file that says what it is: HDF5 (`read_volume`), or an OME-TIFF of `write_ome_tiff`."""
    return read_ome_tiff(path) if path.suffix.lower() in TIFF_SUFFIXES else read_volume(path)


def ome_grid(path: Path) -> Grid | None:
    """The grid of an OME-TIFF of δ and β; None for another TIFF file."""
    with open_tiff(path) as opened:
        return _grid_of_ome(opened.ome_metadata or "")


def read_ome_tiff(path: Path) -> Volume:
    """δ and β of an OME-TIFF as `write_ome_tiff` writes it, about the origin if it does not say where it lies.

    Errors: `InputError` for other TIFF files, which do not say what their numbers are.
    """
    with open_tiff(path) as opened:
        text, count = opened.ome_metadata, image_count(opened, path)
    grid = _grid_of_ome(text or "")
    if grid is None or count != 2 * grid.shape[0]:
        raise InputError(
            f"{path} must be a volume of δ and β, HDF5 or an OME-TIFF of `holosplat export`, but it is another TIFF "
            "file, which does not say what its numbers are."
        )
    values = finite(f"{path}", np.stack(all_images(path)).astype(np.float32)).reshape(2, *grid.shape)
    return Volume(values[0], values[1], grid)


def _grid_of_ome(text: str) -> Grid | None:
    """The grid that the metadata of an OME-TIFF with the channels δ and β says; None for other metadata."""
    try:
        elements = list(ElementTree.fromstring(text).iter())
        (pixels,) = [each.attrib for each in elements if each.tag.endswith("Pixels")]
        named = [each.get("Name") for each in elements if each.tag.endswith("Channel")]
        planes = [each.attrib for each in elements if each.tag.endswith("Plane")]
        z, y, x = (int(pixels[f"Size{axis}"]) for axis in "ZYX")
        units = [UNITS_M[pixels.get(f"PhysicalSize{axis}Unit", "µm")] for axis in "XYZ"]
        edges = [unit * float(pixels[f"PhysicalSize{axis}"]) for unit, axis in zip(units, "XYZ")]
        grid = Grid.centred((z, y, x), edges[0])
        place = [1e-6 * float(planes[0][f"Position{axis}"]) for axis in "XYZ"] if planes else grid.origin
    except (KeyError, ValueError, ElementTree.ParseError):
        return None
    if named != list(NAMES):
        return None
    return replace(grid, voxel_size=(edges[0], edges[1], edges[2]), origin=(place[0], place[1], place[2]))


def write_ome_tiff(path: Path, volume: Volume) -> None:
    """Write δ and β as the two channels of an OME-TIFF, float32, pages along z, with the voxels' size [µm] in it.

    The place of the first voxel is that of the planes; many programs take it for 0.
    """
    import tifffile

    values = np.stack([volume.delta, volume.beta]).astype(np.float32)
    require_room(path, values.nbytes)
    sizes = {f"PhysicalSize{axis}": 1e6 * size for axis, size in zip("XYZ", volume.grid.voxel_size)}
    units = {f"PhysicalSize{axis}Unit": "µm" for axis in "XYZ"}
    x, y, z = (1e6 * place for place in volume.grid.origin)
    depths = [z + 1e6 * k * volume.grid.voxel_size[2] for k in range(volume.grid.shape[0])]
    places = {"PositionX": [x] * 2 * len(depths), "PositionY": [y] * 2 * len(depths), "PositionZ": depths * 2}
    in_um = {f"{name}Unit": ["µm"] * 2 * len(depths) for name in places}
    named = {"Channel": {"Name": list(NAMES)}, "Plane": {**places, **in_um}}
    described = {"axes": "CZYX", **named, **sizes, **units}
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
