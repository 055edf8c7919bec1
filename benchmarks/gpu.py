"""The GPU's kernels, measured: pairs per second of the splat, forward and backward, its errors; times of the others.

    python benchmarks/gpu.py --json
    python benchmarks/gpu.py --csv docs/data/gpu.csv    # and the steps of step.py, a row each

A pair is a Gaussian and a pixel inside its integer box. 244 000 and 30 000 Gaussians with scales of 1 to 4 px, two
channels, four views of 512 × 512 px, cut at three standard deviations; times are medians of CUDA events around
single calls. Errors are largest differences over largest values, against the float64 reference on a part of the cloud
that it can hold. The others (`others`): surfaces of 16 views, 30 000 of the Gaussians on 128³ voxels, voxels about an
axis and in any pose, a step of total variation, at 512 × 512 px and 256³ voxels. Needs a CUDA GPU and triton.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rows
import torch
from machine import commit
from scipy.spatial.transform import Rotation
from torch import Tensor

CUTOFF, VARIANCE = 3.0, 1 / 12
CHANNELS = 2
SEED = 0

Table = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Sizes:
    """One case: Gaussians, views, pixels along a side, repetitions, and Gaussians of the comparison."""

    count: int
    views: int = 4
    side: int = 512
    repeats: int = 30
    compared: int = 2000


CASES = (Sizes(244_000), Sizes(30_000))


def cloud(sizes: Sizes, device: str) -> tuple[list[Tensor], tuple[Tensor, Tensor]]:
    """Random Gaussians over the field of view, and random views, all on the device."""
    r = torch.Generator().manual_seed(SEED)
    centres = (torch.rand(sizes.count, 3, generator=r) - 0.5) * sizes.side
    scales = 1 + 3 * torch.rand(sizes.count, 3, generator=r)
    others = [torch.randn(sizes.count, width, generator=r) for width in (4, CHANNELS)]
    rotations = torch.from_numpy(Rotation.random(sizes.views, rng=SEED).as_matrix())
    poses = (rotations, torch.zeros(sizes.views, 2, dtype=torch.float64))
    return [a.to(device) for a in (centres, scales, *others)], (poses[0].to(device), poses[1].to(device))


def draw(arrays: list[Tensor], poses: tuple[Tensor, Tensor], sizes: Sizes, backend: str) -> Tensor:
    """The splat of one case."""
    from holosplat.projectors.splat import splat

    options = {"cutoff": CUTOFF, "pixel_variance": VARIANCE, "trusted": True}
    return splat(*arrays, *poses, (sizes.side, sizes.side), backend=backend, **options)


def pairs(arrays: list[Tensor], poses: tuple[Tensor, Tensor], sizes: Sizes) -> int:
    """Gaussians × pixels in their boxes, over all views."""
    from holosplat.projectors.splat import reference

    centres, scales, quaternions = (a.double() for a in arrays[:3])
    total = 0
    for rotation, shift in zip(*poses):
        projected = reference._projected(centres, scales, quaternions, rotation, shift)[:2]
        low, high = reference.boxes(*projected, (sizes.side, sizes.side), CUTOFF, VARIANCE)
        total += int((high - low + 1).clamp(min=0).prod(1).sum())
    return total


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median time of a call on the GPU, after three to warm up."""
    for _ in range(3):
        call()
    events = [(torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) for _ in range(repeats)]
    torch.cuda.synchronize()
    for start, stop in events:
        start.record()
        call()
        stop.record()
    torch.cuda.synchronize()
    return statistics.median(start.elapsed_time(stop) for start, stop in events) * 1e-3


def errors(arrays: list[Tensor], poses: tuple[Tensor, Tensor], sizes: Sizes) -> dict[str, float]:
    """Largest difference over largest value of the image and of each gradient, for the first Gaussians."""
    found = {}
    for backend, dtype in (("cuda", torch.float32), ("reference", torch.float64)):
        leaves = [a[: sizes.compared].to(dtype).requires_grad_() for a in arrays]
        image = draw(leaves, poses, sizes, backend)
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        found[backend] = (image.detach(), *torch.autograd.grad(image, leaves, weights.to(image)))
    names = ("image", "centres", "scales", "quaternions", "amplitudes")
    return {
        name: float((value.double() - true).abs().max() / true.abs().max())
        for name, value, true in zip(names, found["cuda"], found["reference"])
    }


def measure(sizes: Sizes, device: str, time: Callable[[Callable[[], Any], int], float] = seconds) -> dict[str, Any]:
    """Everything about one case."""
    arrays, poses = cloud(sizes, device)
    leaves = [a.requires_grad_() for a in arrays]
    work = pairs([a.detach() for a in leaves], poses, sizes)
    with torch.no_grad():
        forward = time(lambda: draw(leaves, poses, sizes, "cuda"), sizes.repeats)
    image = draw(leaves, poses, sizes, "cuda")
    weights = torch.randn_like(image)
    backward = time(lambda: torch.autograd.grad(image, leaves, weights, retain_graph=True), sizes.repeats)
    moved = [a.clone().requires_grad_() for a in poses]
    image = draw(leaves, (moved[0], moved[1]), sizes, "cuda")
    of_all = time(lambda: torch.autograd.grad(image, [*leaves, *moved], weights, retain_graph=True), sizes.repeats)
    return {
        "gaussians": sizes.count,
        "views": sizes.views,
        "pixels": [sizes.side, sizes.side],
        "channels": CHANNELS,
        "cutoff": CUTOFF,
        "pairs": work,
        "forward_ms": forward * 1e3,
        "backward_ms": backward * 1e3,
        "backward_with_poses_ms": of_all * 1e3,
        "forward_pairs_per_s": work / forward,
        "backward_pairs_per_s": work / backward,
        "errors": errors([a.detach() for a in leaves], poses, sizes),
    }


def others(side: int, edge: int, device: str, time: Callable[[Callable[[], Any], int], float] = seconds) -> Table:
    """Milliseconds of the kernels of starts and surfaces, forward and backward (or the adjoint).

    side: pixels along a frame; edge: voxels along a volume, and pixels along the frames of tomography.
    """
    import holosplat as hs
    from holosplat.baselines.tv_steps import cuda as steps
    from holosplat.projectors.splat import voxelise
    from holosplat.projectors.surface import surface_thickness
    from holosplat.projectors.voxels import LatticeProjector, SliceProjector
    from holosplat.specimens.phantoms import unit_ball

    found, repeats = Table(), 10
    ball, faces = unit_ball(max(2, round(math.log2(side)) - 2))
    points = torch.from_numpy(0.4 * side * ball).to(device).requires_grad_()
    turns = Rotation.random(16, rng=SEED).as_matrix()
    poses = tuple(torch.from_numpy(a).to(device) for a in (turns, np.zeros((16, 2))))
    corners = torch.tensor(faces, device=device)

    def draw_surface() -> Tensor:
        return surface_thickness(points, corners, *poses, (side, side), backend="cuda", trusted=True)

    image = draw_surface()
    found[f"surfaces, {len(faces)} triangles"] = (
        1e3 * time(draw_surface, repeats),
        1e3 * time(lambda: torch.autograd.grad(image, points, image, retain_graph=True), repeats),
    )
    arrays = [a.requires_grad_() for a in cloud(Sizes(30_000, side=edge // 2), device)[0]]

    def draw_volume() -> Tensor:
        return voxelise(*arrays, (edge // 2,) * 3, backend="cuda", trusted=True)

    samples = draw_volume()
    found[f"{len(arrays[0])} Gaussians on {edge // 2}³ voxels"] = (
        1e3 * time(draw_volume, repeats),
        1e3 * time(lambda: torch.autograd.grad(samples, arrays, samples, retain_graph=True), repeats),
    )
    views = hs.Views.evenly_spaced(16, (edge, edge), 1.0)
    grid = hs.Grid.of_views(views)
    for name, kind in (("voxels about an axis", SliceProjector), ("voxels in any pose", LatticeProjector)):
        projector = kind(grid, views, "cuda")
        volume = torch.ones(projector.array_shape, device=device)
        lines = projector.project(volume)
        found[name] = (
            1e3 * time(lambda p=projector, v=volume: p.project(v), repeats),  # type: ignore[misc]
            1e3 * time(lambda p=projector, b=lines: p.backproject(b), repeats),  # type: ignore[misc]
        )
    u, q = torch.ones(grid.shape, device=device), torch.zeros(3, *grid.shape, device=device)
    rest = [torch.ones_like(u) for _ in range(4)]
    found["step of total variation"] = (
        1e3 * time(lambda: steps.ascend(u, q, 0.5, 0.1), repeats),
        1e3 * time(lambda: steps.descend(rest[0], rest[1], q, 1.0, (0.0, 1.0), rest[2], rest[3]), repeats),
    )
    return found


def origin() -> dict[str, str]:
    """Device, versions and commit."""
    import triton

    return {
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "torch": torch.__version__,
        "triton": triton.__version__,
        "numpy": np.__version__,
        "commit": commit(),
    }


def written(cases: list[dict[str, Any]], rest: Table, steps: dict[str, float], path: Path) -> None:
    """Rows in a CSV file: what was computed, which way, its time [ms], rate [pairs/s] and largest error."""
    about = {name: value for name, value in origin().items() if name != "numpy"} | {"seed": SEED}
    found: list[tuple[str, str, float, float | str, float | str]] = []
    for c in cases:
        for way in ("forward", "backward", "backward_with_poses"):
            rate, error = c.get(f"{way}_pairs_per_s", ""), max(c["errors"].values()) if way == "forward" else ""
            found.append((f"splat of {c['gaussians']} Gaussians", way.replace("_", " "), c[f"{way}_ms"], rate, error))
    for name, (forward, backward) in rest.items():
        found += [(name, "forward", forward, "", ""), (name, "backward", backward, "", "")]
    found += [(name.replace("step_ms_", "step of "), "all", time, "", "") for name, time in steps.items()]
    columns = ("what", "way", "ms", "pairs_per_s", "error")
    digits = [[f"{x:.4g}" if isinstance(x, float) else x for x in one] for one in found]
    rows.write([dict(zip(columns, one)) | about for one in digits], path)


def main() -> None:
    """Measure all cases and print them."""
    parser = argparse.ArgumentParser(description="Speed and errors of the GPU's splat.")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a Markdown table")
    parser.add_argument("--csv", type=Path, help="also measure steps, and write all to this file")
    options = parser.parse_args()
    if importlib.util.find_spec("triton") is None:
        sys.exit("This benchmark needs triton, which is not installed (pip install 'holosplat[gpu]').")
    if not torch.cuda.is_available():
        sys.exit("This benchmark needs a CUDA GPU, and torch sees none.")
    cases = [measure(sizes, "cuda") for sizes in CASES]
    rest = others(512, 256, "cuda")
    if options.csv:
        from step import on_gpu

        written(cases, rest, on_gpu(), options.csv)
    report = {**origin(), "cases": cases, "others_ms": rest}
    if options.json:
        print(json.dumps(report, indent=2))
        return
    print(" · ".join(f"{name} {value}" for name, value in origin().items()), end="\n\n")
    print("| Gaussians | pairs | forward ms | pairs/s | backward ms | pairs/s | largest error |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for c in cases:
        rates = [f"{c['forward_ms']:.3g} | {c['forward_pairs_per_s']:.3g}",
                 f"{c['backward_ms']:.3g} | {c['backward_pairs_per_s']:.3g}"]  # fmt: skip
        print(f"| {c['gaussians']} | {c['pairs']} | {' | '.join(rates)} | {max(c['errors'].values()):.1e} |")
    print("\n| kernel | forward ms | backward ms |\n| --- | --- | --- |")
    for name, (forward, backward) in rest.items():
        print(f"| {name} | {forward:.3g} | {backward:.3g} |")


if __name__ == "__main__":
    main()
