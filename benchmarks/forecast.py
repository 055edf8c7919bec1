"""How well `forecast` tells cells that flow: rows of docs/data/forecast.csv.

    python benchmarks/forecast.py DATA [--case flow4] [--times 24] [--first 0] [--true] [--write] [--keep FOLDER]
    python benchmarks/forecast.py --case fast --keep FOLDER [--first 0] [--write]

DATA, cells and frames are as for motion.py. The first `times` snapshots from `first` on are tracked; the forecasts of
the next ones are compared with the cells themselves: distances along normals (rms over both surfaces), Dice, and SSIM
of the predicted frames with frames without noise. Judged are the cells that are whole in the field at the last tracked
time and are followed. `splines` are the fitted splines of single vertices as they go on; `wrong …` are dynamics with
numbers that are wrong; `hybrid` is the mean of the network and dynamics. With --keep the tracked bodies are kept in
FOLDER, and taken from there. With --true nothing is tracked: bodies are the cells themselves, on quadratic splines
through their own nodes, so that what is off is the forecasts' alone; their case is called `true`.

The cases of `FLOWS` are cells that `holosplat grow` lets flow otherwise than those that the network learnt from, in
FOLDER; all of them are judged, begun with themselves.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import replaced

import holosplat as hs
from holosplat.beamline.grow import COMPACT, Growth, SeriesFolder, grow, read_compact
from holosplat.bodies.rest_shape import KnownBody, centroid
from holosplat.geometry import Grid
from holosplat.io.objects import read_object, write_object
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.metrics import image_scores, intensity_range, volume_scores
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.cell_model import ChannelFrame
from holosplat.motion.dynamics import DynamicsForecast, HybridForecast
from holosplat.motion.elastic import Rest
from holosplat.motion.forecast import Forecaster, Halves, History, PathForecast, early_count
from holosplat.motion.learned import GraphForecast
from holosplat.motion.measures import half_sets
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import MovingSurfaces
from holosplat.representations.flow import TimeBasis
from holosplat.specimens.membrane.model import Elasticity
from holosplat.specimens.scene import MeshSeries
from holosplat.workflows.evaluate import render_object
from holosplat_bench.opponents.modes import DmdForecast, SindyForecast
from motion import ANGLES, BODY, MATERIAL, PIXEL, SHAPE, cells_in_flow, imaged

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "forecast.csv"
AHEAD = (1, 5, 10, 15, 20, 25)
FRAME = ChannelFrame((32e-6, 24e-6))
"""The channel between the walls of 1 µm; cells_in_flow brings the flow to y and the middle to the origin."""


def ways(frame: ChannelFrame) -> dict[str, Forecaster]:
    """The models by their names."""
    given, graph = DynamicsForecast(frame), GraphForecast()
    alone = replace(given, free=False)
    wide = ChannelFrame((1.5 * frame.across[0], 1.5 * frame.across[1]), frame.axis, frame.centre)
    return {
        "paths": PathForecast(),
        "rigid": PathForecast(rigid=True),
        "dynamics": given,
        "graph": graph,
        "hybrid": HybridForecast((graph, given)),
        "dmd": DmdForecast(),
        "sindy": SindyForecast(),
        "dynamics alone": alone,
        "wrong shear": replace(alone, shear=(50e-6, 50e-6)),
        "wrong viscosity": replace(alone, viscosity=1.2e-2, shear=(2.9e-6, 2.9e-6)),
        "wrong walls": replace(alone, frame=wide),
    }


NAMES = ("splines", *ways(FRAME))
USUAL = Growth(12, (60e-6, 33e-6, 27e-6), warm_up=3e-4, snapshots=49, frequency=4, seed=301, compact=True)
FLOWS = {
    "fast": replace(USUAL, flow=0.12),
    "stiff": replace(USUAL, elasticity=Elasticity(skalak_shear=20e-6)),
    "dense": replace(USUAL, cells=24, box=(50e-6, 26e-6, 24e-6)),
}
"""The network learnt from up to 0.073 m/s, 6.5 µN/m and 5 % of the volume; in the dense one cells are 7 %."""
DICE = ("paths", "hybrid")
PIECES = 3
"""Of the true paths, as many as those of tracks have."""
NEAR = 1.5e-6
"""A cell is followed if a body's centre stays within this distance [m], in the mean over three times."""


@dataclass(frozen=True)
class Row:
    """Of one model and one time ahead. normal_um, worst_um: rms over cells, and of the worst; band_um: the standard
    error that was said; held: share of the cells within 1.645 of it; ssim: of predicted frames; dice: of all matter
    (empty: not asked); cells: judged; found: of the flow; seconds: of the processor, that the forecast took."""

    case: str
    first: int
    times: int
    seed: int
    model: str
    ahead: int
    normal_um: float
    worst_um: float
    band_um: float
    held: float
    ssim: float | str
    dice: float | str
    cells: int
    found: str
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Judge:
    """The cells of an experiment, the numbers of the cells that are judged and of their bodies, and the frames of the
    times ahead without noise."""

    cells: MeshSeries
    pairs: list[tuple[int, int]]
    frames: dict[int, hs.Scan]
    contrast: tuple[float, float]
    last: int

    def scores(self, found: MovingSurfaces, ahead: int, dice: bool) -> tuple[np.ndarray, float, float | str]:
        """Distances [C] [µm], SSIM, Dice."""
        time, scene = float(self.cells.times[self.last + ahead]), self.cells.snapshots[self.last + ahead]
        bodies = found.bodies(time)
        away = np.array([1e6 * normal_distance(bodies[k], scene.meshes[c]) for c, k in self.pairs])
        scan = self.frames[ahead]
        said = render_object(found.at(time), scan.exposures, 2)
        ssim = float(image_scores(said, scan.frames, self.contrast).mean["ssim"])
        grid = Grid.of_views(scan.views)
        part = volume_scores(found.at(time).voxelise(grid), scene.voxelise(grid)).dice if dice else ""
        return away, ssim, part


def followed(found: MovingSurfaces, cells: MeshSeries, last: int) -> list[tuple[int, int]]:
    """Cells that are whole in the field at the time `last`, and the body that follows each."""
    asked, pairs = (0, last // 2, last), []
    ours = np.array([[centroid(mesh) for mesh in found.bodies(float(cells.times[t]))] for t in asked])
    for c, mesh in enumerate(cells.snapshots[last].meshes):
        way = np.array([centroid(cells.snapshots[t].meshes[c]) for t in asked])
        away = np.linalg.norm(ours - way[:, None], axis=-1).mean(0)
        if np.abs(mesh.vertices[:, 1]).max() < 0.5 * SHAPE[0] * PIXEL and away.min() < NEAR:
            pairs.append((c, int(away.argmin())))
    return pairs


def tracked(scan: hs.Scan, seed: int, keep: Path | None, name: str) -> tuple[MovingSurfaces, Halves]:
    """The bodies by all frames and by two halves."""
    files = [keep / f"{name}_{part}.h5" for part in ("whole", "even", "odd")] if keep else []
    if files and all(file.is_file() for file in files):
        whole, *halves = (read_object(file) for file in files)
        return whole, tuple(halves)  # pyright: ignore[reportReturnType]
    body = KnownBody() if BODY in name else None
    found = follow(scan, MATERIAL, TrackOptions(body=body), seed)
    whole, rest = found.bodies, None
    if body and found.rest:
        rest = Rest.of(found.rest, body.stiffness, whole.unit_length)
    halves = half_sets(scan, whole, seed=seed, rest=rest)
    for file, bodies in zip(files, (whole, *halves)):
        write_object(file, bodies)
    return whole, halves


def truly(cells: MeshSeries, times: int) -> MovingSurfaces:
    """The cells themselves on smooth paths at the first `times` times."""
    basis = TimeBasis(float(cells.times[0]), float(cells.times[times - 1]), 2, PIECES)
    nodes = np.array([[mesh.vertices for mesh in scene.meshes] for scene in cells.snapshots[:times]])
    paths = [basis.fitted(cells.times[:times], one) for one in nodes.transpose(1, 0, 2, 3)]
    faces = [mesh.faces for mesh in cells.snapshots[0].meshes]
    return MovingSurfaces.of_bodies(paths, faces, basis, PIXEL, Matter.one(*MATERIAL))


Told = Callable[[MovingSurfaces, int, bool], "tuple[np.ndarray, float | str, float | str]"]
"""Of bodies, a number of times ahead, and whether Dice is asked: distances [C] [µm], SSIM, Dice."""


def rows_by(
    told: Told,
    history: History,
    ahead: np.ndarray,
    frame: ChannelFrame,
    only: Collection[str],
    chosen: list[int],
    key: tuple[str, int, int, int],
) -> Iterator[Row]:
    """A row for each model of `only` and time ahead; chosen: numbers of the bodies that are judged; key: the first
    fields of the rows."""
    for model, way in {"splines": None, **ways(frame)}.items():
        if model not in only:
            continue
        before = time.process_time()
        found = (way or PathForecast()).fit(history).ahead(ahead)
        seconds = time.process_time() - before
        if way is None:
            found = replace(found, bodies=history.bodies, band=np.full_like(found.band, np.nan))
        said = " ".join(f"{key}={value:.4g}" for key, value in found.told.items())
        where = f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared"
        for h, band in zip(AHEAD, 1e6 * found.band[:, chosen]):
            away, ssim, dice = told(found.bodies, h, model in DICE)
            rms, error = (float(np.sqrt((x**2).mean())) for x in (away, band))
            held = float((away < 1.645 * band).mean())
            scores = rms, float(away.max()), error, held, ssim, dice, len(chosen)
            yield Row(*key, model, h, *scores, said, seconds, where, commit())


def foreign(case: str, keep: Path, first: int, times: int, seed: int, only: Collection[str]) -> Iterator[Row]:
    """All models at all times ahead of cells of `FLOWS`, begun with themselves."""
    growth = FLOWS[case]
    _, y, z = growth.box
    if not (keep / case / COMPACT.format(growth.snapshots - 1)).is_file():
        grow(growth, keep / case, resume=(keep / case).is_dir())
    nodes, faces, instants = read_compact(SeriesFolder(keep / case))
    kept, frame = slice(first, first + times), ChannelFrame((y, z), "x", (0.0, 0.5 * y, 0.5 * z))
    basis = TimeBasis(float(instants[kept][0]), float(instants[kept][-1]), 2, PIECES)
    paths = [basis.fitted(instants[kept], one) for one in nodes[kept].transpose(1, 0, 2, 3)]
    bodies = MovingSurfaces.of_bodies(paths, [faces] * len(paths), basis, PIXEL, Matter.one(*MATERIAL))
    last = first + times - 1

    def told(found: MovingSurfaces, ahead: int, dice: bool) -> tuple[np.ndarray, str, str]:
        said = found.bodies(float(instants[last + ahead]))
        true = [TriangleMesh(one, faces) for one in nodes[last + ahead]]
        return np.array([1e6 * normal_distance(a, b) for a, b in zip(said, true)]), "", ""

    history, ahead = History(bodies, instants[kept]), instants[[last + h for h in AHEAD]]
    yield from rows_by(told, history, ahead, frame, only, list(range(len(paths))), (case, first, times, seed))


def rows_of(
    case: str,
    data: Path,
    first: int,
    times: int,
    seed: int,
    keep: Path | None,
    true: bool = False,
    only: Collection[str] = NAMES,
) -> Iterator[Row]:
    """All models at all times ahead, or `only` some; true: begun with the cells themselves."""
    cells = cells_in_flow(data, first, times + max(AHEAD))
    scan = imaged(cells, ANGLES[case], seed)
    kept = scan[np.flatnonzero(scan.exposures.time <= cells.times[times - 1])]
    if true:
        named, bodies, halves, before = "true", truly(cells, times), None, truly(cells, early_count(times))
        early = before, before
    else:
        named, early, (bodies, halves) = case, None, tracked(kept, seed, keep, f"{case}_{first}_{times}_{seed}")
    pairs, last = followed(bodies, cells, times - 1), times - 1
    exposures = hs.Exposures.of(hs.Views.from_angles(np.array(ANGLES[case]), SHAPE, PIXEL), 20.0, 0.1)
    frames = {h: hs.simulate(cells, exposures.repeated(cells.times[[last + h]])) for h in AHEAD}
    judge = Judge(cells, pairs, frames, intensity_range(kept.frames), last)
    ahead = cells.times[[last + h for h in AHEAD]]
    history = History(bodies, cells.times[:times], halves, early)
    yield from rows_by(judge.scores, history, ahead, FRAME, only, [k for _, k in pairs], (named, first, times, seed))


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--case", choices=(*ANGLES, *FLOWS), default="flow4")
    parser.add_argument("--times", type=int, default=24, help="that are tracked")
    parser.add_argument("--first", type=int, default=0, help="snapshot of the first time")
    parser.add_argument("--seed", type=int, default=1, help="of the photons and of the fits")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--true", action="store_true", help="forecasts from the cells themselves")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--keep", type=Path, help="folder of tracked bodies")
    asked = parser.parse_args()
    rows, how = [], (asked.first, asked.times, asked.seed)
    if asked.case in FLOWS:
        found = foreign(asked.case, asked.keep, *how, asked.only)
    else:
        found = rows_of(asked.case, asked.data, *how, asked.keep, asked.true, asked.only)
    for row in found:
        print(*astuple(row)[:15], sep="; ", flush=True)
        rows.append(row)
    if asked.write:
        replaced(PAGE, *rows, key=6, digits=5)


if __name__ == "__main__":
    main()
