"""How well `track` follows cells that flow: rows of docs/data/motion.csv.

    python benchmarks/motion.py DATA [--cases flow4 …] [--times 16] [--first 0] [--every 1] [--ablation …] [--write]

DATA holds the snapshots of an ESPResSo run, as for espresso_flow.py: 16 cells of 8 µm, 17.7 µs apart, imaged with the
flow along the rotation axis on 128 × 96 pixels of 0.5 µm (20 keV, 10 cm, 1000 photons a pixel, haemoglobin, which is
known). Cells enter and leave through the ends of the field. The simulation's projector is not that of the fit. A table
is printed; with --write its rows stand in the file in place of earlier ones of the same case and times. --every 2 takes
every second snapshot. --ablation leaves priors out, one at a time (all of them, or those that are named), whose rows go
to docs/data/motion_ablation.csv.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from espresso_flow import Run
from machine import commit, memory_megabytes
from rows import replaced, shown
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.bodies.rest_shape import KnownBody, centroid, second_moments
from holosplat.geometry import Grid
from holosplat.mesh import TriangleMesh
from holosplat.metrics import volume_scores
from holosplat.motion.fit import MotionFit
from holosplat.motion.measures import standard_errors
from holosplat.motion.track import Followed, TrackOptions, follow
from holosplat.representations import MovingSurfaces
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshSeries

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "motion.csv"
ABLATION = PAGE.with_name("motion_ablation.csv")
ANGLES = {
    "flow4": (0.0, 45.0, 90.0, 135.0),
    "flow3": (0.0, 30.0, 48.0),
    "flow2": (0.0, 90.0),
    "flow2n": (0.0, 23.8),
    "flow2-ellipsoids": (0.0, 90.0),
    "flow3-tomography": (0.0, 30.0, 48.0),
    "flow3-body": (0.0, 30.0, 48.0),
    "flow2-body": (0.0, 90.0),
    "flow2n-body": (0.0, 23.8),
}
BODY = "-body"
"""End of the names of cases in which the cells are known to be red cells."""
UNLEARNED = "-tomography"
"""End of the names of cases in which no network is asked."""
FOREIGN = "-ellipsoids"
"""End of the names of cases of stiff ellipsoids of the cells' volume, which go and turn as the cells do."""
ELLIPSOID = (1.4, 1.0, 1 / 1.4)
"""Their half axes, over the radius of a ball of their volume; the shortest is across a resting cell."""
SHAPE, PIXEL, PHOTONS = (128, 96), 0.5e-6, 1000.0
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
TURN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Takes the flow, along x in the files, to the rotation axis y."""
PRIORS = ("none", "acceleration", "volume_kept", "area_kept", "curvature", "apart", "stiffness")
"""What an ablation leaves out, one at a time; none: nothing."""
FOLLOWED = 1e-6
"""A cell counts as followed if some body's centre stays within this distance [m], in the median over times."""


@dataclass(frozen=True)
class Row:
    """Of one run. every: snapshots from one time to the next; without: the prior that is left out; dice, error: of
    occupancy, means over times; least_dice: of the worst time; cells: whole in the field at half of the times or more;
    followed: of these; bodies: found in all; centre_um: median distance of the centres of followed cells; volume_error,
    volume_spread, area_spread: of their volumes and areas beside the true ones over time, medians over cells [shares];
    overlap: share of the matter that lies in two bodies, mean over times; centre_over_error, volume_over_error: root
    mean squares of what centres (each coordinate) and volumes of followed cells are off by, over their standard errors,
    while the cells are whole in the field: one where errors are right."""

    case: str
    times: int
    first: int
    every: int
    seed: int
    without: str
    dice: float
    error: float
    least_dice: float
    cells: int
    followed: int
    bodies: int
    centre_um: float
    volume_error: float
    volume_spread: float
    area_spread: float
    overlap: float
    centre_over_error: float
    volume_over_error: float
    seconds: float
    cpu_seconds: float
    memory_mb: float
    machine: str
    commit: str


def cells_in_flow(data: Path, first: int, times: int, every: int = 1) -> MeshSeries:
    """The cells at `times` snapshots from `first` on, `every` so many, in the object frame."""
    run = Run.read(data, first + every * (times - 1) + 1)
    middle = 0.5e-6 * np.array(run.parameters["box_um"])
    nodes, when = (run.nodes[first::every] - middle) @ TURN.T, run.times[first::every] - run.times[first]
    snapshots = [[TriangleMesh(cell, run.rest.faces, f"cell{k:02d}") for k, cell in enumerate(at)] for at in nodes]
    return MeshSeries(tuple(hs.MeshScene.of_one_material(at, MATERIAL) for at in snapshots), when)


def ellipsoids(cells: MeshSeries) -> MeshSeries:
    """Stiff ellipsoids in the place of `cells`, turned as the best rigid motion from the first time on turns these."""
    (ball, faces), first = icosphere(3), cells.snapshots[0].meshes
    radius = (3 * np.mean([mesh.volume for mesh in first]) / (4 * np.pi)) ** (1 / 3)
    axes = [np.linalg.eigh(second_moments(mesh))[1][:, ::-1] for mesh in first]
    snapshots = []
    for scene in cells.snapshots:
        found = []
        for start, mesh, frame in zip(first, scene.meshes, axes):
            turn, _ = Rotation.align_vectors(mesh.vertices - centroid(mesh), start.vertices - centroid(start))
            own = turn.as_matrix() @ frame * np.array([1, 1, np.linalg.det(frame)])
            found.append(TriangleMesh((ball * ELLIPSOID * radius) @ own.T + centroid(mesh), faces, mesh.name))
        snapshots.append(hs.MeshScene.of_one_material(found, MATERIAL))
    return MeshSeries(tuple(snapshots), cells.times)


def imaged(cells: MeshSeries, angles: tuple[float, ...], seed: int) -> hs.Scan:
    """The frames of all beams at all times."""
    views = hs.Views.from_angles(np.array(angles), SHAPE, PIXEL)
    exposures = hs.Exposures.of(views, 20.0, 0.1).repeated(cells.times)
    return hs.simulate(
        cells, exposures, photons_per_pixel=PHOTONS, seed=seed, is_test=np.zeros(len(exposures), dtype=bool)
    )


def volumes(found: MovingSurfaces, cells: MeshSeries, scan: hs.Scan) -> np.ndarray:
    """[T, 3] at every time: Dice, relative error of δ, and share of the matter that lies in two bodies."""
    grid, rows = Grid.of_views(scan.views), []
    for t in cells.times:
        ours = found.at(t).voxelise(grid)
        scores, twice = volume_scores(ours, cells.at(t).voxelise(grid)), np.maximum(ours.delta - found.matter.delta, 0)
        rows.append((scores.dice, scores.relative_error_delta, twice.sum() / ours.delta.sum()))
    return np.array(rows)


def over_errors(found: Followed, cells: MeshSeries, scan: hs.Scan) -> tuple[float, float]:
    """Root mean squares of errors over standard errors, of centres and volumes of followed cells in the field."""
    errors, centres, sizes = standard_errors(found.bodies, found.halves, scan), [], []
    meshes = [found.bodies.bodies(float(t)) for t in cells.times]
    for k, body in followed(found.bodies, cells):
        for t, scene in enumerate(cells.snapshots):
            true, ours = scene.meshes[k], meshes[t][body]
            if not is_whole(true):
                continue
            away = (centroid(ours) - centroid(true)) / [errors[f"{axis}_m"][t, body] for axis in "xyz"]
            centres.append(np.mean(away**2))
            sizes.append(((ours.volume - true.volume) / errors["volume_m3"][t, body]) ** 2)
    return float(np.mean(centres) ** 0.5), float(np.mean(sizes) ** 0.5)


def followed(found: MovingSurfaces, cells: MeshSeries) -> list[tuple[int, int]]:
    """Cells that are whole in the field at half of the times, with the body that follows each."""
    pairs, kept = [], identities(found, cells)
    whole = [np.mean([is_whole(scene.meshes[k]) for scene in cells.snapshots]) for k in range(_count(cells))]
    for k, row in zip((k for k in range(_count(cells)) if whole[k] >= 0.5), kept):
        if row[1] < FOLLOWED:
            pairs.append((k, int(row[0])))
    return pairs


def is_whole(mesh: TriangleMesh) -> bool:
    """Whether a cell is whole in the field, whose rows end along the flow."""
    return bool(np.abs(mesh.vertices[:, 1]).max() < 0.5 * SHAPE[0] * PIXEL)


def _count(cells: MeshSeries) -> int:
    return len(cells.snapshots[0].meshes)


def identities(found: MovingSurfaces, cells: MeshSeries) -> np.ndarray:
    """[C, 5] of each cell that is whole in the field at half of the times: number of the body that stays nearest; and
    over these times the median distance of centres [m], mean error and standard deviation of the volume, and standard
    deviation of the area [shares]."""
    meshes = [found.bodies(float(t)) for t in cells.times]
    ours = np.array([[centroid(mesh) for mesh in at] for at in meshes])
    sizes = np.array([[mesh.volume for mesh in at] for at in meshes])
    rows = []
    for k in range(_count(cells)):
        own = [scene.meshes[k] for scene in cells.snapshots]
        whole = np.array([is_whole(mesh) for mesh in own])
        if whole.mean() < 0.5:
            continue
        way = np.array([centroid(mesh) for mesh in own])
        away = np.median(np.linalg.norm(ours - way[:, None], axis=-1)[whole], axis=0)
        best = int(away.argmin())
        shares = sizes[whole, best] / np.array([mesh.volume for mesh in own])[whole]
        areas = np.array([meshes[t][best].area / own[t].area for t in np.flatnonzero(whole)])
        rows.append((best, away[best], shares.mean() - 1, shares.std(), areas.std()))
    return np.array(rows)


def options_without(prior: str) -> TrackOptions:
    """What `follow` does unless it is told, but for one of `PRIORS`."""
    usual = TrackOptions(intervals=prior == "none")

    def freed(fit: MotionFit) -> MotionFit:
        return fit if prior == "none" else replace(fit, **{prior: 0.0})

    return replace(usual, stiff=freed(usual.stiff), soft=freed(usual.soft))


def row_of(case: str, data: Path, first: int, times: int, every: int, seed: int, without: str) -> Row:
    """One run of `case`."""
    cells = cells_in_flow(data, first, times, every)
    cells = ellipsoids(cells) if case.endswith(FOREIGN) else cells
    scan = imaged(cells, ANGLES[case], seed)
    began = time.perf_counter(), time.process_time()
    options = replace(options_without(without), body=KnownBody() if case.endswith(BODY) else None)
    options = replace(options, learned=None) if case.endswith(UNLEARNED) else options
    result = follow(scan, MATERIAL, options, seed)
    found = result.bodies
    seconds = time.perf_counter() - began[0], time.process_time() - began[1]
    memory = memory_megabytes("VmHWM")
    scores, kept = volumes(found, cells, scan), identities(found, cells)
    good = kept[kept[:, 1] < FOLLOWED]
    count = len(set(good[:, 0]))  # a body that is nearest to two cells follows one of them
    ratios = over_errors(result, cells, scan) if result.halves else (float("nan"), float("nan"))
    machine = f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared"
    dice, error, overlap = (float(one) for one in scores.mean(0))
    away, *sizes = (float(np.median(np.abs(one))) for one in good[:, 1:].T)
    said = (dice, error, float(scores[:, 0].min()), len(kept), count, found.count, 1e6 * away, *sizes, overlap, *ratios)
    return Row(case, times, first, every, seed, without, *said, *seconds, memory, machine, commit())  # pyright: ignore[reportCallIssue]


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--cases", nargs="+", choices=ANGLES, default=["flow4"])
    parser.add_argument("--times", type=int, default=16)
    parser.add_argument("--first", type=int, default=0, help="snapshot of the first time")
    parser.add_argument("--every", type=int, default=1, help="snapshots from one time to the next")
    parser.add_argument("--ablation", nargs="*", choices=PRIORS, help="priors to leave out, one at a time")
    parser.add_argument("--seed", type=int, default=1, help="of the photons and of the fit")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    chosen = ["none"] if asked.ablation is None else asked.ablation or PRIORS
    for case, without in product(asked.cases, chosen):
        row = row_of(case, asked.data, asked.first, asked.times, asked.every, asked.seed, without)
        shown(row)
        if asked.write:
            replaced(PAGE if asked.ablation is None else ABLATION, row, key=6, digits=5)


if __name__ == "__main__":
    main()
