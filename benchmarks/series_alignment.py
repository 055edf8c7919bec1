"""How well `align` finds the beams of a series, and what that is worth: rows "series …" of docs/data/alignment.csv.

    python benchmarks/series_alignment.py [--cases NAME …] [--times 3 8 13] [--moments planned aligned true]

Red cells flow and turn in three or two beams (`simulate --geometry xmpi_3beam`, `xmpi_2beam`), whose geometry is wrong
by errors that are known and the same at all 16 times. Volumes of some of the times are reconstructed in the planned,
the found and the true exposures, each moved as a whole as near to the true ones as can be, and compared with the truth.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, replace

import numpy as np
from alignment import FIELDS, TABLE, Row, rms_errors
from rows import merge
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.align import Drift, PoseOptions, align_views
from holosplat.align.derivatives import moved_onto
from holosplat.beamline.misalignment import GEOMETRIES, Directions, Geometry, Misalignment
from holosplat.mesh import TriangleMesh
from holosplat.metrics import volume_scores
from holosplat.specimens.scene import MeshSeries
from holosplat.version import source_commit

TIMES, SECONDS = 16, 1e-3
SHAPE, PIXEL = (64, 72), 0.5e-6
BOX, CELLS, DIAMETER = (17e-6, 25e-6, 17e-6), 7, 8e-6
TURN = 1.5
"""By how much each cell turns over the series [rad], about an axis of its own."""
SLOWER = (0.6, 0.3)
"""By which part cells at the box's sides (y, z) are slower than those in the middle."""
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)


@dataclass(frozen=True)
class Experiment:
    """geometry: which beams; errors: theirs; photons: a pixel, None for no noise; travel: of the fastest cells [m], of
    which more than 14 µm pass the edges of the field; drift: of shifts in the errors [pixels]; volumes: whether they
    are scored."""

    geometry: Geometry
    errors: Misalignment
    photons: float | None = None
    travel: float = 14e-6
    drift: float = 0.0
    volumes: bool = False


def errors(seed: int) -> Misalignment:
    """1 pixel and 0.6°."""
    return Misalignment(1.0, 0.6, 0.0, seed)


CASES = {
    "series, 3 beams": Experiment("xmpi_3beam", errors(7), volumes=True),
    "series, 3 beams, other errors": Experiment("xmpi_3beam", errors(8), volumes=True),
    "series, 3 beams, third errors": Experiment("xmpi_3beam", errors(9), volumes=True),
    "series, 3 beams, fourth errors": Experiment("xmpi_3beam", errors(10), volumes=True),
    "series, 3 beams, 2000 photons": Experiment("xmpi_3beam", errors(7), 2000.0),
    "series, 3 beams, 2000 photons, other errors": Experiment("xmpi_3beam", errors(8), 2000.0),
    "series, 3 beams, cells pass the edges": Experiment("xmpi_3beam", errors(7), travel=36e-6),
    "series, 3 beams, drift of 1 px": Experiment("xmpi_3beam", errors(7), drift=1.0),
    "series, 3 beams, perfect": Experiment("xmpi_3beam", Misalignment()),
    "series, 2 beams": Experiment("xmpi_2beam", errors(7)),
    "series, 2 beams, other errors": Experiment("xmpi_2beam", errors(8)),
}


def flowing_cells(seed: int, travel: float) -> MeshSeries:
    """Cells that are carried along x, faster in the middle, and turn."""
    cells = hs.specimens.random_cells(CELLS, BOX, seed, DIAMETER)
    axes = np.random.default_rng([seed, 5]).normal(size=(CELLS, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    snapshots, when = [], np.linspace(-0.5, 0.5, TIMES)
    for t in when:
        moved = []
        for cell, axis in zip(cells, axes):
            middle = cell.vertices.mean(0)
            speed = 1 - sum(part * (middle[k] / (0.5 * BOX[k])) ** 2 for k, part in zip((1, 2), SLOWER))
            turned = (cell.vertices - middle) @ Rotation.from_rotvec(axis * TURN * t).as_matrix().T + middle
            moved.append(TriangleMesh(turned + np.array([travel * t * speed, 0, 0]), cell.faces, cell.name))
        snapshots.append(hs.MeshScene.of_one_material(moved, MATERIAL))
    return MeshSeries(tuple(snapshots), (when + 0.5) * SECONDS)


def measured(experiment: Experiment) -> tuple[MeshSeries, hs.Scan, hs.Exposures]:
    """The cells, the scan with the planned exposures, and the true ones."""
    views = Directions(geometry=experiment.geometry).on(SHAPE, PIXEL)
    planned = hs.Exposures.of(views, 20.0, 0.05, 0.5)
    cells = flowing_cells(experiment.errors.seed, experiment.travel)
    true = experiment.errors.true_exposures(planned).repeated(cells.times)
    way = np.random.default_rng([experiment.errors.seed, 6]).normal(size=(len(planned), 2))
    when = true.time / SECONDS - 0.5
    drifting = experiment.drift * PIXEL * when[:, None] * np.tile(way, (TIMES, 1))
    true = replace(true, views=replace(true.views, shifts=true.views.shifts + drifting))
    none = np.zeros(len(true), dtype=bool)
    scan = hs.simulate(cells, true, photons_per_pixel=experiment.photons, is_test=none)
    return cells, hs.Scan(scan.frames, planned.repeated(cells.times), none), true


def rows_of(name: str, experiment: Experiment, times: list[int], moments: list[str], commit: str) -> list[Row]:
    """Errors of the beams, before and after; scores of volumes."""
    cells, scan, true = measured(experiment)
    count, prior = len(GEOMETRIES[experiment.geometry]), hs.MaterialPrior.known(MATERIAL)
    began = time.perf_counter()
    found = align_views(scan, prior, PoseOptions(drift=Drift(shift=2 * experiment.drift)))
    seconds = time.perf_counter() - began
    print(*found.lines(), sep="\n", flush=True)
    placed = {"planned": scan.exposures, "aligned": found.exposures, "true": true}
    said: Row = {"case": name, "scene": experiment.geometry, "seed": experiment.errors.seed}
    said |= {"machine": f"{platform.machine()}, one core of two", "commit": commit}
    rows = list[Row]()
    for moment in ("planned", "aligned"):
        per_time = [
            rms_errors(placed[moment][count * t : count * (t + 1)], true[count * t : count * (t + 1)])
            for t in range(TIMES)
        ]
        means = np.sqrt(np.square(per_time).mean(0))
        values = {key: f"{e:.4f}" for key, e in zip(("shift_px", "across_deg", "roll_deg"), means)}
        rows.append(said | {"views": "all", "moment": moment, "seconds": f"{seconds:.0f}"} | values)
        print(rows[-1], flush=True)
    for moment in moments if experiment.volumes else []:
        scores, began = list[tuple[float, float]](), time.perf_counter()
        for t in times:
            frames = np.arange(count * t, count * (t + 1))
            scores.append(scored(cells, scan[frames].as_static(), placed[moment][frames], true[frames], cells.times[t]))
            print(moment, t, scores[-1], flush=True)
        error, dice = np.mean(scores, axis=0)
        seconds = (time.perf_counter() - began) / len(times)
        means = {"error_delta": f"{error:.4f}", "dice": f"{dice:.4f}", "seconds": f"{seconds:.0f}", "method": "auto"}
        rows.append(said | {"views": "volume", "moment": moment} | means)
        print(rows[-1], flush=True)
    return rows


def scored(
    cells: MeshSeries, scan: hs.Scan, exposures: hs.Exposures, true: hs.Exposures, when: float
) -> tuple[float, float]:
    """Relative error of δ and Dice of the volume of one time in some exposures."""
    moved = moved_onto(exposures.views, true.views)
    done = hs.reconstruct(scan.with_views(moved), hs.MaterialPrior.known(MATERIAL))
    truth = cells.at(when).voxelise(hs.Grid.of_views(Directions(geometry="xmpi_3beam").on(SHAPE, PIXEL)))
    scores = volume_scores(done.object.voxelise(truth.grid), truth)
    return scores.relative_error_delta, scores.dice


def main() -> None:
    """Run cases; rows of others stay."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--times", nargs="*", type=int, default=[3, 8, 13])
    parser.add_argument("--moments", nargs="*", default=["planned", "aligned", "true"])
    wanted = parser.parse_args()
    commit = source_commit()  # before the table is written, which is part of the tree
    for name in wanted.cases:
        new = rows_of(name, CASES[name], wanted.times, wanted.moments, commit)
        merge(new, TABLE, "case", columns=FIELDS)


if __name__ == "__main__":
    main()
