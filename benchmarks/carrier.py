"""What a velocity field that bodies share is worth to `track`: rows of docs/data/carrier.csv.

    python benchmarks/carrier.py DATA [--cases flow4 …] [--first 20] [--times 16] [--seed 2] [--weights 0 1] [--write]

The cases are those of motion.py. Beside the scores of all cells, those that are seen briefly are looked at: cells whose
middle is in the field at some of the times, and at no more than half of them, which a body follows within 1 µm while
it is there. How far that body's middle is from the cell's then, and at the other times, where nothing but its path
says where it is. With --write, rows stand in the file in place of earlier ones of the same case, times and weight.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import rows
from machine import commit

import motion
from holosplat.bodies.moments import centroid
from holosplat.bodies.rest_shape import KnownBody
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import MovingSurfaces
from holosplat.specimens.mesh_series import MeshSeries

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "carrier.csv"


@dataclass(frozen=True)
class Row:
    """One run. weight: of the field; dice, error: of occupancy, means over times; centre_um: median distance of the
    middles of cells that are followed and whole at half of the times; brief: cells that are seen briefly; kept: of
    these, followed ones; inside_um, beyond_um: medians over these of the root mean square distance of middles."""

    case: str
    times: int
    first: int
    seed: int
    weight: float
    dice: float
    error: float
    least_dice: float
    bodies: int
    centre_um: float
    brief: int
    kept: int
    inside_um: float
    beyond_um: float
    seconds: float
    cpu_seconds: float
    memory_mb: float
    machine: str
    commit: str


def briefly(found: MovingSurfaces, cells: MeshSeries) -> tuple[int, np.ndarray]:
    """How many cells are seen briefly, and [C, 2] of those that are followed: what middles are off by [m], inside the
    field and beyond."""
    ours = np.array([[centroid(mesh) for mesh in found.bodies(float(t))] for t in cells.times])
    count, errors = 0, list[np.ndarray]()
    for k in range(len(cells.snapshots[0].meshes)):
        way = np.array([centroid(scene.meshes[k]) for scene in cells.snapshots])
        inside = np.abs(way[:, 1]) < 0.5 * motion.SHAPE[0] * motion.PIXEL
        if not 0 < inside.mean() <= 0.5:
            continue
        count += 1
        away = np.linalg.norm(ours - way[:, None], axis=-1)
        best = int(np.median(away[inside], axis=0).argmin())
        if np.median(away[inside, best]) < motion.FOLLOWED:
            errors.append(np.array([np.sqrt(np.square(away[one, best]).mean()) for one in (inside, ~inside)]))
    return count, np.array(errors).reshape(-1, 2)


def row_of(case: str, data: Path, first: int, times: int, seed: int, weight: float) -> Row:
    """One run of `case`."""
    cells = motion.cells_in_flow(data, first, times)
    scan, usual = motion.imaged(cells, motion.ANGLES[case], seed), TrackOptions(intervals=False)
    fits = {name: replace(getattr(usual, name), carrier=weight) for name in ("stiff", "soft")}
    options = replace(usual, **fits, body=KnownBody() if case.endswith(motion.BODY) else None)
    with rows.spent() as spent:
        found = follow(scan, motion.MATERIAL, options, seed).bodies
    dice, error, _ = (scores := motion.volumes(found, cells, scan)).mean(0)
    kept = motion.identities(found, cells)
    centre = float(np.median(kept[kept[:, 1] < motion.FOLLOWED][:, 1]))
    brief, errors = briefly(found, cells)
    inside, beyond = (1e6 * float(np.median(one)) for one in errors.T) if len(errors) else (np.nan, np.nan)
    told = (float(dice), float(error), float(scores[:, 0].min()), found.count, 1e6 * centre, brief, len(errors))
    return Row(case, times, first, seed, weight, *told, inside, beyond, *spent.told(), rows.machine(), commit())


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--cases", nargs="+", choices=motion.ANGLES, default=["flow4", "flow3", "flow2-body"])
    parser.add_argument("--times", type=int, default=16)
    parser.add_argument("--first", type=int, default=20, help="snapshot of the first time")
    parser.add_argument("--seed", type=int, default=2, help="of the photons and of the fit")
    parser.add_argument("--weights", nargs="+", type=float, default=[0.0, 1.0], help="of the field")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    for case, weight in product(asked.cases, asked.weights):
        row = row_of(case, asked.data, asked.first, asked.times, asked.seed, weight)
        rows.shown(row)
        if asked.write:
            rows.replaced(PAGE, row, key=5)


if __name__ == "__main__":
    main()
