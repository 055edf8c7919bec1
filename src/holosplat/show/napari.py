"""Volumes, objects and runs as layers of napari, by its plug-in `holosplat` (napari.yaml); napari itself is not needed.

Axes are (z, y, x), with the time before them where matter moves; lengths are micrometres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError
from ..geometry import Grid
from ..io.hdf5 import open_hdf5
from ..io.objects import COMPACT, FORMAT, read_object
from ..io.objects import GAUSSIANS_FORMAT as GAUSSIANS
from ..io.volumes import NAMES, read_volume
from ..mesh import joined
from ..representations import InMotion, SurfaceMesh
from ..volume import Volume
from ..workflows.reconstruction import instants_of
from ..workflows.run_folder import RunFolder
from .parts import at_times

Layer = tuple[Any, dict[str, Any], str]
"""Data, options of the layer, and its kind."""
MICROMETRES = 1e6
MOST_VOXELS = 1 << 24
"""Voxels of the images of an object, of all times together (64 MB of each of δ and β)."""
COLOURS = {"delta": "gray", "beta": "inferno"}


def get_reader(path: str | Sequence[str]) -> Callable[[str], list[Layer]] | None:
    """`layers` for a volume file, an object file or a run folder; None for anything else, as napari asks for it."""
    if not isinstance(path, str):
        return None
    found = Path(path)
    if found.is_dir():
        with suppress(InputError):
            RunFolder(found).require_run()
            return layers
        return None
    if found.suffix.lower() not in (".h5", ".hdf5"):
        return None
    try:
        with open_hdf5(found) as file:
            form = str(file.attrs.get("format", ""))
            return layers if form in (FORMAT, COMPACT, GAUSSIANS) or all(name in file for name in NAMES) else None
    except InputError:
        return None


def layers(path: str) -> list[Layer]:
    """The layers of a path that `get_reader` takes: surfaces, or images of δ and β on a grid, at each time of what
    moves. Errors: `InputError` for damaged files."""
    found = Path(path)
    times: list[float] = []
    if found.is_dir():
        folder = RunFolder(found)
        folder.require_run()
        obj, times = folder.read_result(), instants_of(folder)
    else:
        with open_hdf5(found) as file:
            volume = all(name in file for name in NAMES)
        if volume:
            return _images(found.stem, [read_volume(found)], {})
        obj = read_object(found)
    moving = isinstance(obj, InMotion)
    about = {"kind": obj.kind, "described": obj.described} | ({"times_s": times} if moving and times else {})
    moments = list(at_times(obj, times).values())
    surfaces = [moment for moment in moments if isinstance(moment, SurfaceMesh)]
    if len(surfaces) == len(moments):
        return [_surface(found.stem, surfaces, moving, about)]
    grid = obj.enclosing_grid(MOST_VOXELS // len(moments))
    return _images(found.stem, [moment.voxelise(grid) for moment in moments], about, moving)


def _images(name: str, volumes: list[Volume], about: dict[str, Any], moving: bool = False) -> list[Layer]:
    """An image of each of δ and β [Z, Y, X], or [T, Z, Y, X] of what moves."""
    scale, translate = _placed(volumes[0].grid, moving)
    found = []
    for channel in NAMES:
        stack = np.stack([getattr(volume, channel) for volume in volumes])
        data = stack if moving else stack[0]
        low, high = float(data.min()), float(data.max())
        options = {
            "name": f"{name} {channel}",
            "scale": scale,
            "translate": translate,
            "colormap": COLOURS[channel],
            "contrast_limits": (low, high if high > low else low + 1.0),
            "visible": channel == "delta",
            "metadata": {"unit": "µm", **about},
        }
        found.append((data, options, "image"))
    return found


def _placed(grid: Grid, moving: bool) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Scale and place of an image [µm], with the number of the time before them."""
    size, origin = (tuple(MICROMETRES * v for v in reversed(found)) for found in (grid.voxel_size, grid.origin))
    return ((1.0, *size), (0.0, *origin)) if moving else (size, origin)


def _surface(name: str, moments: Sequence[SurfaceMesh], moving: bool, about: dict[str, Any]) -> Layer:
    """Triangles, whose vertices begin with the number of the time where they move."""
    meshes = [moment.mesh() for moment in moments]
    whole, numbers = joined(meshes), np.repeat(np.arange(len(meshes)), [len(mesh.vertices) for mesh in meshes])
    places = MICROMETRES * whole.vertices[:, ::-1]
    data = (np.column_stack([numbers, places]) if moving else places, whole.faces)
    return data, {"name": name, "metadata": {"unit": "µm", **about}}, "surface"
