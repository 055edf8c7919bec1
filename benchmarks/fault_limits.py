"""Commands without permission or memory, and compiled kernels that are given numbers as none should be."""

from __future__ import annotations

import ctypes
import os
import random
import resource
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from fault_kills import sentence
from fault_shop import LOOKERS, Shop, Writer
from forked import Ended, attempted, run

from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.representations import GaussianCloud, SurfaceMesh, VoxelGrid
from holosplat.specimens.red_cells import evans_fung_cell

VERSION = 0x20080522
"""Of the kernel's table of capabilities (capabilities(7))."""
OVERRIDE = (1 << 1) | (1 << 2)
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: what lets root read and write everywhere."""
EXTREME = (0.0, -0.0, float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e30, -1e12, 1e-30, 1e-45, -1.0, 1e6)
READERS = ("evaluate", *(one.name for one in LOOKERS))
"""Commands that write nothing, or nothing here: without a truth, `evaluate` leaves the report as it is."""
MARGIN = 1 << 30
"""Bytes of address space beside what a command has loaded: with as much, all commands work."""


def denied(shop: Shop, writer: Writer, rng: random.Random, folder: Path) -> str:
    """The folder of the result may not be written to, or an input may not be read: one sentence."""
    command = writer.command(shop, folder)
    inputs = [each for each in command if isinstance(each, Path) and each.exists() and shop.path in each.parents]
    if inputs and rng.random() < 0.5:
        barred, left = [rng.choice(inputs)], 0o000
    else:
        barred, left = [folder, *(path for path in folder.rglob("*") if path.is_dir())], 0o500
    before = [path.stat().st_mode for path in barred]
    for path in barred:
        path.chmod(left)
    try:
        ended = run(command, first=powerless)
    finally:
        for path, mode in zip(barred, before):
            path.chmod(mode)
    silent = ended.code == 0 and writer.name not in READERS
    return sentence(ended) or ("silent" if silent else "")


def powerless() -> None:
    """From now on this process may read and write what its user may, also where that is root."""
    if os.geteuid() != 0:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header, table = struct.pack("Ii", VERSION, 0), ctypes.create_string_buffer(24)
    if libc.capget(header, table) != 0:
        raise OSError(ctypes.get_errno(), "capabilities cannot be told")
    words = list(struct.unpack("6I", table.raw))
    words[0] &= ~OVERRIDE  # effective, permitted, inheritable; then the same of the upper 32
    words[1] &= ~OVERRIDE
    if libc.capset(header, struct.pack("6I", *words)) != 0:
        raise OSError(ctypes.get_errno(), "capabilities cannot be given up")


def starved(shop: Shop, writer: Writer, rng: random.Random, folder: Path) -> str:
    """Less memory than the command takes, or as much, once its libraries are there or before: it works, or says one
    sentence."""
    command = writer.command(shop, folder)
    if rng.random() < 0.25:
        return sentence(_anew(command, int(1.3 * MARGIN * rng.random())))
    left = int(MARGIN * rng.random() ** 3)
    return sentence(run(command, first=lambda: limited(left)))


def _anew(command: list[object], size: int) -> Ended:
    """How a command ends in a process that begins with an address space of so many bytes."""
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", "from holosplat.cli import main; main()", *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (size, size)),
    )
    code = done.returncode
    return Ended(code if code >= 0 else None, max(-code, 0), done.stdout, time.perf_counter() - begun)


def limited(left: int) -> None:
    """From now on this process has `left` bytes of address space beside what it has taken."""
    lines = Path("/proc/self/status").read_text().splitlines()
    taken = next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmSize:"))
    resource.setrlimit(resource.RLIMIT_AS, (taken + left, taken + left))


def extreme(shop: Shop, rng: random.Random, folder: Path) -> str:
    """Gaussians, surfaces or voxels with numbers that are huge, tiny or none, on few pixels: no crash and no hang.
    What they give is not looked at, and that they refuse it is right."""
    make = rng.choice([_gaussians, _surfaces, _voxels])
    generator = torch.Generator().manual_seed(rng.randrange(1 << 30))
    return _crashed(attempted(lambda: _used(make, generator, rng), limit=60.0))


def _crashed(ended: Ended) -> str:
    return "traceback" if ended.code not in (0, None) else ended.verdict


def _used(make: Callable[[torch.Generator], object], generator: torch.Generator, rng: random.Random) -> None:
    """Projections, their gradients and voxels of a model with extreme numbers."""
    whole = make(generator)
    assert isinstance(whole, GaussianCloud | SurfaceMesh | VoxelGrid)
    taken = {name: _spoilt(tensor, rng).requires_grad_() for name, tensor in whole.parameters().items()}
    found, shift = whole.with_parameters(taken), rng.choice([0.0, 0.0, 1e-3])
    views = Views.from_angles([0.0, 37.0], (9, 11), 1e-6)
    views = Views(views.rotations, views.shifts + shift, views.shape, views.pitch)
    seen = rng.choice([views, Poses.of(views)])  # of Poses, as in fits, some values are not checked
    for act in (lambda: found.project(seen).channels.sum().backward(), lambda: found.voxelise(_GRID)):
        try:
            act()
        except ValueError:  # of ours, which refuses them
            continue


_GRID = Grid.centred((7, 5, 6), 1e-6)
_MATTER = Matter.one(1e-7, 1e-10)


def _gaussians(generator: torch.Generator) -> GaussianCloud:
    cloud = [torch.randn(20, columns, generator=generator) for columns in (3, 3, 4, 1)]
    return GaussianCloud(cloud, 1e-6, _MATTER)


def _surfaces(generator: torch.Generator) -> SurfaceMesh:
    mesh = evans_fung_cell(8e-6, 2)
    return SurfaceMesh(torch.from_numpy(mesh.vertices / 1e-6), torch.from_numpy(mesh.faces), 1e-6, _MATTER)


def _voxels(generator: torch.Generator) -> VoxelGrid:
    return VoxelGrid(torch.rand((1, *_GRID.shape), generator=generator), _GRID, _MATTER)


def _spoilt(tensor: torch.Tensor, rng: random.Random) -> torch.Tensor:
    """A copy in which one number, some or all are extreme."""
    spoilt = tensor.detach().clone().reshape(-1)
    count = rng.choice([0, 1, 1, 5, len(spoilt)])
    for place in rng.sample(range(len(spoilt)), min(count, len(spoilt))):
        spoilt[place] = rng.choice(EXTREME)
    return spoilt.reshape(tensor.shape)
