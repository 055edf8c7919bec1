"""Volumes as OME-TIFF and OME-Zarr 0.4 (ngff.openmicroscopy.org/0.4): δ and β as channels, with size and place [µm].

OME-Zarr has chunks at several resolutions, in the layout of Zarr's version 2 with blosc, which every reader takes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..checks import InputError, finite, require
from ..geometry import Grid
from ..progress import Advance
from ..units import LENGTH_UNITS, unit_factor
from ..volume import Object, Volume
from .atomic import atomic_folder, atomic_path, require_new
from .guard import require_memory, undamaged
from .hdf5 import require_room
from .stacks import all_images, image_numbers, open_tiff
from .volumes import ABSORPTION, NAMES, REFRACTION, SLAB_VOXELS, Contents, Stored, contents_of, grid_of, slabs_of

TIFF_SUFFIXES = (".tif", ".tiff")
UNITS_M = {"µm": 1e-6, "nm": 1e-9, "mm": 1e-3, "m": 1.0}


def ome_grid(path: Path) -> tuple[Grid, Contents] | None:
    """The grid of an OME-TIFF of δ (or µ) and β, and what it holds; None for another TIFF file."""
    with open_tiff(path) as opened:
        text = opened.ome_metadata or ""
    grid = _grid_of_ome(text)
    return None if grid is None else (grid, contents_of(text))


def read_ome_tiff(path: Path) -> Stored:
    """δ (or µ) and β of an OME-TIFF as `write_ome_tiff` writes it; without a place it lies about the origin. Errors:
    `InputError` for other TIFF files."""
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
    """Write δ (or µ) and β as the channels of an OME-TIFF, float32, pages along z, with the size of voxels and the
    place of the first one [µm], which many programs take for 0."""
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


ZARR_SUFFIX = ".zarr"
CHUNK = 64
"""Voxels along the edges of a chunk: 1 MB of float32, which programs load for one picture."""
SMALLEST = 64
"""The last level's longest edge has at most so many voxels."""
MICROMETRES = 1e6
COLOURS = ("FFFFFF", "FFB000")
"""In which viewers show δ and β at first."""


def require_zarr() -> Any:
    """The package zarr; `InputError` where it is not installed."""
    try:
        import zarr
    except ImportError:
        raise InputError('OME-Zarr needs zarr; install it by pip install "holosplat[zarr]".') from None
    return zarr


def write_ome_zarr(
    path: Path, obj: Object, grid: Grid, on_progress: Advance = lambda fraction: None, of: Contents = REFRACTION
) -> None:
    """Write δ and β of `obj` on `grid` as an OME-Zarr folder at `path`, which must be new; float32, lossless.

    Axes c, z, y, x; lengths in micrometres, with the places of voxel centres (`translation`). Each level has means over
    2 × 2 × 2 voxels of the one before, of what there is of them at the far ends. At most `SLAB_VOXELS` voxels, or a row
    of chunks, are in memory. Errors: `InputError` without the package zarr.
    """
    zarr = require_zarr()
    require_new(path)
    require_room(path, 4 * len(NAMES) * math.prod(grid.shape) // 4)
    rows = CHUNK * max(1, SLAB_VOXELS // (grid.shape[0] * grid.shape[2] * CHUNK))
    with atomic_folder(path) as temporary:
        group = zarr.open_group(store=str(temporary), mode="w", zarr_format=2)
        shapes, limits = levels_of(grid.shape), np.array([[np.inf, -np.inf]] * len(NAMES))
        arrays = [_array(group, str(k), shape) for k, shape in enumerate(shapes)]
        for start, part in slabs_of(obj, grid, rows, on_progress):
            values = np.stack(list(of.of_volume(part).values()))
            arrays[0][:, :, start : start + values.shape[2]] = values
            flat = values.reshape(len(NAMES), -1)
            limits[:, 0] = np.minimum(limits[:, 0], flat.min(axis=1))
            limits[:, 1] = np.maximum(limits[:, 1], flat.max(axis=1))
        for fine, coarse in pairwise(arrays):
            for start in range(0, coarse.shape[2], CHUNK):
                stop = min(start + CHUNK, coarse.shape[2])
                coarse[:, :, start:stop] = halved(fine[:, :, 2 * start : 2 * stop])
        group.attrs.update(metadata(grid, len(shapes), limits, of))


def read_ome_zarr(path: Path) -> Stored:
    """The finest volume of an OME-Zarr folder of `write_ome_zarr`; `InputError` without zarr, and for other folders."""
    zarr = require_zarr()
    require(path.is_dir(), f"{path} must be a folder of OME-Zarr, but there is none; check the path.")
    with undamaged(path, "an OME-Zarr of δ and β, as `holosplat export` writes it"):
        group = zarr.open_group(store=str(path), mode="r", zarr_format=2)
        image = group.attrs["multiscales"][0]
        channels = tuple(channel["label"] for channel in group.attrs["omero"]["channels"])
        axes = [axis["name"] for axis in image["axes"]]
        factors = [unit_factor(f"{path}: axes", axis["unit"], LENGTH_UNITS) for axis in image["axes"][1:]]
        finest, array = image["datasets"][0], group[image["datasets"][0]["path"]]
        scale, place = (np.array(step[step["type"]], dtype=float) for step in finest["coordinateTransformations"])
        of = contents_of(" ".join(channels))
        if channels != tuple(of.units) or axes != ["c", *"zyx"] or array.ndim != 4 or array.shape[0] != len(NAMES):
            raise ValueError(f"it has the channels {channels} and the axes {axes}")
        require_memory(str(path), 4 * math.prod(array.shape))
        size, origin = ((values[1:] * factors)[::-1] for values in (scale, place))
        first, beta = np.asarray(array[:], dtype=np.float32)
    grid = grid_of(path, first.shape, size.tolist(), origin.tolist())
    return Stored((finite(f"{path}", first), finite(f"{path}", beta)), grid, of)


def levels_of(shape: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Shapes (Z, Y, X) of all levels, each half of the one before, rounded up."""
    shapes = [shape]
    while max(shapes[-1]) > SMALLEST:
        z, y, x = (-(-n // 2) for n in shapes[-1])
        shapes.append((z, y, x))
    return shapes


def halved(values: np.ndarray) -> np.ndarray:
    """Means [C, Z', Y', X'] over blocks of 2³ voxels of [C, Z, Y, X]; of an odd edge, the last voxels count twice."""
    values = np.pad(values, [(0, 0), *((0, n % 2) for n in values.shape[1:])], mode="edge")
    c, z, y, x = values.shape
    return values.reshape(c, z // 2, 2, y // 2, 2, x // 2, 2).mean(axis=(2, 4, 6), dtype=np.float32)


def metadata(grid: Grid, levels: int, limits: np.ndarray, of: Contents = REFRACTION) -> dict[str, Any]:
    """The metadata of OME-Zarr: axes, units, places, and channels with the extreme values `limits` [2, 2]."""
    axes = [{"name": "c", "type": "channel"}]
    axes += [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    size, origin = (np.array(v[::-1]) * MICROMETRES for v in (grid.voxel_size, grid.origin))
    datasets = []
    for level in range(levels):
        factor = 2**level
        scale = {"type": "scale", "scale": [1.0, *(size * factor).tolist()]}
        place = {"type": "translation", "translation": [0.0, *(origin + size * (factor - 1) / 2).tolist()]}
        datasets.append({"path": str(level), "coordinateTransformations": [scale, place]})
    image = {"version": "0.4", "name": "refractive index", "axes": axes, "datasets": datasets, "type": "mean"}
    channels = []
    for name, colour, (low, high) in zip(of.units, COLOURS, limits.tolist()):
        high = high if high > low else low + 1.0  # a range of grey values is never empty
        window = {"min": low, "max": high, "start": low, "end": high}
        channels.append({"label": name, "color": colour, "active": name != "beta", "window": window})
    return {"multiscales": [image], "omero": {"version": "0.4", "channels": channels}}


def _array(group: Any, name: str, shape: tuple[int, int, int]) -> Any:
    from numcodecs import Blosc

    return group.create_array(
        name,
        shape=(len(NAMES), *shape),
        chunks=(1, *(min(CHUNK, n) for n in shape)),
        dtype="float32",
        compressors=Blosc(cname="zstd", clevel=5, shuffle=Blosc.SHUFFLE),
        fill_value=0.0,
        chunk_key_encoding={"name": "v2", "separator": "/"},
    )
