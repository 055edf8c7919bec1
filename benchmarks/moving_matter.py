"""How well matter in motion that is no body is reconstructed: rows of docs/data/moving_matter.csv.

    python benchmarks/moving_matter.py [--cases stir4 foam4 burst4 fade4] [--times 8] [--write]

Four views evenly over 180°, 64 × 64 pixels of 0.5 µm, 20 keV, 10 cm, known material (δ = 6e-7, δ/β = 1000).
stir4: a stirred soft blob whose middle turns by 60°, 1000 photons a pixel. foam4: a collapsing foam that loses half of
its gas, likewise. burst4: the blob as it turns by 6°, at 16 times of 200 photons, beside one time of 3200 photons.
fade4: the stirred blob as it loses half of its δ, with and without `FlowOptions.fading`.
Errors of δ are those of the whole volume at every time (‖δ - δ₀‖ / ‖δ₀‖), their mean and the largest. Opponents: each
time by itself, by the method of continuous matter, and the mean of all times. The simulation moves matter by maps in
closed form, and shares no numerics with the fit. With --write, rows stand in the file in place of earlier ones of the
same case, method, times and seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rows
from machine import commit

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import SmoothVolume
from holosplat.motion.flow_reconstruction import FlowOptions, merged
from holosplat.scan import Exposures, Scan
from holosplat.workflows.track import reconstruct_moving
from holosplat_bench.specimens.carried import CarriedScene, Fades, collapsing_foam, stirred_blob

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "moving_matter.csv"
SIDE, PIXEL, VIEWS = 64, 0.5e-6, 4
SIZE = 0.85 * SIDE * PIXEL
MATERIAL = DeltaBeta(6e-7, 6e-10)
PRIOR = MaterialPrior.known(MATERIAL)
SCENES: dict[str, Callable[[int], CarriedScene]] = {
    "stir4": lambda seed: stirred_blob(SIZE, MATERIAL, seed, turn=np.radians(60)),
    "foam4": lambda seed: collapsing_foam(SIZE, MATERIAL, seed),
    "burst4": lambda seed: stirred_blob(SIZE, MATERIAL, seed, turn=np.radians(6)),
    "fade4": lambda seed: replace(stirred_blob(SIZE, MATERIAL, seed, turn=np.radians(60)), fades=Fades(0.5)),
}
FADING = 0.3
"""Of fade4: standard deviation expected of the logarithm's change."""
BURST_TIMES, BURST_PHOTONS, PHOTONS = 16, 200.0, 1000.0


@dataclass(frozen=True)
class Row:
    """One method on one series. error, worst: of δ, mean over times and the largest; said: what the method asked of the
    frames and found."""

    case: str
    method: str
    times: int
    seed: int
    error: float
    worst: float
    seconds: float
    cpu_seconds: float
    memory_mb: float
    machine: str
    commit: str
    said: str


def imaged(scene: CarriedScene, times: np.ndarray, photons: float, seed: int) -> Scan:
    """The frames of all views at all times."""
    views = hs.Views.from_angles(np.arange(VIEWS) * 180 / VIEWS, (SIDE, SIDE), PIXEL)
    exposures = Exposures.of(views, 20.0, 0.1).repeated(times)
    return hs.simulate(
        scene, exposures, photons_per_pixel=photons, seed=seed, is_test=np.zeros(len(exposures), dtype=bool)
    )


def errors(
    found: Callable[[float], hs.volume.Object], scene: CarriedScene, scan: Scan, times: np.ndarray
) -> np.ndarray:
    """[T] of δ."""
    grid, wrong = Grid.of_views(scan.views), list[float]()
    for t in times:
        true = scene.at(t).voxelise(grid).delta
        wrong.append(float(np.linalg.norm(found(t).voxelise(grid).delta - true) / np.linalg.norm(true)))
    return np.array(wrong)


def by_itself(scan: Scan) -> hs.volume.Object:
    """Frames of one time, by the method of continuous matter."""
    return hs.reconstruct(scan, PRIOR, SmoothVolume(), matter="continuous").object


class Case:
    """A series, and what methods make of it."""

    def __init__(self, name: str, count: int, seed: int, scene: int) -> None:
        burst = name == "burst4"
        self.name, self.seed = name, seed
        self.times = np.linspace(0.0, 1.0, BURST_TIMES if burst else count)
        self.scene = SCENES[name](scene)
        self.scan = imaged(self.scene, self.times, BURST_PHOTONS if burst else PHOTONS, seed)

    def row(
        self, method: str, make: Callable[[], tuple[Callable[[float], hs.volume.Object], str]], times: np.ndarray
    ) -> Row:
        """What `make` gives, scored at `times`."""
        with rows.spent() as spent:
            found, said = make()
        wrong = errors(found, self.scene, self.scan, times)
        told = (float(wrong.mean()), float(wrong.max()), *spent.told(), rows.machine(), commit(), said)
        return Row(self.name, method, len(self.times), self.seed, *told)

    def together(self, options: FlowOptions) -> tuple[Callable[[float], hs.volume.Object], str]:
        """All times in one: `reconstruct --time-frame all`."""
        found = reconstruct_moving(self.scan, PRIOR, options)
        if found is None:
            still = by_itself(merged(self.scan))
            return (lambda t: still), "nothing moves"
        return found.reconstruction.object.at, "; ".join(found.history)

    def each(self) -> tuple[Callable[[float], hs.volume.Object], str]:
        """Each time by itself."""
        found = {t: by_itself(self.scan.at_instant(k)) for k, t in enumerate(self.times)}
        return found.__getitem__, ""

    def mean(self) -> tuple[Callable[[float], hs.volume.Object], str]:
        """The mean of all times, as if nothing moved."""
        still = by_itself(merged(self.scan))
        return (lambda t: still), ""

    def bright(self) -> tuple[Callable[[float], hs.volume.Object], str]:
        """The time in the middle with the photons of all."""
        middle = self.times[[len(self.times) // 2]]
        found = by_itself(imaged(self.scene, middle, BURST_TIMES * BURST_PHOTONS, self.seed).as_static())
        return (lambda t: found), "3200 photons"


def rows_of(case: Case) -> list[Row]:
    """Those of every method that the case asks for."""
    middle = case.times[[len(case.times) // 2]]
    usual = FlowOptions(sources=case.name == "foam4")
    found = [case.row("all times in one", lambda: case.together(usual), case.times)]
    if case.name == "fade4":
        fading = FlowOptions(fading=FADING)
        found.append(case.row("all times in one, fading", lambda: case.together(fading), case.times))
    if case.name == "burst4":
        return [*found, case.row("one time of all photons", case.bright, middle)]
    return [*found, case.row("each time by itself", case.each, case.times), case.row("mean", case.mean, case.times)]


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--times", type=int, default=8, help="times of all but burst4")
    parser.add_argument("--seed", type=int, default=1, help="of the photons")
    parser.add_argument("--scene", type=int, default=5, help="seed of the specimen")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    for name in asked.cases:
        for row in rows_of(Case(name, asked.times, asked.seed, asked.scene)):
            rows.shown(row)
            if asked.write:
                rows.replaced(PAGE, row, key=4)


if __name__ == "__main__":
    main()
