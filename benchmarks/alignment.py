"""How well `align` finds the poses of views that are not where they are said to be: docs/data/alignment.csv.

    python benchmarks/alignment.py [--cases NAME …]

Scenes of the benchmark (sharp cells) are simulated with errors of each view that are known, and aligned; errors are
those after the best motion of the whole object.
"""

from __future__ import annotations

import argparse
import csv
import platform
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.align import PoseOptions, Uncertain, align_views
from holosplat.align.gauge import moved_onto
from holosplat.beamline.misalignment import Misalignment
from holosplat.bench.case import load_case
from holosplat.bench.record import source_commit

USUAL = Uncertain()
TABLE = Path(__file__).resolve().parents[1] / "docs/data/alignment.csv"
FIELDS: tuple[str, ...] = (
    "case",
    "scene",
    "seed",
    "views",
    "moment",
    "shift_px",
    "across_deg",
    "roll_deg",
    "seconds",
    "machine",
    "commit",
)


@dataclass(frozen=True)
class Experiment:
    """A scene, the errors of its views, and what `align` is told of these. photons: a pixel, None for no noise."""

    scene: str
    errors: Misalignment
    photons: float | None = None
    uncertain: Uncertain = USUAL


CASES = {
    "1 px, 0.6°": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 0)),
    "1 px, 0.6°, other errors": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 1)),
    "1 px, 0.6°, 4 views": Experiment("main4", Misalignment(1.0, 0.6, 0.02, 0)),
    "5 px, 1°, 2000 photons": Experiment("main12", Misalignment(5.0, 1.0, 0.05, 1), 2000.0, Uncertain(shift=5.0)),
    "perfect": Experiment("main12", Misalignment()),
}


def rms_errors(found: hs.Exposures, true: hs.Exposures) -> tuple[float, float, float]:
    """Rms errors: shifts [pixels], turns across the beam and roll [degrees]."""
    moved, pixel = moved_onto(found.views, true.views), true.views.pixel_size
    turns = np.einsum("vij,vkj->vik", moved.rotations, true.views.rotations)
    degrees = Rotation.from_matrix(turns).as_rotvec(degrees=True)
    parts = ((moved.shifts - true.views.shifts) / pixel, degrees[:, :2], degrees[:, 2])
    shift, across, roll = (float(np.sqrt(np.square(part).mean())) for part in parts)
    return shift, across, roll


def rows_of(name: str, experiment: Experiment) -> list[dict[str, object]]:
    """Errors of training and of held-out views, before and after."""
    case = load_case(experiment.scene, 0)
    true = experiment.errors.true_exposures(case.exposures)
    scan = hs.simulate(case.scene, true, seed=0, is_test=case.is_test)
    frames = scan.frames
    if experiment.photons is not None:
        frames = np.random.default_rng(0).poisson(frames * experiment.photons) / experiment.photons
    scan = hs.Scan(frames.astype(np.float32), case.exposures, case.is_test)
    began = time.perf_counter()
    found = align_views(scan, case.prior, PoseOptions(experiment.uncertain))
    seconds = time.perf_counter() - began
    rows: list[dict[str, object]] = []
    common = (f"{platform.machine()}, one core of two", source_commit())
    for moment, exposures in (("planned", case.exposures), ("aligned", found.exposures)):
        for views, index in (("training", ~case.is_test), ("all", np.ones(len(scan), dtype=bool))):
            errors = rms_errors(exposures[np.flatnonzero(index)], true[np.flatnonzero(index)])
            said = (name, experiment.scene, experiment.errors.seed, views, moment)
            values = (*said, *(f"{error:.4f}" for error in errors), f"{seconds:.0f}", *common)
            rows.append({str(field): value for field, value in zip(FIELDS, values, strict=True)})
            print(*values, flush=True)
    print(*found.words, sep="\n", flush=True)
    return rows


def main() -> None:
    """Run cases; rows of others stay."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    wanted = parser.parse_args().cases
    for name in wanted:
        new = rows_of(name, CASES[name])
        old = []
        if TABLE.is_file():
            with TABLE.open(newline="", encoding="utf-8") as file:
                old = [row for row in csv.DictReader(file) if row["case"] != name]
        with TABLE.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
            writer.writeheader()
            writer.writerows([*old, *new])


if __name__ == "__main__":
    main()
