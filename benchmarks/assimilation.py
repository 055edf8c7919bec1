"""4D-Var on manufactured holograms: rows of docs/data/assimilation.csv.

    python benchmarks/assimilation.py [--write]

Two red cells in a channel of 22 × 17 µm move for 120 µs by the model itself (peak 0.05 m/s, shear modulus 8 µN/m,
1.2 mPa s); frames of two beams at three times, 41 × 31 pixels of 0.7 µm, 3000 photons a pixel. The model is fitted to
the frames from first states that are off by 0.1 µm; then it goes on for 120 µs, and is compared with the cells. What is
assumed is right, or one number of it is wrong: the prior's cost when it is wrong.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import write
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.assimilate import Assimilation, assimilate
from holosplat.motion.cell_model import CellModel, ChannelFrame
from holosplat.motion.membrane_fit import Unknowns
from holosplat.specimens.red_cells import RedCell, icosphere

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "assimilation.csv"
FRAME = ChannelFrame((22e-6, 17e-6))
PEAK, SHEAR, VISCOSITY = 0.05, 8e-6, 1.2e-3
TIMES = 1e-6 * np.array([0.0, 60.0, 120.0])
LATER = 240e-6
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
COARSE = 3
"""Frequency of the membranes' meshes: 92 nodes."""
OPEN = Assimilation((0.046, 0.056), (2e-6, 20e-6), steps=12, curvature=False)
CASES = {
    "right": (FRAME, VISCOSITY, replace(OPEN, curvature=True)),
    "wrong viscosity, 3.6 mPa s": (FRAME, 3 * VISCOSITY, OPEN),
    "wrong shear modulus, 1 µN/m": (FRAME, VISCOSITY, replace(OPEN, shear=(1e-6, 1e-6))),
    "wrong walls, 33 × 25.5 µm": (ChannelFrame((33e-6, 25.5e-6)), VISCOSITY, OPEN),
}


@dataclass(frozen=True)
class Row:
    """Of one case. peak, shear: as found; told: their standard errors after over those before (empty: not computed);
    state_um: rms distance along normals of the first states, before and after; later_um: of the cells at 240 µs."""

    case: str
    seed: int
    peak_m_s: float
    shear_n_m: float
    peak_told: float | str
    shear_told: float | str
    loss_start: float
    loss_end: float
    before_um: float
    state_um: float
    later_um: float
    cpu_seconds: float
    machine: str
    commit: str


def cells() -> list[TriangleMesh]:
    """Two cells, at different distances from the walls."""
    sphere, faces = icosphere(2)
    found = []
    for turn, place in (((0.5, 0.2, 0.3), (5e-6, -5e-6, -1e-6)), ((1.2, -0.4, 0.1), (-3e-6, 4e-6, 2e-6))):
        rotated = RedCell().surface(sphere) @ Rotation.from_rotvec(turn).as_matrix().T
        found.append(TriangleMesh(rotated + np.array(place), faces))
    return found


def frames_of(ways: list[np.ndarray], faces: np.ndarray, seed: int) -> hs.Scan:
    """Two beams at all times."""
    views = hs.Views.from_angles(np.array([0.0, 90.0]), (41, 31), 0.7e-6)
    exposures, found = hs.Exposures.of(views, 20.0, 0.05).repeated(TIMES), []
    for k in range(len(TIMES)):
        scene = hs.MeshScene.of_one_material([TriangleMesh(way[k], faces) for way in ways], MATERIAL)
        part = exposures[[2 * k, 2 * k + 1]]
        found.append(hs.simulate(scene, part, photons_per_pixel=3000.0, seed=seed + k).frames)
    return hs.Scan(np.concatenate(found), exposures, np.zeros(len(exposures), dtype=bool))


def rows(seed: int) -> Iterator[Row]:
    """All cases."""
    true = cells()
    faces, random = true[0].faces, np.random.default_rng(seed)
    when = np.r_[TIMES, LATER]
    ways = CellModel(FRAME, true, SHEAR, VISCOSITY, COARSE).run(true, when, Unknowns.of(PEAK, SHEAR))
    scan, matter = frames_of(ways, faces, seed), Matter.one(*MATERIAL)
    start = [TriangleMesh(way[0] + 0.1e-6 * random.normal(size=3), faces) for way in ways]

    def off(meshes: list[TriangleMesh], time: int) -> float:
        """µm, rms over cells."""
        away = [normal_distance(mesh, TriangleMesh(way[time], faces)) for mesh, way in zip(meshes, ways)]
        return 1e6 * float(np.sqrt(np.mean(np.square(away))))

    for case, (frame, viscosity, how) in CASES.items():
        began = time.process_time()
        model = CellModel(frame, true, float(np.sqrt(np.prod(how.shear))), viscosity, COARSE)
        found = assimilate(scan, model, start, matter, how)
        later = model.run(found.meshes, np.array([TIMES[0], LATER]), found.unknowns)
        last = off([TriangleMesh(way[-1], faces) for way in later], len(TIMES))
        seconds, machine = (
            time.process_time() - began,
            f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared",
        )
        values = float(found.unknowns.peak), float(found.unknowns.shear)
        told = found.told.get("peak", ""), found.told.get("shear", "")
        states = off(start, 0), off(found.meshes, 0)
        yield Row(case, seed, *values, *told, *found.losses, *states, last, seconds, machine, commit())


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the photons and of the first states")
    parser.add_argument("--write", action="store_true")
    asked, found = parser.parse_args(), []
    for row in rows(asked.seed):
        print(*astuple(row)[:12], sep="; ", flush=True)
        found.append({name: f"{v:.5g}" if isinstance(v, float) else v for name, v in asdict(row).items()})
    if asked.write:
        write(found, PAGE)


if __name__ == "__main__":
    main()
