"""Compiles every Triton kernel that the package launches, with its arguments of production, for GPUs that are not here.

Run as a script by test_triton_compile.py, in a process where TRITON_INTERPRET is not set. Each operation runs once on
small arrays in main memory. Its launches stop after the just-in-time compiler: for each of `TARGETS`, it makes machine
code as if such a GPU were there. Prints one line of JSON: what each kernel takes, by the `ptxas` that Triton brings.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
import triton
from torch import Tensor
from triton import knobs
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

TARGETS = (80, 90)
PTXAS = Path(triton.__file__).parent / "backends/nvidia/bin/ptxas"


class AbsentGPU:
    """As much of a driver as the compiler asks for. A device's number is its compute capability."""

    def __init__(self) -> None:
        self.capability = TARGETS[0]

    def get_current_device(self) -> int:
        return self.capability

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", self.capability, 32)


def assembled(ptx: str) -> str:
    """What `ptxas -v` says of a kernel."""
    target = re.search(r"\.target (\w+)", ptx)
    assert target
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernel.ptx"
        source.write_text(ptx)
        command = [PTXAS, "-v", f"--gpu-name={target[1]}", source, "-o", Path(folder) / "kernel.cubin"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr


def report(kernel: JITFunction, made: Any, given: dict[str, Any], said: str) -> dict[str, Any]:
    """Registers, spilled bytes and shared memory of a compiled kernel, and whether a shape was compiled in.

    said: what ptxas has said of it.
    """
    registers = re.search(r"Used (\d+) registers", said)
    constants = [k for k, parameter in enumerate(kernel.params) if not parameter.is_constexpr]
    return {
        "kernel": f"{kernel.fn.__module__.split('.')[-1]}.{kernel.fn.__name__}",
        "channels": given.get("C"),
        "wide": given.get("WIDE", False),
        "target": made.metadata.target.arch,
        "warps": made.metadata.num_warps,
        "registers": int(registers[1]) if registers else -1,
        "spilled": sum(int(n) for n in re.findall(r"(\d+) bytes spill", said)),
        "stack": sum(int(n) for n in re.findall(r"(\d+) bytes stack frame", said)),
        "shared": made.metadata.shared,
        "specialised": [kernel.arg_names[k] for k in constants if (k,) in made.src.constants],
    }


def operations(every_size: bool) -> list[Callable[[], None]]:
    """Calls that, together, launch every kernel; of one channel and of wide indices, too, where `every_size` asks."""
    from holosplat.baselines.tv_steps import cuda as total_variation
    from holosplat.fit.adam import cuda as adam
    from holosplat.fit.fidelity import cuda as fidelity
    from holosplat.optics.hologram import OpticalPath
    from holosplat.optics.hologram import cuda as waves
    from holosplat.projectors.splat import cuda as splats
    from holosplat.projectors.splat import triton_boxes, triton_pixels
    from holosplat.projectors.surface import cuda as surfaces
    from holosplat.projectors.voxels.lattice_kernels import cuda as hats
    from holosplat.projectors.voxels.lattice_kernels.reference import Lattice
    from holosplat.projectors.voxels.slice_products import cuda as slices

    def cloud(channels: int) -> list[Tensor]:
        return [torch.ones(5, width, requires_grad=True) for width in (3, 3, 4, channels)]

    def splat(channels: int, of_poses: bool = False, cone: bool = False) -> None:
        curvatures = torch.full((1,), 0.01, dtype=torch.float64) if cone else None
        poses = (torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 2, dtype=torch.float64), curvatures)
        poses[0].requires_grad_(of_poses)
        splats.splat(cloud(channels), poses, (8, 9), 4.0, 1 / 12).sum().backward()

    def voxelise(channels: int) -> None:
        splats.voxelise(cloud(channels), (8, 9, 10), 4.0, 1 / 12).sum().backward()

    def compare() -> None:
        frames = torch.ones(1, 20, 30)
        parts = fidelity.l1_and_ssim(torch.ones(1, 20, 30, requires_grad=True), frames, torch.ones(1, 2, 10, 20), 0, 1)
        torch.stack(parts).sum().backward()

    def move() -> None:
        adam.step(*([torch.ones(9)] for _ in range(4)), torch.ones(2))

    def surface() -> None:
        points, faces = torch.ones(2, 5, 3, dtype=torch.float64), torch.ones(7, 3, dtype=torch.int64)
        image, weights = torch.ones(2, 8, 9, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
        surfaces.thickness(points, faces, (8, 9), 2)
        surfaces.corner_shares(points, faces, image, weights)
        surfaces.pose_gradients(points, points[0], faces, image)

    def vary() -> None:
        u, q = torch.ones(3, 4, 5), torch.ones(3, 3, 4, 5)
        total_variation.ascend(u, q, 0.5, 1.0)
        total_variation.descend(u, u, q, 1.0, (0.0, 1.0), u, u)

    def lattice() -> None:
        poses = (torch.ones(2, 3, 3, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64))
        kernels = hats.Kernels(Lattice((3, 4, 5), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (8, 9)), *poses)
        kernels.project(torch.ones(3, 4, 5))
        kernels.backproject(torch.ones(2, 8, 9))
        kernels.pose_gradients(torch.ones(3, 4, 5), torch.ones(2, 8, 9))
        rays = hats.Stack(torch.ones(5, 7))
        rays.project(torch.ones(3, 4, 5))
        rays.backproject(torch.ones(7), torch.ones(3, 4, 5))
        rays.gradients(torch.ones(3, 4, 5), torch.ones(7))

    def slice_matrix() -> None:
        entries = (torch.ones(4, dtype=torch.int64), torch.ones(5, dtype=torch.int64), torch.ones(5))
        slices.Products(lambda transposed: entries, (3, 3)).project(torch.ones(3, 4))

    def wide(call: Callable[[int], None], module: ModuleType) -> None:
        usual, module.WIDE_FROM = module.WIDE_FROM, 0
        call(2)
        module.WIDE_FROM = usual

    def hologram(channels: int, blurred: bool) -> None:
        blurs = (torch.ones(1, 12), torch.ones(1, 14)) if blurred else (None, None)
        factors = (torch.ones(1, n, dtype=torch.complex64) for n in (12, 14))
        path = OpticalPath(*factors, *blurs, torch.ones(1, dtype=torch.float64), True, (4, 5), (2, 2), 2, 1e-6)
        lines = torch.ones(1, channels, 12, 14, requires_grad=True)
        for refraction in (np.ones((channels, 2)), torch.ones(1, channels, 2, dtype=torch.float64)):
            waves.hologram(lines, refraction, path).sum().backward()

    calls: list[Callable[[], None]] = [compare, move, surface, vary, lattice, slice_matrix]
    calls += [lambda: hologram(1, True), lambda: hologram(2, False)]
    if every_size:
        calls += [lambda: wide(splat, triton_pixels), lambda: wide(voxelise, triton_boxes)]
    for c in (1, 2) if every_size else (2,):
        calls += [lambda c=c, p=p, k=k: splat(c, p, k) for p in (False, True) for k in (False, True)]
        calls += [lambda c=c: voxelise(c)]
    return calls


def main() -> None:
    """Run the operations for every target, and print the reports."""
    torch.set_num_threads(1)
    gpu, launch, reports = AbsentGPU(), JITFunction.run, {}
    driver.set_active(gpu)  # type: ignore[arg-type]
    knobs.nvidia.dump_ptxas_log = True

    def compile_only(self: JITFunction, *arguments: Any, grid: Any, warmup: bool, **options: Any) -> None:
        log = io.StringIO()
        with contextlib.redirect_stdout(log):
            made = launch(self, *arguments, grid=grid, warmup=True, **options)
        if made.hash not in reports:
            said = log.getvalue() or assembled(made.asm["ptx"])  # one that was kept since an earlier run says nothing
            reports[made.hash] = report(self, made, dict(zip(self.arg_names, arguments)), said)

    JITFunction.run = compile_only
    for gpu.capability in TARGETS:
        for operation in operations(gpu.capability == TARGETS[-1]):  # of the others what takes most registers
            operation()
    print(json.dumps(list(reports.values())))


if __name__ == "__main__":
    main()
