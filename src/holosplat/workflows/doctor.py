"""`holosplat doctor`: whether the installation works: versions, kernels, threads, memory, disk, and a small run."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..backends import DESCRIPTIONS, device_name, missing
from ..checks import InputError
from ..geometry import Grid, Views
from ..io.room import free_disk, free_memory, machine_memory
from ..io.samples import cache
from ..matter import DeltaBeta, MaterialPrior, Matter
from ..methods import METHODS
from ..model import Instrument, Model
from ..representations import GaussianCloud
from ..scan import Exposures, Scan, interleaved_split
from ..specimens.red_cells import random_cells
from ..specimens.scene import MeshScene
from ..units import in_percent
from ..version import __version__
from .evaluate import evaluate, render_object
from .reconstruct import reconstruct

LEAST_MEMORY, LEAST_DISK = 1.5e9, 1e9
"""Bytes below which runs of small scans fail."""
SLOW_DISK = 20e6
"""Bytes a second below which writing results takes longer than making them."""
WRITTEN = 1 << 24
"""Bytes that are written to measure it."""
APART = 1e-3
"""Difference of compiled kernels and their plain twin, relative to the largest value, that rounding cannot make."""
LARGEST_ERROR = 0.5
"""Relative error of δ in the small run from which on something is wrong."""
ROWS, COLUMNS, VIEWS, PIXEL = 32, 40, 8, 1e-6
"""The small run."""
MATTER = DeltaBeta(1e-6, 1e-9)
OMP = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "HOLOSPLAT_ISA")


@dataclass(frozen=True)
class Check:
    """One thing that was looked at: what was found, and what to do where it is wrong (empty: it is right)."""

    name: str
    found: str
    remedy: str = ""

    def line(self) -> str:
        """In words."""
        wrong = f"\n{'':18}WRONG: {self.remedy}" if self.remedy else ""
        return f"{self.name:18}{self.found}{wrong}"


def checks() -> Iterator[Check]:
    """All checks, each as soon as it is made."""
    yield Check("holosplat", f"{__version__} in {Path(__file__).resolve().parents[1]}")
    python = f"{platform.python_version()} at {sys.executable}, {platform.platform()}"
    yield Check("Python", python, "" if sys.version_info >= (3, 11) else "install Python 3.11 or newer.")
    idle = "" if torch.cuda.is_available() else ", but no GPU is here: PyTorch's CPU build does as much in less room"
    kind = f"CUDA {torch.version.cuda}{idle}" if torch.version.cuda else "CPU only"
    yield Check("torch", f"{torch.__version__} ({kind}), MKL {'yes' if torch.backends.mkl.is_available() else 'no'}")
    for backend in DESCRIPTIONS:
        if backend != "reference":
            yield _tried(f"kernels {backend}", lambda name=backend: _kernels(name))
    yield _threads()
    yield _memory()
    for name, folder in (("cache", cache()), ("this folder", Path.cwd())):
        yield _tried(f"disk {name}", lambda place=folder: _disk(place))
    yield Check("extras", _extras())
    yield _tried("small run", small_run)


def _tried(name: str, check: Callable[[], tuple[str, str]]) -> Check:
    """A check that may itself fail."""
    try:
        return Check(name, *check())
    except (InputError, OSError, RuntimeError, MemoryError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        return Check(name, "failed", said)


def _kernels(backend: str) -> tuple[str, str]:
    """Whether the kernels of a backend give what their plain twin gives; a GPU's may be missing."""
    reason = missing(backend)
    if reason:
        return f"not usable here: {reason}", "" if backend == "cuda" else f"{reason}; install a C++ compiler and again."
    apart = kernel_difference(backend)
    found = f"{device_name(backend)}; frames and gradients differ from plain torch by {in_percent(apart)}"
    return found, "" if apart < APART else "the kernels are wrong on this machine; set HOLOSPLAT_ISA=sse2 and tell us."


def kernel_difference(backend: str) -> float:
    """The largest difference between a backend and plain torch, in frames of Gaussians and in their gradients, relative
    to the largest value."""
    plain, fast = (_frames_and_gradients(name) for name in ("reference", backend))
    return max(float((a - b).abs().max() / a.abs().max()) for a, b in zip(plain, fast))


def _frames_and_gradients(backend: str) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(1)
    count = 50
    drawn = [torch.randn(count, n, generator=random) for n in (3, 3, 4, 1)]
    parts = [5 * drawn[0], 0.3 * drawn[1], drawn[2], drawn[3]]
    cloud = GaussianCloud(parts, PIXEL, Matter.one(*MATTER)).on(backend)
    leaves = {name: value.detach().clone().requires_grad_() for name, value in cloud.parameters().items()}
    exposures = Exposures.of(Views.evenly_spaced(2, (ROWS, COLUMNS), PIXEL), 20.0, 0.1)
    frames = Model(cloud.with_parameters(leaves).on(backend), Instrument(exposures, 2, backend=backend)).frames()
    frames.square().sum().backward()
    gradients = [leaf.grad for leaf in leaves.values() if leaf.grad is not None]
    return [each.detach().double().cpu() for each in (frames - 1, *gradients)]


def _threads() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    said = ", ".join(f"{name}={os.environ[name]}" for name in OMP if name in os.environ) or "no variable set"
    used = torch.get_num_threads()
    remedy = f"set OMP_NUM_THREADS to {cores} at most: threads wait for each other." if used > cores else ""
    return Check("threads", f"{used} on {cores} cores ({said})", remedy)


def _memory() -> Check:
    free = free_memory()
    found = f"{free / 1e9:.3g} GB free of {machine_memory() / 1e9:.3g} GB"
    remedy = "end other programs, or take a larger machine: small runs take 0.7 GB." if free < LEAST_MEMORY else ""
    return Check("memory", found, remedy)


def _disk(folder: Path) -> tuple[str, str]:
    """Free space of a folder, and how fast it is written."""
    place = folder
    while not place.exists():
        place = place.parent
    free, began = free_disk(place), time.perf_counter()
    with tempfile.TemporaryFile(dir=place) as file:
        file.write(os.urandom(1 << 20) * (WRITTEN >> 20))
        file.flush()
        os.fsync(file.fileno())
    speed = WRITTEN / max(1e-9, time.perf_counter() - began)
    found = f"{folder}: {free / 1e9:.3g} GB free, written at {speed / 1e6:.3g} MB a second"
    if free < LEAST_DISK:
        return found, f"make room in {place}, or work in another folder."
    return found, f"{place} is slow; write runs to a local disk." if speed < SLOW_DISK else ""


def _extras() -> str:
    """Which optional parts are installed, by the packages that each of them needs."""
    needed: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("holosplat") or ():
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if extra:
            needed.setdefault(extra[1], []).append(re.split(r"[\s<>=!~;\[(]", line)[0])
    installed = {name: [each for each in packages if not _is_there(each)] for name, packages in needed.items()}
    have = ", ".join(name for name, lacking in installed.items() if not lacking) or "none"
    lack = ", ".join(name for name, lacking in installed.items() if lacking)
    return f"installed: {have}" + (f"; not installed: {lack} (pip install 'holosplat[NAME]')" if lack else "")


def _is_there(package: str) -> bool:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def small_run() -> tuple[str, str]:
    """Simulate two cells, reconstruct them, and compare: seconds and the relative error of δ."""
    began = time.perf_counter(), time.process_time()
    extents = (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL)
    cells = random_cells(2, extents, 1, 12 * PIXEL)
    scene = MeshScene(tuple(cells), (MATTER,) * len(cells))
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, (ROWS, COLUMNS), PIXEL), 20.0, 0.02)
    scan = Scan(render_object(scene, exposures, 4, "reference"), exposures, interleaved_split(VIEWS))
    result = reconstruct(scan, MaterialPrior.known(MATTER), METHODS["holographic-tv"])
    truth = scene.voxelise(Grid.of_views(scan.views))
    scores = evaluate(result, None, truth).volume
    error = np.inf if scores is None else scores.relative_error_delta
    wall, used = time.perf_counter() - began[0], time.process_time() - began[1]
    found = f"{VIEWS} views of {ROWS} × {COLUMNS} pixels in {wall:.1f} s ({used:.1f} s of processor): "
    found += f"relative error of δ {in_percent(float(error))}"
    return found, "" if error < LARGEST_ERROR else "the result is wrong; try --backend reference, and tell us."
