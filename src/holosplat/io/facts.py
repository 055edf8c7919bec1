"""What `holosplat info` says of a path: rows of facts, what is missing, and how to go on; here of what is no scan."""

from __future__ import annotations

import os
import re
import zipfile
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from ..checks import InputError
from ..geometry import Grid
from .atomic import read_json
from .formats import FORMATS, HDF5_SUFFIXES, volume_format
from .hdf5 import Fields, attribute_numbers, attribute_text, open_hdf5
from .ome import TIFF_SUFFIXES, ZARR_SUFFIX, ome_grid
from .volumes import ABSORPTION, MU, REFRACTION, Contents
from .vtk import SUFFIXES as MESHES
from .vtk import mesh_files, read_meshes

MOST_KEYS = 16
"""Datasets, or kinds of files, that are named."""
OBJECT = re.compile("holosplat (object|compact|compact series|Gaussians) 1")
SYMBOLS = {"delta": "δ", "beta": "β", MU: "µ"}
WIDTH = 22
"""Of the names of rows."""
VOXEL = "voxel_size"
UNIT, UNIT_M = "um", 1e-6
"""As which coordinates of meshes are read; they are shown in the file's own unit."""


@dataclass(frozen=True)
class Facts:
    """rows: facts by name; missing: a sentence for each thing that nothing says; commands: what can be done next."""

    rows: Mapping[str, str]
    missing: tuple[str, ...] = ()
    commands: tuple[str, ...] = field(default=())

    def lines(self) -> list[str]:
        """The same as lines of text."""
        rows = [*self.rows.items(), *(("missing", each) for each in self.missing)]
        rows += [("next", each) for each in self.commands]
        return [f"{name:{WIDTH}}{text}" for name, text in rows]


def facts_of_matter(path: Path) -> Facts | None:
    """What a volume, an object or a mesh is; None for anything else. Values are not read, but for those of meshes."""
    if path.is_dir() and path.suffix.lower() == ZARR_SUFFIX:
        return _of_zarr(path)
    if path.suffix.lower() in MESHES or (path.is_dir() and any(one.suffix.lower() in MESHES for one in path.iterdir())):
        return _of_mesh(path)
    if path.suffix.lower() in TIFF_SUFFIXES:
        found = ome_grid(path)
        return None if found is None else Facts(_of_grid("OME-TIFF", *found))
    if path.suffix.lower() in FORMATS and path.suffix.lower() not in HDF5_SUFFIXES:
        stored = volume_format(path).read(path)
        rows = _of_grid(path.suffix[1:].upper(), stored.grid, stored.of)
        for values, (name, unit) in zip(stored.arrays, stored.of.units.items()):
            rows[SYMBOLS[name]] = f"{values.min():.3g} to {values.max():.3g}{' m⁻¹' * (unit != '1')}"
        return Facts(rows)
    if not (path.is_file() and h5py.is_hdf5(path)):
        return None
    with open_hdf5(path) as file:
        form = attribute_text(file.attrs.get("format")) or ""
        if OBJECT.fullmatch(form):
            from ..representations import KINDS

            kind = attribute_text(file.attrs.get("kind")) or "gaussians"
            known = KINDS[kind].__name__ if kind in KINDS else kind
            return Facts({"what": f"an object ({form}): {known}"}, (), (f"holosplat view {path}",))
        for of in (REFRACTION, ABSORPTION):
            if all(isinstance(file.get(name), h5py.Dataset) for name in of.units):
                return _of_volume(path, file, of)
    return Facts({"what": form} | keys_of(path)) if form.startswith("holosplat ") else None  # phase maps


def keys_of(path: Path) -> dict[str, str]:
    """What is in a path, without knowing what it is: sizes, datasets of HDF5 with shapes, kinds of files of folders."""
    if path.is_dir():
        files = [name for _, _, names in os.walk(path) for name in names]
        kinds = Counter(Path(name).suffix.lower() or name for name in files)
        listed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(MOST_KEYS))
        return {"files": f"{len(files)}: {listed}" if files else "none"}
    if not path.is_file():  # a pipe, say, which may never end
        return {}
    rows = {"size": f"{path.stat().st_size / 1e6:.4g} MB"}
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        return rows | {"in the archive": ", ".join(archive.namelist()[:MOST_KEYS])}
    if not h5py.is_hdf5(path):
        return rows
    found: list[str] = []

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            shape = " × ".join(map(str, item.shape or ())) or "one value"
            units = attribute_text(item.attrs.get("units"))
            found.append(f"/{name} ({shape}, {item.dtype}{f', {units}' if units else ''})")

    with open_hdf5(path) as file:
        file.visititems(take)
    found.sort(key=lambda one: "one value" in one)  # arrays first
    more = [f"and {len(found) - MOST_KEYS} more"] if len(found) > MOST_KEYS else []
    return rows | {"datasets": ("\n" + " " * WIDTH).join([*found[:MOST_KEYS], *more]) or "none"}


def _of_volume(path: Path, file: h5py.File, of: Contents) -> Facts:
    """δ and β, or µ and β, on voxels; of their values those of the middle slice."""
    fields = Fields(path, file)
    arrays = [fields.dataset(name) for name in of.units]
    rows = {"what": f"a volume of {' and '.join(SYMBOLS[name] for name in of.units)} (HDF5)"}
    rows["shape"] = " × ".join(map(str, arrays[0].shape)) + " voxels (z, y, x)"
    for array, (name, unit) in zip(arrays, of.units.items()):
        values = np.asarray(array[array.shape[0] // 2]) if array.ndim == 3 and 0 not in array.shape else np.zeros(1)
        shown = f"{values.min():.3g} to {values.max():.3g} {'m⁻¹ ' * (unit != '1')}"
        rows[SYMBOLS[name]] = f"{shown}in the slice in the middle of z"
    sizes = [place.attrs[VOXEL] for place in (file, arrays[0]) if VOXEL in place.attrs]
    for size in sizes[:1]:
        edges = attribute_numbers(f"{path}: @{VOXEL}", size, (1, 3))
        rows["voxels"] = " × ".join(f"{1e6 * edge:.4g}" for edge in edges) + " µm"
    unsaid = f"{path} does not say its voxel_size [m] and origin [m]; add them as attributes of the file."
    command = f"holosplat simulate {path} --detector ROWS COLUMNS --pixel-size P --out scan.nxs"
    return Facts(rows, () if sizes else (unsaid,), (command,))


def _of_mesh(path: Path) -> Facts:
    """A mesh, or the first one of a folder of them, in the unit of its file."""
    files = mesh_files(path)
    (mesh,) = read_meshes(files[0], UNIT)
    low, high = mesh.bounds
    size = " × ".join(f"{edge / UNIT_M:.4g}" for edge in high - low)
    rows = {
        "what": "a surface mesh (VTK)" if path.is_file() else f"{len(files)} surface meshes (VTK)",
        "shape": f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles ({files[0].name})",
        "extent": f"{size} (x, y, z) in the file's unit, volume {mesh.volume / UNIT_M**3:.4g}",
    }
    missing = (
        f"{path} does not say its unit of length; say it by --length-unit (um, nm, mm, m).",
        f"{path} does not say its material; say it by --material, with --density for a formula.",
    )
    command = f"holosplat simulate {path} --length-unit um --material NAME --detector ROWS COLUMNS --out scan.nxs"
    return Facts(rows, missing, (command,))


def _of_grid(form: str, grid: Grid, of: Contents) -> dict[str, str]:
    size = " × ".join(f"{1e6 * edge:.4g}" for edge in grid.voxel_size)
    shape = " × ".join(map(str, grid.shape))
    what = f"a volume of {' and '.join(SYMBOLS[name] for name in of.units)} ({form})"
    return {"what": what, "shape": f"{shape} voxels (z, y, x)", "voxels": f"{size} µm"}


def _of_zarr(path: Path) -> Facts | None:
    places = [path / ".zattrs", path / "zarr.json"]
    said = next((read_json(place) for place in places if place.is_file()), {})
    said = said if "multiscales" in said else said.get("attributes", {})
    images = said.get("multiscales")
    if not images:
        return None
    labels = [SYMBOLS.get(str(one.get("label"))) for one in said.get("omero", {}).get("channels", [])]
    of = f" of {' and '.join(map(str, labels))}" if labels and all(labels) else ""
    levels = [str(one.get("path")) for one in images[0].get("datasets", [])]
    first = path / (levels[0] if levels else "0") / ".zarray"
    shape = " × ".join(map(str, read_json(first).get("shape", []))) if first.is_file() else "unknown"
    return Facts(
        {"what": f"a volume{of} (OME-Zarr)", "shape": f"{shape} (channel, z, y, x)", "levels": str(len(levels))}
    )


def no_kind(path: Path, error: InputError) -> Facts:
    """What is said of a path that no reader takes, and why."""
    return Facts({"what": "nothing that can be read as it stands"} | keys_of(path) | {"problem": str(error)})
