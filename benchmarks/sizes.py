"""How quality, time and memory grow with the frames: the first case of the suite on finer and finer pixels.

    python benchmarks/sizes.py                                          # 64, 128 and 256 pixels across the same field
    python benchmarks/sizes.py --pixels 512 1024 --method auto --csv docs/data/sizes.csv
    python benchmarks/sizes.py --pixels 512 --surfaces                  # and surfaces after the Gaussians
    python benchmarks/sizes.py --pixels 256 --bodies 60 --diameter 88   # pixels of 1.6 µm: a third of the field is full
    python benchmarks/sizes.py --pixels 128 1024 2048 --method auto --backend cuda

24 generated cells in a field of 410 µm, 20 keV, 10 cm, 12 views for the fit and 4 held out, haemoglobin known, without
noise. Prints a Markdown table; `--csv` adds each row to a file as it comes. Each size runs in a process of its own,
whose peak of memory during the reconstruction is told.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # without bytecode, a second of each run would be Python's compiler

import numpy as np
import rows
from machine import commit

import holosplat as hs
from holosplat.backends import Backend, device_name, resolve
from holosplat.methods import METHODS
from holosplat.methods.surface_fit import oversampling
from holosplat.representations import Stored
from holosplat.workflows.evaluate import Scores, score_object

FIELD = 128 * 3.2e-6
DIAMETER = 20 * 3.2e-6
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
MOST_VOXELS = 1 << 24
"""Voxels that are compared at a time: a thousand cubed do not fit into memory."""
SCORES = ("ssim", "frcm", "dice", "relative_error_delta")


class Peak:
    """The largest resident size [GiB] while it is entered, looked at every 20 ms."""

    def __enter__(self) -> Peak:
        self.gib, self._done = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._done.wait(0.02):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.gib = max(self.gib, pages * os.sysconf("SC_PAGE_SIZE") / 2**30)


def volume_numbers(found: hs.volume.Object, scene: hs.MeshScene, grid: hs.Grid) -> dict[str, float]:
    """Dice and relative error of δ as `hs.evaluate` has them (docs/conventions.md), some rows of voxels at a time."""
    depth, height, width = grid.shape
    both = either = missed = whole = 0.0
    rows = max(1, MOST_VOXELS // (depth * width))
    for first in range(0, height, rows):
        part = grid.block((0, first, 0), (depth, min(rows, height - first), width))
        true, other = part_of(scene, part), part_of(found, part)
        matter, of_found = (volume > 0.5 * MATERIAL.delta for volume in (true, other))
        both, either = both + 2.0 * (matter & of_found).sum(), either + float(matter.sum()) + float(of_found.sum())
        missed, whole = missed + float(np.square(other - true).sum()), whole + float(np.square(true).sum())
    return {"dice": both / either, "relative_error_delta": (missed / whole) ** 0.5}


def part_of(obj: hs.volume.Object, grid: hs.Grid) -> np.ndarray:
    """δ [Z, Y, X] float64 of some rows of voxels, of which surfaces are looked at that reach into them."""
    low = grid.origin[1] - grid.voxel_size[1]
    high = low + (grid.shape[1] + 1) * grid.voxel_size[1]
    if isinstance(obj, hs.MeshScene):
        near = [mesh for mesh in obj.meshes if mesh.bounds[1][1] >= low and mesh.bounds[0][1] <= high]
        if not near:
            return np.zeros(grid.shape)
        obj = hs.MeshScene.of_one_material(near, MATERIAL)
    if isinstance(obj, hs.representations.SurfaceMesh):
        y = obj.vertices[:, 1][obj.faces] * obj.unit_length
        faces = obj.faces[(y.amax(1) >= low) & (y.amin(1) <= high)]
        if not len(faces):
            return np.zeros(grid.shape)
        obj = hs.representations.SurfaceMesh(obj.vertices, faces, obj.unit_length, obj.matter, obj.lines).on(
            obj.backend
        )
    return obj.voxelise(grid).delta.astype(np.float64)


def machine_of(backend: str) -> str:
    """The processors, and the GPU if that is what computes."""
    cores = f"{os.cpu_count()} × {os.uname().machine}"
    return f"{device_name(backend)}, {cores}" if backend == "cuda" else cores


def measure(
    pixels: int, seed: int, method: str, scene: tuple[int, float], surfaces: bool = False, backend: Backend = "auto"
) -> Iterator[dict[str, object]]:
    """A row of the table; surfaces: and one for those that are fitted after it. scene: bodies, and their diameter."""
    (bodies, diameter), used = scene, resolve(backend)
    pitch = FIELD / pixels
    cells = hs.MeshScene.of_one_material(hs.specimens.random_cells(bodies, (FIELD,) * 3, seed, diameter), MATERIAL)
    views = hs.Views.evenly_spaced(16, (pixels, pixels), pitch)
    scan = hs.simulate(cells, hs.Exposures.of(views, 20.0, 0.1, 0.05), seed=seed)
    began, cpu = time.perf_counter(), time.process_time()
    with Peak() as peak:
        chosen = METHODS[method]
        chosen = chosen.on_backend(backend) if chosen.any_backend or backend != "auto" else chosen
        result = hs.reconstruct(scan, hs.MaterialPrior.known(MATERIAL), chosen, seed)
    taken = time.perf_counter() - began, time.process_time() - cpu
    grid = hs.Grid.of_views(views)

    def row(called: str, obj: Stored, scores: Scores, taken: tuple[float, float], gib: float) -> dict[str, object]:
        found = scores.headline() | volume_numbers(obj, cells, grid)
        return {
            "pixels": pixels,
            "pitch_um": f"{1e6 * pitch:.3g}",
            "bodies": bodies,
            "diameter_um": f"{1e6 * diameter:.3g}",
            "method": called,
            "seed": seed,
            **{name: f"{found[name]:.4f}" for name in SCORES},
            "result": obj.described,
            "seconds": f"{taken[0]:.1f}",
            "cpu_seconds": f"{taken[1]:.1f}",
            "start_seconds": f"{result.timing['start'] if called == method else 0.0:.1f}",
            "peak_gib": f"{gib:.2f}",
            "load": f"{os.getloadavg()[0]:.1f}",
            "machine": machine_of(used),
            "commit": commit(),
        }

    yield row(method, result.object, hs.evaluate(result, scan, None), taken, peak.gib)
    if not surfaces:
        return
    began, cpu = time.perf_counter(), time.process_time()
    with Peak() as peak:
        how = hs.methods.SurfaceOptions(fit=hs.methods.SurfaceFit(backend=backend))
        after = hs.methods.refine_surfaces(result.object, scan, how)
    taken = time.perf_counter() - began, time.process_time() - cpu
    scores = score_object(after, scan, None, oversampling(scan.train()), used)
    yield row(f"surfaces after {method}", after, scores, taken, peak.gib)


def main() -> None:
    """One process a size, in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--method", nargs="+", default=["gaussians"], choices=sorted(METHODS))
    parser.add_argument("--bodies", type=int, default=24)
    parser.add_argument("--diameter", type=float, default=1e6 * DIAMETER, help="of the bodies [µm]")
    parser.add_argument("--seed", type=int, default=103)
    parser.add_argument("--surfaces", action="store_true", help="also fit surfaces after Gaussians")
    parser.add_argument("--backend", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--one", action="store_true", help="in this process")
    options = parser.parse_args()
    if options.one:
        scene = (options.bodies, 1e-6 * options.diameter)
        for row in measure(
            options.pixels[0], options.seed, options.method[0], scene, options.surfaces, options.backend
        ):
            print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)
            if options.csv:
                rows.write([*rows.read(options.csv), row], options.csv)
        return
    same = ["--bodies", str(options.bodies), "--diameter", str(options.diameter), "--seed", str(options.seed)]
    same += ["--backend", options.backend]
    same += ["--csv", str(options.csv)] if options.csv else []
    same += ["--surfaces"] if options.surfaces else []
    for pixels in options.pixels:
        for method in options.method:
            one = ["--one", "--pixels", str(pixels), "--method", method, *same]
            subprocess.run([sys.executable, __file__, *one], check=True)


if __name__ == "__main__":
    main()
