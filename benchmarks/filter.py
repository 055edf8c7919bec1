"""What a forecast is worth as the prior of the next window: rows of docs/data/filter.csv.

    python benchmarks/filter.py DATA [--cases flow3 flow2n …] [--first 30] [--before 16] [--times 8] [--write]

DATA, cells, frames and cases are those of motion.py. The first `before` snapshots are tracked and forecast by their
paths; the `times` after them are tracked twice: alone, and with the forecast as prior (`follow(..., after=)`). Both are
judged by the cells themselves. `forecast` is the forecast alone, without the frames of these times.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import replaced, shown

import holosplat as hs
from holosplat.motion.elastic import Rest
from holosplat.motion.forecast import Forecast, History, PathForecast
from holosplat.motion.measures import early_part, half_sets
from holosplat.motion.track import Followed, follow
from holosplat.representations import MovingSurfaces
from holosplat.specimens.scene import MeshSeries
from motion import ANGLES, FOLLOWED, MATERIAL, cells_in_flow, identities, imaged, over_errors, volumes

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "filter.csv"


@dataclass(frozen=True)
class Row:
    """dice, least_dice: of occupancy, mean and worst over times; cells: whole in the field at half of the times;
    followed: of these; bodies: found in all; centre_um: median distance of the centres of followed cells;
    centre_over_error, volume_over_error: root mean squares of errors over standard errors; moved: how far frames moved
    the surfaces, in standard errors of the forecast; cpu_seconds: of the processor, that following took"""

    case: str
    first: int
    before: int
    times: int
    seed: int
    way: str
    dice: float
    least_dice: float
    cells: int
    followed: int
    bodies: int
    centre_um: float
    centre_over_error: float
    volume_over_error: float
    moved: float
    cpu_seconds: float
    machine: str
    commit: str


def forecast_of(scan: hs.Scan, ahead: np.ndarray, seed: int) -> Forecast:
    """What the window `scan` says of the times `ahead` [s], with fits to its halves."""
    found, times = follow(scan, MATERIAL, seed=seed), scan.instants
    bodies, rest = found.bodies, None
    if found.rest is not None and found.body is not None:
        rest = Rest.of(found.rest, found.body.stiffness, bodies.unit_length)
    early, start = early_part(scan, bodies, times)
    halves = half_sets(scan, bodies, seed=seed, rest=rest), half_sets(scan[early], start, seed=seed, rest=rest)
    return replace(PathForecast().fit(History(bodies, times, *halves)).ahead(ahead), rest=rest)


def part(cells: MeshSeries, scan: hs.Scan, kept: slice) -> tuple[MeshSeries, hs.Scan]:
    """The cells and the frames of some times."""
    times = cells.times[kept]
    return MeshSeries(cells.snapshots[kept], times), scan[np.flatnonzero(np.isin(scan.exposures.time, times))]


def rows_of(case: str, data: Path, first: int, before: int, times: int, seed: int) -> Iterator[Row]:
    """The window alone, with the forecast as prior, and the forecast alone."""
    whole = cells_in_flow(data, first, before + times)
    scan = imaged(whole, ANGLES[case], seed)
    cells, later = part(whole, scan, slice(before, None))
    began = time.process_time()
    forecast = forecast_of(part(whole, scan, slice(before))[1], cells.times, seed)
    spent = time.process_time() - began
    expected = forecast.bodies
    expected.lines = 2

    def row(way: str, found: MovingSurfaces, whole: Followed | None, moved: float, seconds: float) -> Row:
        dice, kept = volumes(found, cells, later)[:, 0], identities(found, cells)
        good = kept[kept[:, 1] < FOLLOWED]
        errors = over_errors(whole, cells, later) if whole and whole.halves else (np.nan, np.nan)
        said = float(dice.mean()), float(dice.min()), len(kept), len(set(good[:, 0])), found.count
        machine = f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared"
        centre = 1e6 * float(np.median(good[:, 1]))
        return Row(case, first, before, times, seed, way, *said, centre, *errors, moved, seconds, machine, commit())

    yield row("forecast", expected, None, np.nan, spent)
    for way in ("alone", "after a forecast"):
        began = time.process_time()
        found = follow(later, MATERIAL, seed=seed, after=None if way == "alone" else forecast)
        seconds = time.process_time() - began
        print(found.begun, flush=True)
        yield row(way, found.bodies, found, found.moved, seconds)


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--cases", nargs="+", choices=ANGLES, default=["flow4"])
    parser.add_argument("--first", type=int, default=0, help="snapshot of the first time")
    parser.add_argument("--before", type=int, default=16, help="times of the window before")
    parser.add_argument("--times", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1, help="of the photons and of the fits")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    for case in asked.cases:
        for row in rows_of(case, asked.data, asked.first, asked.before, asked.times, asked.seed):
            shown(row)
            if asked.write:
                replaced(PAGE, row, key=6, digits=5)


if __name__ == "__main__":
    main()
