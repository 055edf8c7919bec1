"""Matter that changes: series of `simulate --specimen`, time by time; rows of docs/data/changing.csv.

    python benchmarks/changing.py --seeds 101                       # all series: three hours on one core
    python benchmarks/changing.py --series merging-drops --pixels 48 --seeds 1 --folder runs
    python benchmarks/changing.py --summary                         # the worst time of each series that is there

Each series is drawn with its usual materials and parameters, on pixels of 1 µm, at 20 keV and 0.1 m, 3000 photons a
pixel, frames without blur of motion. It is what `reconstruct --motion each` makes of it, told the material (of a shock:
the ratio δ/β of its medium), and judged by the true volume at each time. Events are those of events.csv, beside those
of the true volumes by the same rules; radii of a front those of fronts.csv, beside the generator's.

Seeds below 100 are for development, those from 101 on for reporting. Series that are there are not made again; with
--folder, those that were begun go on.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from matter_scenes import DISTANCE, ENERGY, PIXEL, judged, substances_of
from rows import machine, read, replaced, shown

import holosplat as hs
from holosplat.geometry import Grid, Views
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object
from holosplat.io.reading import Reading
from holosplat.matter import MaterialPrior, Matter
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures
from holosplat.series.collect import collect
from holosplat.series.events import History, Parts
from holosplat.series.folder import SeriesFolder, line_of, read_row
from holosplat.series.plan import Cut, Settings, plan_series
from holosplat.series.run import run_left
from holosplat.specimens import ChangingScene
from holosplat.specimens.drawn import Drawn, Substances
from holosplat.volume import Volume
from holosplat_bench.specimens.gas_waves import ExpandingShock
from holosplat_bench.specimens.matter import CHANGING, Changing

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "changing.csv"
PHOTONS = 3000.0
EVEN4, EVEN8 = (0.0, 45.0, 90.0, 135.0), tuple(22.5 * k for k in range(8))
SERIES: dict[str, tuple[str, int, tuple[float, ...]]] = {
    "merging-drops": ("merging-drops", 10, EVEN4),
    "collapse": ("collapse", 12, EVEN4),
    "expanding-shock": ("expanding-shock", 8, EVEN4),
    "expanding-shock, 2 views": ("expanding-shock", 8, (0.0, 90.0)),
    "expanding-shock, 1 view": ("expanding-shock", 8, (0.0,)),
    "crushed-lattice": ("crushed-lattice", 6, EVEN8),
    "merging-drops, 3 beams": ("merging-drops", 10, (0.0, 30.0, 48.0)),
    "pinching-jet": ("pinching-jet", 10, EVEN4),
}
"""Kind, times, and angles of the views [°]."""


@dataclass(frozen=True)
class Row:
    """One time. use: development or reporting; share: of the course; error, dice, total, holes: as of
    matter_scenes.csv; true_events, events: since the time before, of the true volumes and as events.csv has them;
    true_radius, radius: of the front [pixels]; begun, verdict: as series.csv has them; seconds: of this time."""

    series: str
    pixels: int
    seed: int
    number: int
    use: str
    share: float
    error: float
    dice: float
    total: float
    holes: float | str
    true_events: str
    events: str
    true_radius: float | str
    radius: float | str
    begun: str
    result: str
    verdict: str
    seconds: float
    specimen: str
    machine: str
    commit: str


@dataclass(frozen=True)
class Truth:
    """The course of a series. times: [T] shares of it, which are the times of the frames [s], too."""

    kind: Changing
    substances: Substances
    drawn: Drawn
    exposures: Exposures
    times: np.ndarray

    @classmethod
    def of(cls, name: str, pixels: int, seed: int) -> Truth:
        """What `seed` gives."""
        called, count, angles = SERIES[name]
        kind = CHANGING[called](CHANGING[called].extent * pixels * PIXEL)
        substances, times = substances_of(kind), np.linspace(0.0, 1.0, count)
        views = Views.from_angles(list(angles), (pixels, pixels), PIXEL)
        exposures = Exposures.of(views, energy_kev=ENERGY, distance=DISTANCE).repeated(times)
        return cls(kind, substances, kind.drawn(substances, seed), exposures, times)

    @property
    def prior(self) -> MaterialPrior:
        """What a run is told: the material, or of a front in a medium the medium's δ/β."""
        if isinstance(self.kind, ExpandingShock):
            return MaterialPrior.of_ratio(self.substances.medium.ratio)
        return MaterialPrior.known(self.substances.contrast)

    def at(self, share: float) -> Drawn:
        """The scene and its parts at one time."""
        scenes = [self.drawn.scene, *self.drawn.regions.values()]
        scene, *parts = (one.at(share) if isinstance(one, ChangingScene) else one for one in scenes)
        return Drawn(scene, self.drawn.text, dict(zip(self.drawn.regions, parts)))

    def events(self, volumes: list[Volume], grid: Grid) -> list[str]:
        """Those since the time before, of each time; none of continuous matter."""
        if isinstance(self.kind, ExpandingShock):
            return [""] * len(volumes)
        matter = self.substances.contrast
        shares = [torch.from_numpy(np.asarray(one.delta / matter.delta, np.float32))[None] for one in volumes]
        history = History.of([Parts.of(VoxelGrid(one, grid, Matter.one(*matter)), grid) for one in shares])
        told = [(event.last, f"{event.kind} of {event.of}") for event in history.events]
        return [joined(told, k) for k in range(len(volumes))]


def joined(events: list[tuple[int, str]], number: int) -> str:
    """The events before one time."""
    return "; ".join(sorted(text for last, text in events if last == number))


def made(truth: Truth, name: str, pixels: int, seed: int, out: Path) -> list[Row]:
    """The series that `reconstruct --motion each` makes in the folder `out`, judged."""
    shock, path, folder = isinstance(truth.kind, ExpandingShock), out / "scan.nxs", SeriesFolder(out / "series")
    if not folder.path.exists():
        out.mkdir(parents=True, exist_ok=True)
        is_test = np.zeros(len(truth.exposures), dtype=bool)
        scan = hs.simulate(truth.drawn.scene, truth.exposures, photons_per_pixel=PHOTONS, seed=seed, is_test=is_test)
        write_scan(path, scan)
        cut = Cut(window=len(truth.times))
        folder.create(plan_series([path], Settings(), lambda energy_kev: truth.prior, Reading(), cut))
    run_left(folder, retry=True, on_row=lambda row: print(f"{name}: {line_of(row)}", flush=True))
    collect(folder, fronts=shock)
    found_events = [(int(e["last"]), f"{e['event']} of {e['of']}") for e in read(folder.events)]
    radii = {int(one["number"]): float(one["radius_m"]) / PIXEL for one in read(folder.fronts)} if shock else {}
    grid = Grid.of_views(truth.exposures.views[: len(SERIES[name][2])])
    volumes = [truth.at(share).scene.voxelise(grid) for share in truth.times]
    found_rows = list[Row]()
    for k, (share, true_events) in enumerate(zip(truth.times, truth.events(volumes, grid))):
        row = read_row(folder.row(0, k))
        if not row.done:
            raise SystemExit(f"{name}, time {k}: {row.reason}")
        found = read_object(folder.run(0, k) / "object.h5").voxelise(grid)
        error, dice, total, holes = judged(found, truth.at(share), grid)
        true_radius = truth.kind.radius(share) / PIXEL if isinstance(truth.kind, ExpandingShock) else ""
        found_rows.append(
            Row(
                *(name, pixels, seed, k, "reporting" if seed > 100 else "development", float(share)),
                *(error, dice, total, holes, true_events, "" if shock else joined(found_events, k)),
                *(true_radius, radii.get(k, ""), row.begun, row.kind),
                *("" if row.good is None else "good" if row.good else "not good", row.seconds),
                *(truth.drawn.text, machine(), commit()),
            )
        )
    return found_rows


def summary(path: Path) -> list[str]:
    """The worst time of each series."""
    every, lines = read(path), list[str]()
    for key in sorted({(one["series"], one["pixels"], one["seed"]) for one in every}):
        own = [one for one in every if (one["series"], one["pixels"], one["seed"]) == key]
        numbers = {name: [float(one[name]) for one in own if one[name]] for name in ("error", "dice", "total", "holes")}
        away = [abs(float(one["radius"]) - float(one["true_radius"])) for one in own if one["radius"]]
        off = max(numbers["total"], key=lambda total: abs(total - 1))
        told = [f"error {max(numbers['error']):.3f}", f"Dice {min(numbers['dice']):.3f}", f"total {off:.3f}"]
        told += [f"holes {min(numbers['holes']):.3f}"] if numbers["holes"] else []
        told += [f"radius within {max(away):.2f}"] if away else []
        told += [f"{sum(one['verdict'] == 'good' for one in own)} of {len(own)} good"]
        told += [f"{sum(float(one['seconds']) for one in own):.0f} s"]
        lines.append(f"{', '.join(key)}: " + ", ".join(told))
    return lines


def main() -> None:
    """Make the series that are not there yet, each written when it is whole, or print what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--series", nargs="+", choices=SERIES, default=list(SERIES))
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--folder", type=Path, help="where runs are kept (default: nowhere)")
    parser.add_argument("--summary", action="store_true", help="print the worst times, and make none")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for seed in options.seeds if not options.summary else ():
        for name in options.series:
            key = [name, str(options.pixels), str(seed)]
            if key in [list(one.values())[:3] for one in read(options.out)]:
                continue
            with tempfile.TemporaryDirectory() as temporary:
                out = (options.folder or Path(temporary)) / "-".join(key).replace(", ", "-").replace(" ", "-")
                found = made(Truth.of(name, options.pixels, seed), name, options.pixels, seed, out)
            replaced(options.out, *found, key=4)
            for row in found:
                shown(row)
    if options.summary:
        print(*summary(options.out), sep="\n")


if __name__ == "__main__":
    main()
