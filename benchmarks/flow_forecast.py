"""How far ahead matter in motion is told: rows of docs/data/flow_forecast.csv.

    python benchmarks/flow_forecast.py [--cases stir4 drift4] [--seeds 101]        # 10 minutes a case on one core

Four views evenly over 180° of 64 × 64 pixels of 0.5 µm, 20 keV, 10 cm, known material, 1000 photons a pixel, 12 times
over one second, of which the first 8 are reconstructed. stir4: the stirred soft blob of `moving_matter.py`, whose
middle turns by 60°: its vortices are steady. drift4: such a blob of 0.6 times the size that drifts by 6 µm in any
direction, through fluid at rest. Errors are those of δ of the whole volume at a time ahead, ‖δ - δ₀‖ / ‖δ₀‖.
places: rms distance along an axis, by mass, of Gaussians from where the true motion takes what they stand for, since
the reference time and since the last one; band: the standard error that is stated. `still` is the last volume without
change, `auto` what the last third of the run's times decides. Seeds below 100 are for development. Rows that are there
are not made again.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from machine import commit
from moving_matter import MATERIAL, PRIOR, SIZE, imaged
from rows import machine, read, replaced, shown

from holosplat.geometry import Grid
from holosplat.motion.flow_forecast import gone_on
from holosplat.representations import MovingGaussians
from holosplat.workflows.forecast import ForecastOptions, forecast
from holosplat.workflows.track import reconstruct_moving
from holosplat_bench.specimens.carried import CarriedScene, stirred_blob

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "flow_forecast.csv"
TIMES, KNOWN, PHOTONS, DRIFT = np.linspace(0.0, 1.0, 12), 8, 1000.0, 6e-6


@dataclass(frozen=True)
class Row:
    """error: of δ at so many times `ahead`; places, places_since: rms distance along an axis [µm] from the true ones,
    since the reference time and since the last one; band: [µm]; decided: what auto took; seconds: of the processor."""

    case: str
    seed: int
    way: str
    ahead: int
    error: float
    places: float
    places_since: float
    band: float
    decided: str
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Drift:
    """A uniform translation by `way` [m] a second."""

    way: np.ndarray

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return points - time * self.way[:, None]

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return points + time * self.way[:, None]


def scene(case: str, seed: int) -> CarriedScene:
    """The matter of a case, in motion."""
    if case == "stir4":
        return stirred_blob(SIZE, MATERIAL, seed, turn=np.radians(60))
    way = np.random.default_rng(seed).normal(size=3)
    still = stirred_blob(0.6 * SIZE, MATERIAL, seed)
    return replace(still, motion=Drift(DRIFT * way / np.linalg.norm(way)), reach=still.reach + DRIFT)


def run(case: str, seed: int) -> list[Row]:
    """The first times reconstructed, and all ways ahead."""
    made, last, later = scene(case, seed), float(TIMES[KNOWN - 1]), TIMES[KNOWN:]
    scan = imaged(made, TIMES, PHOTONS, seed)
    first = scan[np.flatnonzero(scan.exposures.time <= last)]
    began = time.process_time()
    found = reconstruct_moving(first, PRIOR, ask=False)
    assert found is not None
    done = found.reconstruction
    matter, seconds = done.object, time.process_time() - began
    assert isinstance(matter, MovingGaussians)
    began = time.process_time()
    said = forecast(done, scan, TIMES[:KNOWN], ForecastOptions(times=len(later), decides=True))
    asked = time.process_time() - began
    grid, truths = Grid.of_views(scan.views), [made.at(float(t)) for t in later]
    truth = [one.voxelise(grid).delta for one in truths]
    cloud, mass = matter.cloud, (matter.cloud.amplitudes[:, 0] * matter.cloud.scales.prod(1)).detach().double().numpy()

    def metres(centres: torch.Tensor) -> np.ndarray:
        return matter.unit_length * centres.detach().double().numpy().T

    def row(way: str, at: MovingGaussians | None, k: int, band: float, decided: str, cpu: float) -> Row:
        now = matter.at(last) if at is None else at.at(float(later[k]))
        wrong = float(np.linalg.norm(now.voxelise(grid).delta - truth[k]) / np.linalg.norm(truth[k]))
        motion, to = made.motion, float(later[k])
        begun = metres(cloud.centres), metres(matter.at(last).centres)
        wanted = (motion.forth(motion.back(p, t), to) for p, t in zip(begun, (matter.flow.reference, last)))
        away = [1e6 * np.sqrt(np.average(((metres(now.centres) - w) ** 2).mean(0), weights=mass)) for w in wanted]
        return Row(case, seed, way, k + 1, wrong, *map(float, away), band, decided, round(cpu, 1), machine(), commit())

    rows = []
    for k in range(len(later)):
        rows.append(row("still", None, k, float("nan"), "", seconds))
        for way in ("steady", "inertia"):
            rows.append(row(way, gone_on(matter, last, later, way), k, float("nan"), "", seconds))
        object_, band = said.forecast.object, 1e6 * float(said.forecast.usual_band()[k])
        assert isinstance(object_, MovingGaussians)
        rows.append(row("auto", object_, k, band, "" if said.decision is None else said.decision.line, asked))
    return rows


def main() -> None:
    """Make the rows that are asked for and not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=("stir4", "drift4"), default=["stir4", "drift4"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for case in options.cases:
        for seed in options.seeds:
            if (case, str(seed)) in {(r["case"], r["seed"]) for r in read(options.out)}:
                continue
            for each in run(case, seed):
                replaced(options.out, each, key=4)
                shown(each)


if __name__ == "__main__":
    main()
