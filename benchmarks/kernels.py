"""The splat and voxelise kernels, measured: against the machine's ceilings, plain torch, and the float64 reference.

    python benchmarks/kernels.py            # a table
    python benchmarks/kernels.py --json     # one JSON object, progress on stderr

A *pair* is a Gaussian and a pixel (or voxel) of the integer box it is drawn on. Rates are in 1e9 pairs a second, of
whole calls: parameters in 3D in, gradients in 3D out. Times are minima over repetitions that take turns, of the
thread's own processor time where one thread works, so that others on the machine disturb little.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import plain_torch
import torch
from machine import commit, memory_megabytes
from torch import Tensor

from holosplat import native
from holosplat.geometry import rotation_y
from holosplat.projectors.splat import cpu, reference, splat, voxelise
from holosplat.workflows.provenance import environment

SEED = 0
VARIANCE = 1 / 12
CHANNELS = 2
OPERATIONS = 8
"""Vector operations of the backward pass for a pair: w <- w h and h <- h g; for each of two channels a fused
multiply-add to the sum of w times gradient, and two additions to the sums of sums that stand for the moments in dy.
(7 would do, with the channels weighted before the sums of sums; 9 with dy as a factor; half of the 8 are additions,
which some processors do beside the multiplications.) The ceiling has all of them in the pipes of multiply-adds."""


@dataclass(frozen=True)
class Workload:
    """Random Gaussians all over the field, isotropically oriented; scales uniform in a range [px]."""

    views: int
    size: int
    gaussians: int
    scales: tuple[float, float]
    cutoff: float

    def cloud(self) -> list[Tensor]:
        """Centres, scales, quaternions, amplitudes."""
        r = torch.Generator().manual_seed(SEED)
        n, (low, high) = self.gaussians, self.scales
        centres = (torch.rand(n, 3, generator=r) - 0.5) * self.size
        scales = low + (high - low) * torch.rand(n, 3, generator=r)
        return [centres, scales, torch.randn(n, 4, generator=r), torch.randn(n, CHANNELS, generator=r)]

    def poses(self) -> tuple[Tensor, Tensor]:
        """Rotations [V, 3, 3] about y over half a turn, and no shifts [V, 2]."""
        angles = [180 * k / self.views for k in range(self.views)]
        return torch.as_tensor(rotation_y(angles)).double().contiguous(), torch.zeros(self.views, 2).double()


SPLATS = {
    "sigma 1-4, cutoff 3": Workload(4, 512, 30_000, (1.0, 4.0), 3.0),
    "sigma 1-4, cutoff 4": Workload(4, 512, 30_000, (1.0, 4.0), 4.0),
    "fit: sigma 0.6-1.5": Workload(12, 300, 50_000, (0.6, 1.5), 4.0),
}
VOXELS = {"voxelise: sigma 0.6-1.5": Workload(0, 128, 40_000, (0.6, 1.5), 4.0)}
MAIN = "sigma 1-4, cutoff 3"
LARGE = Workload(4, 512, 244_000, (1.0, 4.0), 3.0)
SMALL = Workload(4, 128, 2_000, (1.0, 4.0), 4.0)


def splat_pairs(work: Workload) -> int:
    """Pairs of one pass over all views."""
    centres, scales, quaternions, _ = (a.double() for a in work.cloud())
    total = 0
    for rotation, shift in zip(*work.poses()):
        exact = reference._projected(centres, scales, quaternions, rotation, shift)[:2]
        low, high = reference.boxes(*exact, (work.size,) * 2, work.cutoff, VARIANCE)
        total += int((high - low + 1).clamp(min=0).prod(1).sum())
    return total


def voxel_pairs(work: Workload) -> int:
    """Pairs of one pass over the volume."""
    centres, scales, quaternions, _ = (a.double() for a in work.cloud())
    axes = reference.rotation_matrices(quaternions) * scales[:, None]
    low, high = reference.boxes(centres, axes @ axes.mT, (work.size,) * 3, work.cutoff, VARIANCE)
    return int((high - low + 1).clamp(min=0).prod(1).sum())


@dataclass
class Calls:
    """A kernel's forward and backward pass, ready to call."""

    forward: Callable[[], Any]
    backward: Callable[[], Any]


def calls(work: Workload, threads: int = 1, of_poses: bool = False) -> Calls:
    """The compiled kernels on a workload: a splat (`of_poses`: with their gradients), or without views a voxeliser."""
    arrays, options = work.cloud(), native.Options(work.cutoff, VARIANCE, threads)
    out = [torch.empty_like(a) for a in arrays]
    poses, shape = work.poses(), (work.size,) * (2 if work.views else 3)
    value = torch.zeros(*([work.views] if work.views else []), CHANNELS, *shape)
    gradient = torch.randn(value.shape, generator=torch.Generator().manual_seed(SEED))
    name = "holosplat_splat" if work.views else "holosplat_voxelise"
    raster = cpu._views(poses, shape) if work.views else native.Grid(*shape)
    moved = [torch.empty_like(a) for a in poses]
    outputs: list[Any] = [cpu._gradients(out)]
    if work.views:
        outputs.append(native.ViewGradients(*(a.data_ptr() for a in moved)) if of_poses else None)
    cloud, keep = cpu._cloud(arrays), (arrays, out, poses, moved, value, gradient)

    def forward(kept: Any = keep) -> None:
        native.call(name, cloud, raster, options, cpu._at(value))

    def backward(kept: Any = keep) -> None:
        native.call(f"{name}_backward", cloud, raster, options, cpu._at(gradient), *outputs)

    return Calls(forward, backward)


def torch_calls(work: Workload, add: str) -> Calls:
    """The plain torch implementation on a workload; a backward pass follows the forward pass before it."""
    arrays = [a.requires_grad_() for a in work.cloud()]
    rotations, shape = work.poses()[0].float(), (work.size, work.size)
    gradient = torch.randn(work.views, CHANNELS, *shape, generator=torch.Generator().manual_seed(SEED))
    held: list[Tensor] = []

    def forward() -> None:
        held[:] = [plain_torch.splat(*arrays, rotations, shape, work.cutoff, VARIANCE, add)]  # type: ignore[call-arg]

    return Calls(forward, lambda: torch.autograd.grad(held[0], arrays, gradient))


def minima(competitors: dict[str, Calls], repetitions: int, clock: Callable[[], float] = time.thread_time) -> Any:
    """Shortest seconds (forward, backward) of each competitor, taking turns."""
    best = {name: [float("inf")] * 2 for name in competitors}
    for _ in range(repetitions):
        for name, passes in competitors.items():
            for k, act in enumerate((passes.forward, passes.backward)):
                began = clock()
                act()
                best[name][k] = min(best[name][k], clock() - began)
    return best


def on_isa(isa: str, passes: Calls) -> Calls:
    """The same calls to another build of the library."""

    def forced(act: Callable[[], Any]) -> Callable[[], Any]:
        def call() -> None:
            before = os.environ.get("HOLOSPLAT_ISA", "")
            os.environ["HOLOSPLAT_ISA"] = isa
            act()
            os.environ["HOLOSPLAT_ISA"] = before

        return call

    return Calls(forced(passes.forward), forced(passes.backward))


def machine_ceilings() -> dict[str, float]:
    """1e9 pairs a second: unaligned read-modify-write in rows or in a stream, and fused multiply-adds."""
    source = Path(__file__).with_name("ceiling.cpp")
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/ceiling"
        flags = ["-O3", "-march=native", "-Wno-psabi"]
        subprocess.run([os.environ.get("CXX", "c++"), *flags, str(source), "-o", program], check=True)
        runs = [json.loads(subprocess.run([program], capture_output=True, check=True).stdout) for _ in range(3)]
    best = {key: max(run[key] for run in runs) / 1e9 for key in ("rows", "stream", "fused")}
    return {
        "forward": best["rows"] / CHANNELS,
        "forward_stream": best["stream"] / CHANNELS,
        "backward": best["fused"] / OPERATIONS,
        "fused_multiply_adds": best["fused"],
    }


def errors() -> dict[str, Any]:
    """Largest difference over largest true value, of values and gradients, against the float64 reference."""
    arrays, (rotations, shifts), side = SMALL.cloud(), SMALL.poses(), SMALL.size

    def draw(*a: Tensor, backend: str) -> Tensor:
        return splat(*a, rotations, shifts, (side, side), backend=backend, cutoff=SMALL.cutoff)

    def fill(*a: Tensor, backend: str) -> Tensor:
        return voxelise(*a, (32, 64, 64), backend=backend, cutoff=SMALL.cutoff)

    found: dict[str, Any] = {}
    for name, function in (("", draw), ("voxel_", fill)):
        value, *gradients = _value_and_gradients(partial(function, backend="cpu"), arrays)
        truth, *true = _value_and_gradients(partial(function, backend="reference"), [a.double() for a in arrays])
        each = dict(zip(("centres", "scales", "quaternions", "amplitudes"), map(_error, gradients, true)))
        found |= {f"{name or 'image_'}error": _error(value, truth), f"{name}gradient_error": max(each.values())}
        found[f"{name}gradient_errors"] = each
    return found


def _value_and_gradients(function: Callable[..., Tensor], arrays: list[Tensor]) -> list[Tensor]:
    leaves = [a.detach().requires_grad_() for a in arrays]
    value = function(*leaves)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
    return [value.detach(), *torch.autograd.grad(value, leaves, weights.to(value))]


def _error(value: Tensor, truth: Tensor) -> float:
    return float((value.double() - truth).abs().max() / truth.abs().max())


def memory_mb() -> float:
    """MB by which one forward and backward pass of LARGE exceed what is there before: a process of its own."""
    run = subprocess.run([sys.executable, __file__, "--memory"], capture_output=True, text=True, check=True)
    return float(run.stdout)


def print_memory() -> None:
    """Growth of the peak resident memory; what is there before is the current memory, not an earlier peak."""
    passes, tiny = calls(LARGE, threads=2), calls(Workload(1, 16, 16, (1.0, 4.0), 3.0))
    tiny.forward(), tiny.backward()  # the library itself
    for held in passes.backward.__defaults__[0]:  # type: ignore[index]
        for array in held if isinstance(held, (list, tuple)) else [held]:
            array.mul_(1)  # every page of inputs and outputs
    before = memory_megabytes("VmRSS")
    passes.forward(), passes.backward()
    print(memory_megabytes("VmHWM") - before)


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def rates(repetitions: int) -> dict[str, dict[str, Any]]:
    """Rates of every workload, of every build, with one thread, and with two as wall time."""
    found = {}
    for name, work in (SPLATS | VOXELS).items():
        say(name)
        pairs = (splat_pairs if work.views else voxel_pairs)(work)
        builds = {isa: on_isa(isa, calls(work)) for isa in native.available_isas()}
        seconds = minima(builds, repetitions)
        wall = minima({"1": calls(work), "2": calls(work, 2)}, repetitions, time.perf_counter)
        each = {isa: {"forward": pairs / f / 1e9, "backward": pairs / b / 1e9} for isa, (f, b) in seconds.items()}
        found[name] = {
            **vars(work),
            "pairs": pairs,
            **each[native.available_isas()[-1]],
            "by_isa": each,
            "two_threads": dict(zip(("forward", "backward"), (a / b for a, b in zip(wall["1"], wall["2"])))),
        }
    return found


def pose_costs(repetitions: int) -> dict[str, dict[str, float]]:
    """Milliseconds of the backward pass of every splat on one thread, without and with gradients of its poses."""
    found = {}
    for name, work in SPLATS.items():
        say(f"{name}: gradients of poses")
        seconds = minima({"without": calls(work), "with": calls(work, of_poses=True)}, repetitions)
        found[name] = {key: 1e3 * backward for key, (_, backward) in seconds.items()}
    return found


def measure(repetitions: int) -> dict[str, Any]:
    """Everything, as one flat object with a table of rates in it."""
    torch.set_num_threads(1)
    report: dict[str, Any] = {"seed": SEED, "commit": commit(), **environment("cpu")}
    say("ceilings")
    ceiling = machine_ceilings()
    say("plain torch")
    work = SPLATS[MAIN]
    opponents = {add: torch_calls(work, add) for add in ("index_add_", "scatter_add_")}
    seconds = minima({"ours": calls(work), **opponents}, max(3, repetitions // 4))
    table = rates(repetitions)
    pairs = table[MAIN]["pairs"]
    ours = {
        key: max(table[MAIN][key], pairs / seconds["ours"][k] / 1e9) for k, key in enumerate(("forward", "backward"))
    }
    say("errors, memory")
    return report | {
        "workload": MAIN,
        "pairs": pairs,
        **ours,
        "torch_forward": pairs / seconds["index_add_"][0] / 1e9,
        "torch_backward": pairs / seconds["index_add_"][1] / 1e9,
        "forward_ratio": seconds["index_add_"][0] / seconds["ours"][0],
        "backward_ratio": seconds["index_add_"][1] / seconds["ours"][1],
        "forward_ratio_scatter": seconds["scatter_add_"][0] / seconds["ours"][0],
        "ceilings": ceiling,
        "backward_operations": OPERATIONS,
        "forward_ceiling": ours["forward"] / ceiling["forward"],
        "forward_ceiling_stream": ours["forward"] / ceiling["forward_stream"],
        "backward_ceiling": ours["backward"] / ceiling["backward"],
        **errors(),
        "memory_mb_244k": memory_mb(),
        "workloads": table,
        "backward_ms_of_poses": pose_costs(repetitions),
    }


def as_table(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = ["| 1e9 pairs/s | build | forward | backward | two threads |", "|" + " --- |" * 5]
    for name, row in report["workloads"].items():
        best = list(row["by_isa"])[-1]
        for isa, rate in row["by_isa"].items():
            two = " / ".join(f"{gain:.2f}" for gain in row["two_threads"].values()) if isa == best else ""
            lines.append(f"| {name} | {isa} | {rate['forward']:.2f} | {rate['backward']:.2f} | {two} |")
    lines.append(f"| {MAIN} | torch | {report['torch_forward']:.3f} | {report['torch_backward']:.3f} | |")
    lines += ["", "| backward, ms | without gradients of poses | with them |", "|" + " --- |" * 3]
    for name, cost in report["backward_ms_of_poses"].items():
        lines.append(f"| {name} | {cost['without']:.1f} | {cost['with']:.1f} |")
    keys = (
        "forward_ratio",
        "backward_ratio",
        "forward_ratio_scatter",
        "forward_ceiling",
        "forward_ceiling_stream",
        "backward_ceiling",
        "image_error",
        "gradient_error",
        "voxel_error",
        "voxel_gradient_error",
        "memory_mb_244k",
    )
    lines += ["", *(f"{key}: {report[key]:.3g}" for key in keys)]
    machine = f"{report['machine']['processor']}, torch {report['versions']['torch']}"
    return "\n".join([*lines, "", f"Measured on {machine}; commit {report['commit']}."])


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--memory", action="store_true", help="only the memory, in this very process")
    parser.add_argument("--repetitions", type=int, default=40)
    options = parser.parse_args()
    if options.memory:
        return print_memory()
    report = measure(options.repetitions)
    print(json.dumps(report, indent=2) if options.json else as_table(report))


if __name__ == "__main__":
    main()
