"""Line integrals along the rays of cones, and their adjoint, beside itk-rtk's: how far apart they are, and the time.
Whole runs on scans of cones, beside the same in parallel beams, and with the cone taken for one.

    python benchmarks/cones.py --csv docs/data/cones.csv     # minutes; needs itk-rtk (extra `bench`)
    python benchmarks/cones.py --runs docs/data/cone_runs.csv   # ten minutes

A smooth volume of three Gaussians, seen from all around by a source at `distance` voxels, so that `tangent` is that of
half the cone's angle. `error` is the norm of the difference of the images over the norm; `joseph` is itk-rtk's ray
caster. `seconds` is processor time on one thread, the least of three runs in turn, of a projector that is made, as in
iterations; `made_seconds` is what making it takes beside.

Runs are of three ellipsoids of PMMA, millimetres large, as in a laboratory: 20 keV, 21 noisy views for training, 3 held
out, absorption and hardly a fringe. Meshes are projected exactly, which no reconstruction does.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import commit
from rows import machine, replaced, shown, write

import holosplat as hs
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.materials import parse_material
from holosplat.methods import METHODS
from holosplat.projectors.voxels import RayProjector
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene

COLUMNS = (
    "size", "rows", "views", "distance", "tangent", "error", "made_seconds", "seconds", "joseph_seconds",
    "times_faster", "adjoint_seconds", "joseph_adjoint_seconds", "adjoint_times_faster", "machine", "commit",
)  # fmt: skip
BLOBS = ((-0.1, 0.05, 0.12, 0.12, 1.0), (0.15, -0.08, 0.06, 0.08, 0.5), (0.05, 0.12, -0.18, 0.06, 0.8))
"""Centre x, y, z and width, over the volume's size, and peak."""
RUNS = 3


def blobs(grid: Grid) -> np.ndarray:
    """The volume [Z, Y, X], float32."""
    (x, y, z), n = grid.axes(), grid.shape[0]
    parts = [
        peak * np.exp(-((x - a * n) ** 2 + (y[:, None] - b * n) ** 2 + (z[:, None, None] - c * n) ** 2) / (s * n) ** 2)
        for a, b, c, s, peak in BLOBS
    ]
    return np.sum(parts, axis=0).astype(np.float32)


class Joseph:
    """itk-rtk's forward projector and its adjoint. It turns the other way round, and has columns the other way."""

    def __init__(self, grid: Grid, angles: np.ndarray, raster: tuple[int, int], distance: float) -> None:
        itk: Any = importlib.import_module("itk")
        itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(torch.get_num_threads())
        self._itk, self._rtk, self._kind = itk, itk.RTK, itk.Image[itk.F, 3]
        self._shape, self._raster = grid.shape, (len(angles), *raster)
        self._geometry = itk.RTK.ThreeDCircularProjectionGeometry.New()
        for angle in angles:  # a detector as far behind the axis as the source is before it, with pixels twice as large
            self._geometry.AddProjection(distance, 2 * distance, float(180 - angle))

    def _image(self, array: np.ndarray, pixel: float, depth: float) -> Any:
        image = self._itk.image_from_array(array)
        _, rows, columns = array.shape
        image.SetOrigin([-pixel * (columns - 1) / 2, -pixel * (rows - 1) / 2, depth])
        image.SetSpacing([pixel, pixel, 1.0])
        return image

    def _run(self, name: str, target: Any, source: Any) -> np.ndarray:
        found = getattr(self._rtk, name)[self._kind, self._kind].New()
        found.SetInput(0, target)
        found.SetInput(1, source)
        found.SetGeometry(self._geometry)
        found.Update()
        return self._itk.array_from_image(found.GetOutput())

    def project(self, volume: np.ndarray) -> np.ndarray:
        """[Z, Y, X] → [V, H, W]."""
        seen = self._image(np.zeros(self._raster, np.float32), 2.0, 0.0)
        whole = self._image(volume, 1.0, -(self._shape[0] - 1) / 2)
        return self._run("JosephForwardProjectionImageFilter", seen, whole)[:, :, ::-1]

    def backproject(self, images: np.ndarray) -> np.ndarray:
        """[V, H, W] → [Z, Y, X]."""
        whole = self._image(np.zeros(self._shape, np.float32), 1.0, -(self._shape[0] - 1) / 2)
        seen = self._image(np.ascontiguousarray(images[:, :, ::-1]), 2.0, 0.0)
        return self._run("JosephBackProjectionImageFilter", whole, seen)


def least(works: list[Callable[[], Any]]) -> list[float]:
    """The least processor time of each, which run in turn."""
    times = []
    for _ in range(RUNS):
        for work in works:
            start = time.process_time()
            work()
            times.append(time.process_time() - start)
    return [min(times[k :: len(works)]) for k in range(len(works))]


def compared(size: int, rows: int, views: int, distance: float, chosen_machine: str) -> dict[str, Any]:
    """A row of the table."""
    grid = Grid.centred((size, rows, size), 1.0)
    angles = np.arange(views) * 360.0 / views + 3
    seen = Views(Views.from_angles(angles, (rows, size), 1.0).rotations, np.zeros((views, 2)), (rows, size), 1.0, None,
                 np.full(views, distance))  # fmt: skip
    volume, other = blobs(grid), Joseph(grid, angles, (rows, size), distance)
    given = torch.from_numpy(volume)
    ours, theirs = RayProjector(grid, seen).project(given), other.project(volume)
    error = float(np.linalg.norm(ours.numpy() - theirs) / np.linalg.norm(theirs))
    projector = RayProjector(grid, seen)
    made, *times = least(
        [lambda: RayProjector(grid, seen), lambda: projector.project(given), lambda: other.project(volume)]
    )
    back = least([lambda: projector.backproject(ours), lambda: other.backproject(theirs)])
    found = (error, made, *times, times[1] / times[0], *back, back[1] / back[0])
    numbers = (size, rows, views, distance, 0.5 * size / distance, *(float(f"{value:.3g}") for value in found))
    return dict(zip(COLUMNS, (*numbers, chosen_machine, commit())))


@dataclass(frozen=True)
class Run:
    """tangent: of half the cone's angle; beam: cone, parallel, or the frames of a cone taken for parallel; error, dice:
    of δ, against the truth; seconds: of the processor"""

    tangent: float
    beam: str
    method: str
    seed: int
    error: float
    dice: float
    seconds: float
    machine: str
    commit: str


def run(tangent: float, beam: str, method: str, seed: int) -> Run:
    """One reconstruction."""
    shape, pixel, energy, draw = (56, 64), 50e-6, 20.0, np.random.default_rng(seed)
    (vertices, faces), material = icosphere(4), parse_material("PMMA").delta_beta(energy)
    scene = MeshScene.of_one_material(
        [
            hs.mesh.TriangleMesh(pixel * (radius * vertices * draw.uniform(0.7, 1.1, 3) + at), faces)
            for radius, at in ((11, (0, -6, 8)), (8, (-14, 10, -4)), (6, (13, 11, -9)))
        ],
        material,
    )
    views = Views.evenly_spaced(24, shape, pixel)
    source = None if beam == "parallel" else np.full(24, 0.5 * shape[1] * pixel / tangent)
    exposures = hs.Exposures.of(replace(views, sources=source), energy, 8e-3)
    scan = simulate(scene, exposures, photons_per_pixel=1e5, seed=seed, is_test=np.arange(24) % 8 == 4)
    if beam == "taken for parallel":
        scan = replace(scan, exposures=replace(exposures, views=views))
    start = time.process_time()
    found = hs.reconstruct(scan, hs.MaterialPrior.known(material), METHODS[method], seed)
    seconds = time.process_time() - start
    scores = hs.evaluate(found, scan, scene.voxelise(Grid.of_views(views))).volume
    assert scores is not None
    return Run(tangent, beam, method, seed, scores.relative_error_delta, scores.dice, seconds, machine(), commit())


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--size", type=int, nargs="+", default=[96, 160])
    parser.add_argument("--machine", default="x86_64, one core, shared")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for seed, tangent, method in product((1, 2), (0.1, 0.3), ("tikhonov-tv", "voxels", "auto") if chosen.runs else ()):
        for beam in ("cone", "parallel", "taken for parallel"):
            row = run(tangent, beam, method, seed)
            shown(row)
            replaced(chosen.runs, row, key=4)
    if chosen.csv is None:
        return
    found = [compared(n, n * 4 // 5, n * 3 // 4, s * n, chosen.machine) for n in chosen.size for s in (10.0, 2.5)]
    write(found, chosen.csv, COLUMNS)
    for row in found:
        print(row)


if __name__ == "__main__":
    main()
