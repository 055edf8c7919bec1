"""How well `calibrate` finds beams by a known phantom and by beads: docs/data/calibration.csv.

    python benchmarks/calibration.py [--cases NAME …]

Frames are simulated with errors of each view that are known, by rays through closed meshes (`projectors.mesh`) on a
raster several times finer than the detector's; the calibration integrates surfaces over pixels, and shares none of it.
Beads are finer polyhedra than those of the fit. Errors are those after the best motion of the whole body.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rows import merge
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.align import calibrate
from holosplat.align.derivatives import changes, moved_onto
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Views, rotation_tilted
from holosplat.specimens.red_cells import icosphere
from holosplat.version import source_commit

TABLE = Path(__file__).resolve().parents[1] / "docs/data/calibration.csv"
PIXEL, MATERIAL = 1e-6, hs.DeltaBeta(5e-7, 5e-10)
ANGLES, TILTS = [0, 25, 60, 85, 110, 145], [0, 8, -5, 3, 10, -12]
FIELDS = ("case", "views", "seed", "photons", "moment", "shift_px", "across_deg", "roll_deg", "distance", "seconds")
FIELDS += ("machine", "commit")
ARMS = ((0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 2), (0, 0, 3), (2, 1, 0))
"""Cells of the bracket: three arms of different lengths, one of them bent."""


@dataclass(frozen=True)
class Experiment:
    """body: "bracket" or the number of beads; views: how many of the six; seed: of the errors; photons: a pixel, None
    without noise."""

    body: str | int
    views: int = 4
    seed: int = 3
    photons: float | None = None


CASES = {
    "bracket, 4 views": Experiment("bracket"),
    "bracket, 6 views, other errors": Experiment("bracket", 6, 4),
    "bracket, 2 views": Experiment("bracket", 2),
    "bracket, 4 views, 2000 photons": Experiment("bracket", photons=2000.0),
    "6 beads, 4 views": Experiment(6),
    "6 beads, 6 views, other errors": Experiment(6, 6, 4),
    "6 beads, 4 views, 2000 photons": Experiment(6, photons=2000.0),
    "3 beads, 4 views": Experiment(3),
}


def bracket(edge: float) -> hs.mesh.TriangleMesh:
    """The surface of cubes of `edge` [m] in the cells of `ARMS`: two triangles for each outer face."""
    corners, faces = list[list[float]](), list[tuple[int, int, int]]()
    for cell in ARMS:
        for axis in range(3):
            for side in (0, 1):
                beside = tuple(n + (2 * side - 1) * (k == axis) for k, n in enumerate(cell))
                if beside in ARMS:
                    continue
                u, v = ((axis + 1) % 3, (axis + 2) % 3) if side else ((axis + 2) % 3, (axis + 1) % 3)
                first = len(corners)
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = [edge * n for n in cell]
                    corner[axis] += edge * side
                    corner[u] += edge * a
                    corner[v] += edge * b
                    corners.append(corner)
                faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return hs.mesh.TriangleMesh(np.array(corners), np.array(faces), "bracket").merged()


def beads(count: int, radius: float) -> hs.MeshScene:
    """Balls of `radius` [pixels] at random, apart from each other."""
    rng, places = np.random.default_rng(0), list[np.ndarray]()
    vertices, faces = icosphere(4)
    while len(places) < count:
        place = rng.uniform(-17, 17, 3)
        if all(np.linalg.norm(place - other) > 2.2 * radius for other in places):
            places.append(place)
    meshes = [hs.mesh.TriangleMesh(PIXEL * (radius * vertices + place), faces) for place in places]
    return hs.MeshScene.of_one_material(meshes, MATERIAL)


def rms_errors(found: hs.Exposures, true: hs.Exposures) -> dict[str, str]:
    """Rms errors: shifts [pixels], turns across the beam and roll [degrees], share of the distance."""
    away = changes(replace(found, views=moved_onto(found.views, true.views)), true)
    places = {"shift_px": [0, 1], "across_deg": [2, 3], "roll_deg": [4], "distance": [5]}
    return {name: f"{np.sqrt(np.square(away[:, at]).mean()):.5f}" for name, at in places.items()}


def rows_of(name: str, experiment: Experiment, commit: str) -> list[dict[str, str]]:
    """Errors of the plan and of what was found."""
    count = experiment.views
    views = Views.from_rotations(rotation_tilted(ANGLES[:count], TILTS[:count]), (64, 61), PIXEL)
    planned = hs.Exposures.of(views, 20.0, 0.05, 0.3)
    true = Misalignment(1.0, 0.6, 0.02, experiment.seed).true_exposures(planned)
    if isinstance(experiment.body, int):
        scene, body = beads(experiment.body, 3.5), 3.5 * PIXEL
    else:
        body = bracket(9 * PIXEL)
        turn = Rotation.from_rotvec([0.7, -0.4, 1.9]).as_matrix()
        there = body.transformed(turn, -turn @ body.vertices.mean(0))
        scene = hs.MeshScene.of_one_material([there], MATERIAL)
    frames = hs.simulate(scene, true, seed=0, is_test=np.zeros(count, dtype=bool)).frames
    if experiment.photons is not None:
        frames = np.random.default_rng(0).poisson(frames * experiment.photons) / experiment.photons
    scan = hs.Scan(frames.astype(np.float32), planned, np.zeros(count, dtype=bool))
    began = time.process_time()
    found = calibrate(scan, hs.MaterialPrior.known(MATERIAL), body)
    seconds = time.process_time() - began
    print(name, *found.lines(), sep="\n", flush=True)
    said = {"case": name, "views": str(count), "seed": str(experiment.seed), "seconds": f"{seconds:.1f}"}
    said |= {"photons": f"{experiment.photons or 0:g}", "machine": f"{platform.machine()}, one core", "commit": commit}
    moments = {"planned": planned, "calibrated": found.exposures}
    return [said | {"moment": moment} | rms_errors(where, true) for moment, where in moments.items()]


def main() -> None:
    """Run cases; rows of others stay."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    wanted, commit = parser.parse_args(), source_commit()
    for name in wanted.cases:
        merge(rows_of(name, CASES[name], commit), TABLE, "case", columns=FIELDS)


if __name__ == "__main__":
    main()
