"""What equations of motion add to a field of space and time: rows of docs/data/pinn.csv.

    python benchmarks/pinn.py [--cases channel espresso] [--data DATA] [--views 2 3 4] [--seeds 11 12] [--write]

`channel`: four red cells of 8 µm that Poiseuille's flow between the walls of a round tube carries along the rotation
axis, at six times, two pixels a time on the tube's axis; every point of a membrane goes with the flow, so that cells
shear and turn, and the equations hold exactly. `swirl`: such cells, which turn about the axis like a solid body, by 40°
over all times; that obeys the equations, too. Images of 64 × 48 pixels of 0.5 µm (20 keV, 10 cm, 1000 photons a
pixel, haemoglobin, which is known). `espresso` (with DATA, the snapshots of an ESPResSo run, as for motion.py): cells
with membranes of their own in a rectangular channel, every second snapshot, on 64 × 48 pixels of 1 µm; there cells also
enter and leave. Views are even over 180°. Each seed has other photons and another start, and but for `espresso` other
cells.

Three fields are fitted to the same frames from the same start, each time by itself: without equations, with a velocity
without divergence by construction, and with three free components whose divergence is a term. With --write rows stand
in the file in place of earlier ones of the same case, views, equations and seed.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import replaced, shown

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.mesh import TriangleMesh
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.metrics import volume_scores
from holosplat.specimens.scene import MeshSeries
from holosplat_bench.opponents.fields import SpaceTimeField
from holosplat_bench.opponents.pinn import EachTime, Pinn

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "pinn.csv"
SHAPE, PHOTONS, TIMES = (64, 48), 1000.0, 6
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
CELLS, BOX, WALL, PEAK = 4, (22e-6, 22e-6, 22e-6), 14e-6, 5e-6
"""Of `channel`: red cells, the box in which they are at half time [m], radius of the tube [m], and way of the fluid on
its axis over all times [m]."""
TURN = np.radians(40)
"""Of `swirl`: over all times."""
PIXELS = {"channel": 0.5e-6, "swirl": 0.5e-6, "espresso": 1e-6}
EVERY = 2
"""Snapshots of ESPResSo from one time to the next."""
EQUATIONS = ("none", "curl", "free")


@dataclass(frozen=True)
class Row:
    """Of one field. dice, error: of occupancy, means over the times; least_dice: of the worst time; velocity_error:
    mean distance from the true velocity over its mean size, at the nodes of the membranes half way from one time to
    the next; aligned: cosine between the two; cpu_seconds: of the fit, and start_seconds of the start."""

    case: str
    views: int
    equations: str
    seed: int
    dice: float
    least_dice: float
    error: float
    velocity_error: float
    aligned: float
    cpu_seconds: float
    start_seconds: float
    machine: str
    commit: str


def carried(seed: int, motion: Callable[[np.ndarray, float], np.ndarray]) -> MeshSeries:
    """Red cells whose nodes [P, 3] a `motion` carries; its time goes from -1/2 to 1/2."""
    cells = hs.specimens.random_cells(CELLS, BOX, seed)
    snapshots = tuple(
        hs.MeshScene.of_one_material(
            [TriangleMesh(motion(cell.vertices, part), cell.faces, cell.name) for cell in cells], MATERIAL
        )
        for part in np.linspace(-0.5, 0.5, TIMES)
    )
    return MeshSeries(snapshots, np.linspace(0.0, 1e-3, TIMES))


def channel(nodes: np.ndarray, part: float) -> np.ndarray:
    """A flow along y, whose speed falls with the square of the distance from the axis."""
    x, _, z = nodes.T
    return nodes + (part * PEAK * (1 - (x**2 + z**2) / WALL**2))[:, None] * [0.0, 1.0, 0.0]


def swirl(nodes: np.ndarray, part: float) -> np.ndarray:
    """A turn about y."""
    c, s = np.cos(TURN * part), np.sin(TURN * part)
    return nodes @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T


def espresso(data: Path) -> MeshSeries:
    """Those of ESPResSo."""
    from motion import cells_in_flow

    return cells_in_flow(data, 0, TIMES, EVERY)


def imaged(cells: MeshSeries, views: int, pixel: float, seed: int) -> hs.Scan:
    """The frames of all views at all times."""
    raster = hs.Views.from_angles(np.arange(views) * 180 / views, SHAPE, pixel)
    exposures = hs.Exposures.of(raster, 20.0, 0.1).repeated(cells.times)
    nothing = np.zeros(len(exposures), dtype=bool)
    return hs.simulate(cells, exposures, photons_per_pixel=PHOTONS, seed=seed, is_test=nothing)


def velocities(found: SpaceTimeField, cells: MeshSeries) -> tuple[float, float]:
    """Relative error of the velocity of the membranes' nodes in the field, and its cosine with the true one."""
    ours, true = [], []
    reach = 0.5 * np.array(found.grid.shape[::-1]) * found.grid.voxel_size
    for k in range(len(cells.times) - 1):
        before, after = (np.concatenate([mesh.vertices for mesh in cells.snapshots[n].meshes])[::5] for n in (k, k + 1))
        step, middle = cells.times[k + 1] - cells.times[k], 0.5 * (before + after)
        inside = (np.abs(middle) < reach).all(axis=1)
        true.append(((after - before) / step)[inside])
        with torch.no_grad():
            points = torch.from_numpy(middle[inside])
            ours.append(found.velocity(points, float(cells.times[k] + 0.5 * step)).double().numpy())
    v, w = np.concatenate(ours), np.concatenate(true)
    size = max(float(np.linalg.norm(v)), np.finfo(float).tiny)
    wrong = np.linalg.norm(v - w, axis=1).mean() / np.linalg.norm(w, axis=1).mean()
    return float(wrong), float((v * w).sum() / size / np.linalg.norm(w))


def method(equations: str) -> Pinn:
    """The method as it is by default, but for the equations."""
    usual = Pinn()
    fit = usual.fit
    if equations == "none":
        return replace(usual, fit=replace(fit, equations=replace(fit.equations, continuity=0.0)))
    network = replace(fit.space_time.velocity, solenoidal=equations == "curl")
    return replace(usual, fit=replace(fit, space_time=replace(fit.space_time, velocity=network)))


def fitted(how: Pinn, start: SpaceTimeField, task: Task) -> SpaceTimeField:
    """The field after all stages but the first, which made the matter of `start`."""
    options = how.fit.space_time
    weights = options.velocity.started(task.seed)
    found = SpaceTimeField(start.coefficients, weights, start.grid, start.basis, start.matter, options, start.upper)
    for stage in how.stages()[1:]:
        fit = stage.fit(task, found)
        assert fit is not None
        fit.run(lambda record: None)
        result = fit.result().object
        assert isinstance(result, SpaceTimeField)
        found = result
    return found


def rows_of(case: str, views: int, seed: int, chosen: list[str], data: Path | None) -> Iterator[Row]:
    """The start, and the field of each of the `chosen` equations."""
    cells = espresso(data) if data is not None else carried(seed, {"channel": channel, "swirl": swirl}[case])
    scan = imaged(cells, views, PIXELS[case], seed)
    grid = Grid.of_views(scan.views)
    truth = [cells.at(t).voxelise(grid) for t in cells.times]
    task = prepared(Task(scan, hs.MaterialPrior.known(MATERIAL), seed))
    machine = f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared"
    began = time.process_time()
    first = EachTime(Pinn().volume, Pinn().fit).start(task, None)
    spent = time.process_time() - began

    def row(name: str, found: SpaceTimeField, seconds: float, flow: bool) -> Row:
        scores = [volume_scores(found.at(t).voxelise(grid), true) for t, true in zip(cells.times, truth)]
        dice = np.array([one.dice for one in scores])
        wrong = float(np.mean([one.relative_error_delta for one in scores]))
        moving = velocities(found, cells) if flow else (float("nan"), float("nan"))
        told = (float(dice.mean()), float(dice.min()), wrong, *moving, seconds, spent)
        return Row(case, views, name, seed, *told, machine, commit())

    yield row("start", first, 0.0, False)
    for name in chosen:
        began = time.process_time()
        found = fitted(method(name), first, task)
        yield row(name, found, time.process_time() - began, name != "none")


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=PIXELS, default=["channel"])
    parser.add_argument("--data", type=Path, help="of espresso")
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4])
    parser.add_argument("--equations", nargs="+", choices=EQUATIONS, default=list(EQUATIONS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[11, 12])
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    if "espresso" in asked.cases and asked.data is None:
        parser.error("espresso needs --data")
    for case, seed, views in product(asked.cases, asked.seeds, asked.views):
        data = asked.data if case == "espresso" else None
        for row in rows_of(case, views, seed, asked.equations, data):
            shown(row)
            if asked.write:
                replaced(PAGE, row, key=4)


if __name__ == "__main__":
    main()
