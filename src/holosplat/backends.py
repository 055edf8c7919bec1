"""Which implementation runs an operation, and on how many threads: names, what each needs, and its operations.

A backend is named once, where a fit starts; nothing falls back to another by itself. `auto` means `cuda` where a GPU
can be used and `cpu` otherwise, never `reference`.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Literal, get_args

import torch

from . import native
from .checks import InputError, MissingError, require
from .memory import memory_kept
from .units import number_of

Backend = Literal["auto", "cpu", "cuda", "reference"]
"""What may be asked to compute."""
NAMES: tuple[Backend, ...] = get_args(Backend)

DESCRIPTIONS = {
    "cpu": "compiled C++ kernels, float32, SSE2 to AVX-512",
    "cuda": "Triton kernels on an NVIDIA GPU, float32",
    "reference": "plain torch, float32 or float64, slow: the specification of the others",
}

SUPPORT: dict[str, tuple[str, str, dict[str, str]]] = {
    "line integrals of Gaussians": ("projectors.splat", "splat", {}),
    "Gaussians on voxels": ("projectors.splat", "voxelise", {}),
    "line integrals of closed surfaces": ("projectors.surface", "thickness", {}),
    "line integrals of specimens' meshes": ("projectors.mesh", "mean_depths", {"cuda": "plain torch"}),
    "line integrals of voxels": ("projectors.voxels.lattice_kernels", "Kernels", {}),
    "line integrals of voxels about one axis": ("projectors.voxels.slice_products", "Products", {}),
    "wave optics": ("optics.hologram", "hologram", {"cpu": "C++, MKL's or scipy's FFT", "cuda": "Triton, torch's FFT"}),
    "L1 and SSIM of frames": ("fit.fidelity", "l1_and_ssim", {}),
    "statistics of the measured frames": ("fit.fidelity", "statistics", {"cuda": "plain torch"}),
    "Adam": ("fit.adam", "step", {}),
    "total variation of a volume": ("fit.total_variation", "total_variation", {"cuda": "plain torch"}),
    "steps of total variation": ("baselines.tv_steps", "ascend", {}),
}
"""Every operation of a run: its package, its function, and remarks on single backends."""

_KIND = {"cpu": "C++", "cuda": "Triton", "reference": "plain torch"}


def implementation(package: str, backend: str) -> ModuleType:
    """The module of `package` (a full name) that holds the functions of a resolved `backend`."""
    if backend not in DESCRIPTIONS:
        raise InputError(f"backend must be one of {', '.join(DESCRIPTIONS)} here, but it is {backend!r}.")
    try:
        return import_module(f".{backend}", package)
    except ImportError as error:
        reason = _missing_cuda() if backend == "cuda" else ""
        raise MissingError(f"{package} cannot use backend {backend!r}: {reason or error}.") from error


def require_device(device: str) -> None:
    """`InputError` where `device` (cpu or cuda) cannot be used."""
    reason = missing(device)
    require(device == "cpu" or not reason, f"device {device} cannot be used: {reason}; take device cpu.")


def support_table() -> list[list[str]]:
    """The one support table: a row per operation, with how each of cpu, cuda, reference does it."""
    return [
        [operation, *(remarks.get(backend, kind) for backend, kind in _KIND.items())]
        for operation, (_, _, remarks) in SUPPORT.items()
    ]


def resolve(name: str) -> str:
    """The backend that `name` stands for on this machine: `cpu`, `cuda` or `reference`.

    Errors: `InputError` if the name is unknown, or its requirements are missing (with the reasons for both `cuda` and
    `cpu`, since the user then needs one of them).
    """
    if name not in NAMES:
        raise InputError(f"backend must be one of {', '.join(NAMES)}, but it is {name!r}.")
    if name == "reference" or (name != "auto" and not missing(name)):  # asked for once a frame: look for no other
        return name
    reasons = {backend: missing(backend) for backend in ("cuda", "cpu")}
    if name == "auto" and not reasons["cuda"] and not interpreted():
        return "cuda"
    if name == "auto" and not reasons["cpu"]:
        return "cpu"
    state = "; ".join(f"{backend}: {reason or 'can be used'}" for backend, reason in reasons.items())
    raise InputError(
        f"backend {name!r} cannot be used here. {state}. Mend one of them (for cpu: install a C++ compiler, "
        "then holosplat again), or ask for backend 'reference', which is slow but needs neither."
    )


def in_main_memory(backend: str) -> str:
    """`backend` (resolved), but the CPU's for a GPU's."""
    return "cpu" if backend == "cuda" else backend


def missing(backend: str) -> str:
    """Why `backend` cannot be used here, as part of a sentence; empty if it can."""
    if backend == "cpu":
        try:
            native.available_isas()
        except RuntimeError as error:
            return str(error).split(". ")[0].rstrip(".")  # its advice stands where reasons are put together
    if backend == "cuda":
        return _missing_cuda()
    return ""


def _missing_cuda() -> str:
    if importlib.util.find_spec("triton") is None:
        return "triton is not installed (pip install 'holosplat[gpu]')"
    if interpreted() or torch.cuda.is_available():
        return ""
    if torch.version.cuda is None:
        return f"this build of torch ({torch.__version__}) has no CUDA (install one that has)"
    return "torch sees no CUDA device (check the driver with nvidia-smi)"


def interpreted() -> bool:
    """Whether Triton kernels run in Triton's interpreter, on the CPU: for tests, very slow (`TRITON_INTERPRET=1`)."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def device(backend: str) -> torch.device:
    """Where the arrays of a resolved backend live."""
    on_gpu = backend == "cuda" and not interpreted()
    return torch.device("cuda" if on_gpu else "cpu")


def device_name(backend: str) -> str:
    """The device in words, for the record of a run."""
    if backend == "cuda":
        return "Triton's interpreter" if interpreted() else torch.cuda.get_device_name()
    threads = number_of(torch.get_num_threads(), "thread")
    return f"CPU, {threads}" + (f", {native.used_isa()}" if backend == "cpu" else "")


@contextmanager
def coarse_work() -> Iterator[None]:
    """For work on frames of some 64 pixels: it takes one thread, as several wait for each other as long as they save,
    and keeps its memory (`memory_kept`)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with memory_kept():
            yield
    finally:
        torch.set_num_threads(before)
