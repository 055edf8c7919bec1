"""Volumes as OME-TIFF: δ and β as channels, with the voxels' size and place [µm]."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..checks import InputError, finite, require
from ..geometry import Grid
from ..volume import Volume
from .atomic import atomic_path
from .hdf5_writing import require_room
from .stacks import all_images, image_numbers, open_tiff
from .volumes import ABSORPTION, REFRACTION, Contents, Stored, contents_of

TIFF_SUFFIXES = (".tif", ".tiff")
UNITS_M = {"µm": 1e-6, "nm": 1e-9, "mm": 1e-3, "m": 1.0}


def ome_grid(path: Path) -> tuple[Grid, Contents] | None:
    """The grid of an OME-TIFF of δ (or µ) and β, and what it holds; None for another TIFF file."""
    with open_tiff(path) as opened:
        text = opened.ome_metadata or ""
    grid = _grid_of_ome(text)
    return None if grid is None else (grid, contents_of(text))


def read_ome_tiff(path: Path) -> Stored:
    """δ (or µ) and β of an OME-TIFF as `write_ome_tiff` writes it, about the origin if it does not say where it lies.

    Errors: `InputError` for other TIFF files, which do not say what their numbers are.
    """
    with open_tiff(path) as opened:
        text, count = opened.ome_metadata, len(image_numbers(opened, path))
    grid = _grid_of_ome(text or "")
    if grid is None or count != 2 * grid.shape[0]:
        raise InputError(
            f"{path} must be a volume of δ and β, HDF5 or an OME-TIFF of `holosplat export`, but it is another TIFF "
            "file, which does not say what its numbers are; of a specimen, --voxel-size says it."
        )
    pages = all_images(path)
    sizes = {page.shape for page in pages}
    require(sizes == {grid.shape[1:]}, f"{path} must hold images of the size that it declares, but they are {sizes}.")
    values = finite(f"{path}", np.stack(pages).astype(np.float32)).reshape(2, *grid.shape)
    return Stored((values[0], values[1]), grid, contents_of(text or ""))


def _grid_of_ome(text: str) -> Grid | None:
    """The grid that the metadata of an OME-TIFF with the channels δ (or µ) and β says; None for other metadata."""
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
    except (KeyError, ValueError, OverflowError, ElementTree.ParseError):
        return None
    if named not in (list(REFRACTION.units), list(ABSORPTION.units)):
        return None
    return replace(grid, voxel_size=(edges[0], edges[1], edges[2]), origin=(place[0], place[1], place[2]))


def write_ome_tiff(path: Path, volume: Volume, of: Contents = REFRACTION) -> None:
    """Write δ (or µ) and β as the channels of an OME-TIFF, float32, pages along z, with the voxels' size [µm] in it.

    The place of the first voxel is that of the planes; many programs take it for 0.
    """
    import tifffile

    values = np.stack(list(of.of_volume(volume).values())).astype(np.float32)
    require_room(path, values.nbytes)
    sizes = {f"PhysicalSize{axis}": 1e6 * size for axis, size in zip("XYZ", volume.grid.voxel_size)}
    units = {f"PhysicalSize{axis}Unit": "µm" for axis in "XYZ"}
    x, y, z = (1e6 * place for place in volume.grid.origin)
    depths = [z + 1e6 * k * volume.grid.voxel_size[2] for k in range(volume.grid.shape[0])]
    places = {"PositionX": [x] * 2 * len(depths), "PositionY": [y] * 2 * len(depths), "PositionZ": depths * 2}
    in_um = {f"{name}Unit": ["µm"] * 2 * len(depths) for name in places}
    named = {"Channel": {"Name": list(of.units)}, "Plane": {**places, **in_um}}
    described = {"axes": "CZYX", **named, **sizes, **units}
    with atomic_path(path) as temporary:
        tifffile.imwrite(temporary, values, ome=True, metadata=described, compression="zlib", photometric="minisblack")
