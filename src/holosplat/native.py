"""The compiled kernels: finds the shared library for this machine's instruction set, calls it through ctypes.

`native/abi.hpp` describes the functions; the structures here mirror it. ctypes releases the interpreter lock
during a call. The environment variable `HOLOSPLAT_ISA` (sse2, avx2, avx512) forces one build, for tests.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import sys
from ctypes import POINTER, c_double, c_int64, c_void_p
from functools import cache
from pathlib import Path

from .checks import MissingError

ABI = 11
ISAS = ("sse2", "avx2", "avx512")
"""Builds for x86-64, slowest first. Other processors have one build, `generic`."""


class Cloud(ctypes.Structure):
    """N Gaussians: counts and pointers to float32 arrays."""

    _fields_ = [
        ("count", c_int64),
        ("channels", c_int64),
        ("centres", c_void_p),
        ("scales", c_void_p),
        ("quaternions", c_void_p),
        ("amplitudes", c_void_p),
    ]


class Gradients(ctypes.Structure):
    """Where the gradients of a cloud's four arrays go."""

    _fields_ = [(name, c_void_p) for name in ("centres", "scales", "quaternions", "amplitudes")]


class ViewGradients(ctypes.Structure):
    """Where the gradients of the views' arrays go, float64; curvatures only in cones."""

    _fields_ = [(name, c_void_p) for name in ("rotations", "shifts", "curvatures")]


class Views(ctypes.Structure):
    """V views on one raster: counts and pointers to float64 arrays; curvatures, 1 / source distance, in cones."""

    _fields_ = [
        ("count", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("rotations", c_void_p),
        ("shifts", c_void_p),
        ("curvatures", c_void_p),
    ]


class Grid(ctypes.Structure):
    """Counts of voxels along z, y, x."""

    _fields_ = [("depth", c_int64), ("height", c_int64), ("width", c_int64)]


class Lattice(ctypes.Structure):
    """Counts of voxels along z, y, x; x, y, z of the first voxel's centre; voxel edges along x, y, z."""

    _fields_ = [
        ("depth", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("origin", c_double * 3),
        ("pitch", c_double * 3),
    ]


class Rays(ctypes.Structure):
    """Rays through slices: counts of slices, rows, columns and rays, and a pointer to float32 [5, rays]."""

    _fields_ = [(name, c_int64) for name in ("depth", "height", "width", "count")] + [("places", c_void_p)]


class Raster(ctypes.Structure):
    """Counts of views, channels, rows, columns."""

    _fields_ = [(name, c_int64) for name in ("count", "channels", "height", "width")]


class Detector(ctypes.Structure):
    """Rasters [V, H, W], the frames of rows × columns pixels in them, and how images lie in complex ones."""

    _fields_ = [
        (name, c_int64)
        for name in ("count", "height", "width", "rows", "columns", "margin_y", "margin_x", "factor", "lanes")
    ]


class Target(ctypes.Structure):
    """Measured frames: counts, pointers to frames and their local moments, and the map to [0, 1]."""

    _fields_ = [
        ("count", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("frames", c_void_p),
        ("statistics", c_void_p),
        ("low", c_double),
        ("span", c_double),
    ]


class Adam(ctypes.Structure):
    """K arrays under optimisation: how many; pointers to K int64 lengths, and to K pointers to float32 arrays each."""

    _fields_ = [
        ("count", c_int64),
        *((name, c_void_p) for name in ("lengths", "parameters", "gradients", "first", "second")),
    ]


class Surface(ctypes.Structure):
    """Triangles seen in V views: counts of vertices and faces, pointers to float64 points and int64 corners."""

    _fields_ = [("vertices", c_int64), ("faces", c_int64), ("points", c_void_p), ("corners", c_void_p)]


class Slices(ctypes.Structure):
    """A sparse matrix that all slices share: counts of voxels, rays and slices; pointers to int64 starts of the voxels'
    entries, int64 rays and float32 weights of these."""

    _fields_ = [
        *((name, c_int64) for name in ("voxels", "rays", "slices")),
        *((name, c_void_p) for name in ("starts", "places", "weights")),
    ]


class Options(ctypes.Structure):
    """Cutoff in standard deviations, variance added [px²], number of threads."""

    _fields_ = [("cutoff", c_double), ("variance", c_double), ("threads", c_int64)]


_FUNCTIONS = {
    "holosplat_abi": (),
    "holosplat_best_isa": (),
    "holosplat_splat": (POINTER(Cloud), POINTER(Views), POINTER(Options), c_void_p),
    "holosplat_splat_backward": (
        *(POINTER(t) for t in (Cloud, Views, Options)),
        c_void_p,
        POINTER(Gradients),
        POINTER(ViewGradients),
    ),
    "holosplat_voxelise": (POINTER(Cloud), POINTER(Grid), POINTER(Options), c_void_p),
    "holosplat_voxelise_backward": (
        *(POINTER(t) for t in (Cloud, Grid, Options)),
        c_void_p,
        POINTER(Gradients),
    ),
    "holosplat_lattice_project": (POINTER(Lattice), POINTER(Views), c_void_p, c_void_p, c_int64),
    "holosplat_lattice_backproject": (POINTER(Lattice), POINTER(Views), c_void_p, c_void_p, c_int64),
    "holosplat_lattice_poses": (POINTER(Lattice), POINTER(Views), *(c_void_p,) * 4, c_int64),
    "holosplat_rays_project": (POINTER(Rays), *(c_void_p,) * 2, c_int64),
    "holosplat_rays_backproject": (POINTER(Rays), *(c_void_p,) * 2, c_int64),
    "holosplat_rays_gradients": (POINTER(Rays), *(c_void_p,) * 3, c_int64),
    "holosplat_slices_project": (POINTER(Slices), *(c_void_p,) * 2, c_int64),
    "holosplat_slices_backproject": (POINTER(Slices), *(c_void_p,) * 2, c_int64),
    "holosplat_surface": (POINTER(Surface), POINTER(Raster), c_int64, c_void_p, c_int64),
    "holosplat_surface_shares": (POINTER(Surface), POINTER(Raster), *(c_void_p,) * 3, c_int64),
    "holosplat_surface_poses": (POINTER(Surface), POINTER(Raster), *(c_void_p,) * 4, c_int64),
    "holosplat_mesh_depths": (POINTER(Surface), POINTER(Raster), c_void_p, c_int64, c_double, c_void_p, c_int64),
    "holosplat_exit_wave": (POINTER(Raster), *(c_void_p,) * 3, c_int64),
    "holosplat_exit_wave_backward": (POINTER(Raster), *(c_void_p,) * 4, c_int64),
    "holosplat_transfer": (POINTER(Raster), *(c_void_p,) * 2, c_double, c_int64, c_void_p, c_int64),
    **{
        f"holosplat_{name}": (POINTER(Detector), *(c_void_p,) * 2, c_int64)
        for step in ("intensity", "contrast", "bin")
        for name in (step, f"{step}_backward")
    },
    "holosplat_fidelity_statistics": (POINTER(Target), c_void_p, c_int64),
    "holosplat_fidelity": (POINTER(Target), *(c_void_p,) * 3, c_int64),
    "holosplat_fidelity_backward": (POINTER(Target), *(c_void_p,) * 4, c_int64),
    "holosplat_adam": (POINTER(Adam), c_void_p, c_int64),
    "holosplat_tv_smooth": (POINTER(Grid), c_void_p, c_double, c_void_p, c_void_p, c_int64),
    "holosplat_tv_ascend": (POINTER(Grid), c_void_p, c_void_p, c_double, c_double, c_int64),
    "holosplat_tv_descend": (POINTER(Grid), *(c_void_p,) * 3, *(c_double,) * 3, *(c_void_p,) * 2, c_int64),
}


def call(function: str, *arguments: ctypes.Structure | c_void_p | c_int64 | float | None) -> None:
    """Call a kernel by name with structures (passed by reference) and pointers; None is a null pointer.

    Errors: `MissingError` if the library is missing, `MemoryError` if memory ran out.
    """
    passed = [ctypes.byref(a) if isinstance(a, ctypes.Structure) else a for a in arguments]
    if getattr(_library(os.environ.get("HOLOSPLAT_ISA", "")), function)(*passed):
        raise MemoryError(f"{function} ran out of memory; use fewer Gaussians or a smaller raster.")


def available_isas() -> tuple[str, ...]:
    """The builds that are installed and that this machine can run, slowest first."""
    folder = _folder()
    if not _is_x86():
        return ("generic",)
    best = _open(folder, ISAS[0]).holosplat_best_isa()
    return tuple(isa for isa in ISAS[: best + 1] if _path(folder, isa).exists())


def used_isa() -> str:
    """The build that is in use here."""
    return os.environ.get("HOLOSPLAT_ISA", "") or available_isas()[-1]


@cache
def _library(forced: str) -> ctypes.CDLL:
    """The library for `forced`, or the fastest one that this machine runs if that is empty."""
    choices = available_isas()
    if forced and forced not in choices:
        raise MissingError(f"HOLOSPLAT_ISA must be one of {', '.join(choices)} here, but it is {forced!r}; unset it.")
    return _open(_folder(), forced or choices[-1])


@cache
def _open(folder: Path, isa: str) -> ctypes.CDLL:
    """One build, if it was compiled from the same interface as this file."""
    path = _path(folder, isa)
    try:
        library = ctypes.CDLL(str(path))
        for name, types in _FUNCTIONS.items():
            function = getattr(library, name)
            function.argtypes, function.restype = types, c_int64
    except (OSError, AttributeError) as error:
        if "failed to map segment" in str(error):
            raise MemoryError(f"the compiled kernels find no room: {error}") from error
        raise MissingError(f"The compiled kernels at {path} cannot be used ({error}). {_ADVICE}") from error
    if library.holosplat_abi() != ABI:
        raise MissingError(f"The compiled kernels at {path} are of another version. {_ADVICE}")
    return library


_ADVICE = (
    "Either install a C++ compiler (GCC or clang) and then holosplat again (in its sources: pip install .), "
    "or ask by name for backend='reference', which is slow but needs none."
)


@cache
def _folder() -> Path:
    """The folder `holosplat/_native` that holds the libraries, in a normal or an editable install."""
    searched = _candidates()
    for folder in searched:
        if _path(folder, ISAS[0] if _is_x86() else "generic").exists():
            return folder
    places = ", ".join(str(folder) for folder in dict.fromkeys(searched))
    raise MissingError(
        f"The compiled kernels of holosplat are not installed (looked in {places}): "
        f"an install with HOLOSPLAT_KERNELS=OFF leaves them out. {_ADVICE}"
    )


def _candidates() -> list[Path]:
    """Beside the package; or, in an editable install, in site-packages, where the metadata is."""
    folders = [Path(__file__).resolve().parent / "_native"]
    try:
        located = importlib.metadata.distribution("holosplat").locate_file("holosplat/_native")
        folders.append(Path(str(located)))
    except importlib.metadata.PackageNotFoundError:
        pass
    return folders


def _path(folder: Path, isa: str) -> Path:
    return folder / f"holosplat_{isa}{'.dll' if sys.platform == 'win32' else '.so'}"


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")
