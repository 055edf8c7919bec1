"""How well `align` finds the poses of views that are not where they are said to be: docs/data/alignment.csv.

    python benchmarks/alignment.py [--cases NAME …]
    python benchmarks/alignment.py --cases "volume 12" "volume 4" --moments planned aligned refined true

Scenes of the benchmark (sharp cells) are simulated with errors of each view that are known, and aligned; errors are
those after the best motion of the whole object, magnifications beside their mean. `distance` is the rms relative error
of the distances, `mean_distance` that of their mean. Cases with methods are also reconstructed, and their volumes
compared with the truth: in the planned and found (`aligned`) and true exposures, and with the geometry free in the fit,
too (`refined`, as --refine does).
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
from holosplat.align import PoseOptions, PosePrior, align_views
from holosplat.align.derivatives import moved_onto
from holosplat.beamline.misalignment import Misalignment
from holosplat.methods import Auto, Gaussians, Method
from holosplat.metrics import volume_scores
from holosplat.version import source_commit
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import load_case

USUAL = PosePrior()
MOMENTS = ("planned", "aligned", "refined", "true")
FINE = str(Path(__file__).with_name("alignment_fine.toml"))
"""Red cells whose first fringe is 2.5 pixels wide."""
TABLE = Path(__file__).resolve().parents[1] / "docs/data/alignment.csv"
Row = dict[str, object]
FIELDS: tuple[str, ...] = (
    "case",
    "scene",
    "seed",
    "views",
    "moment",
    "shift_px",
    "across_deg",
    "roll_deg",
    "magnification",
    "seconds",
    "machine",
    "commit",
    "method",
    "error_delta",
    "dice",
    "distance",
    "mean_distance",
    "cpu_seconds",
)


@dataclass(frozen=True)
class Experiment:
    """A scene, the errors of its views, and what `align` is told of these.

    photons: a pixel, None for no noise; held_out: frames that are held out at most; methods: whose volumes are scored.
    The seed of the scene is that of the errors where there are methods.
    """

    scene: str
    errors: Misalignment
    photons: float | None = None
    uncertain: PosePrior = USUAL
    held_out: int = 4
    methods: tuple[str, ...] = ()

    def told(self) -> PosePrior:
        """What `align` is told: distances are as uncertain as they are, and 2 % where all is as planned."""
        return replace(self.uncertain, distance=self.errors.distance or 0.02)

    def scene_seed(self) -> int:
        """Seed of the scene: those of poses alone are of one scene."""
        return self.errors.seed if self.methods else 0


METHODS: dict[str, Method] = {"gaussians": Gaussians(), "auto": Auto()}
BOTH = ("gaussians", "auto")
CASES = {
    "1 px, 0.6°": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 0)),
    "1 px, 0.6°, other errors": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 1)),
    "1 px, 0.6°, 4 views": Experiment("main4", Misalignment(1.0, 0.6, 0.02, 0)),
    "5 px, 1°, 2000 photons": Experiment("main12", Misalignment(5.0, 1.0, 0.05, 1), 2000.0, PosePrior(shift=5.0)),
    "perfect": Experiment("main12", Misalignment()),
    "perfect, 12 views": Experiment("main12", Misalignment(seed=7), methods=("gaussians",)),
    "perfect, 4 views": Experiment("main4", Misalignment(seed=7), held_out=2, methods=("gaussians",)),
    "fine pixels": Experiment(FINE, Misalignment(1.0, 0.6, 0.02, 3)),
    "fine pixels, 2000 photons": Experiment(FINE, Misalignment(1.0, 0.6, 0.02, 3), 2000.0),
    "soft cells": Experiment("soft12", Misalignment(1.0, 0.6, 0.02, 4)),
    "1 px, 0.6°, 1 % magnification": Experiment(
        "main12", Misalignment(1.0, 0.6, 0.0, 0, magnification=0.01), uncertain=PosePrior(magnification=0.01)
    ),
    "1 px, 0.6°, 0.5 % magnification": Experiment(
        "main12", Misalignment(1.0, 0.6, 0.0, 1, magnification=0.005), uncertain=PosePrior(magnification=0.01)
    ),
    "perfect, magnification free": Experiment("main12", Misalignment(), uncertain=PosePrior(magnification=0.01)),
    "volume 12": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 7), methods=BOTH),
    "volume 12, other errors": Experiment("main12", Misalignment(1.0, 0.6, 0.02, 8), methods=("auto",)),
    "volume 4": Experiment("main4", Misalignment(1.0, 0.6, 0.02, 7), held_out=2, methods=BOTH),
    "volume 4, other errors": Experiment("main4", Misalignment(1.0, 0.6, 0.02, 8), held_out=2, methods=BOTH),
}


def rms_errors(found: hs.Exposures, true: hs.Exposures) -> tuple[float, float, float, float]:
    """Rms errors: shifts [pixels], turns across the beam and roll [degrees], and magnification beside its mean."""
    moved, pixel = moved_onto(found.views, true.views), true.views.pixel_sizes[:, None]
    larger = np.log(true.views.pixel_sizes / found.views.pixel_sizes)
    turns = np.einsum("vij,vkj->vik", moved.rotations, true.views.rotations)
    degrees = Rotation.from_matrix(turns).as_rotvec(degrees=True)
    parts = ((moved.shifts - true.views.shifts) / pixel, degrees[:, :2], degrees[:, 2], larger - larger.mean())
    shift, across, roll, magnification = (float(np.sqrt(np.square(part).mean())) for part in parts)
    return shift, across, roll, magnification


def distance_errors(found: hs.Exposures, true: hs.Exposures) -> tuple[float, float]:
    """Rms relative error of the distances, and that of their mean."""
    away = found.distance / true.distance - 1
    return float(np.sqrt(np.square(away).mean())), float(away.mean())


def measured(experiment: Experiment) -> tuple[Case, hs.Scan, hs.Exposures]:
    """The case, its scan with the planned exposures, and the true ones."""
    case = load_case(experiment.scene, experiment.scene_seed())
    true = experiment.errors.true_exposures(case.exposures)
    scan = hs.simulate(case.scene, true, seed=0, is_test=case.is_test)
    frames = scan.frames
    if experiment.photons is not None:
        frames = np.random.default_rng(0).poisson(frames * experiment.photons) / experiment.photons
    chosen = np.sort([*np.flatnonzero(~case.is_test), *np.flatnonzero(case.is_test)[: experiment.held_out]])
    return case, hs.Scan(frames.astype(np.float32), case.exposures, case.is_test)[chosen], true[chosen]


def rows_of(name: str, experiment: Experiment, moments: list[str], commit: str) -> list[Row]:
    """Errors of training and of held-out views, before and after; scores of volumes at `moments`."""
    case, scan, true = measured(experiment)
    began, worked = time.perf_counter(), time.process_time()
    found = align_views(scan, case.prior, PoseOptions(experiment.told()))
    seconds, worked = time.perf_counter() - began, time.process_time() - worked
    print(*found.words, sep="\n", flush=True)
    placed = {"planned": scan.exposures, "aligned": found.exposures, "true": true}
    rows = list[Row]()
    said: Row = {"case": name, "scene": Path(experiment.scene).stem, "seed": experiment.errors.seed}
    said |= {"machine": f"{platform.machine()}, one core of two", "commit": commit}
    spent = {"seconds": f"{seconds:.0f}", "cpu_seconds": f"{worked:.0f}"}
    for moment in ("planned", "aligned"):
        rows += [said | {"moment": moment} | row | spent for row in pose_rows(placed[moment], true, scan.is_test)]
        print(*rows[-2:], sep="\n", flush=True)
    for method in experiment.methods:
        for moment in moments:
            if moment == "refined":
                new = refined_rows(case, scan, true, experiment, method)
            else:
                new = [{"views": "volume"} | volume_row(case, scan, placed[moment], true, method)]
            rows += [said | {"moment": moment} | row for row in new]
            print(*rows[-len(new) :], sep="\n", flush=True)
    return rows


def pose_rows(found: hs.Exposures, true: hs.Exposures, is_test: np.ndarray) -> list[Row]:
    """Errors of the training views, and of all."""
    rows = list[Row]()
    for views, chosen in (("training", np.flatnonzero(~is_test)), ("all", np.arange(len(is_test)))):
        shift, across, roll, magnification = rms_errors(found[chosen], true[chosen])
        away, mean = distance_errors(found[chosen], true[chosen])
        values = {"shift_px": shift, "across_deg": across, "roll_deg": roll, "distance": away, "mean_distance": mean}
        row: Row = {"views": views, "magnification": f"{magnification:.5f}"}
        rows.append(row | {key: f"{value:.4f}" for key, value in values.items()})
    return rows


def volume_row(case: Case, scan: hs.Scan, exposures: hs.Exposures, true: hs.Exposures, method: str) -> Row:
    """Scores of a volume in some exposures, which are first moved, all together, as near to the true ones as can be."""
    moved = replace(exposures, views=moved_onto(exposures.views, true.views))
    began = time.perf_counter()
    done = hs.reconstruct(hs.Scan(scan.frames, moved, scan.is_test), case.prior, METHODS[method])
    seconds = time.perf_counter() - began
    truth = case.truth()
    scores = volume_scores(done.object.voxelise(truth.grid), truth)
    numbers: Row = {"error_delta": f"{scores.relative_error_delta:.4f}", "dice": f"{scores.dice:.4f}"}
    return {"method": f"{method} ({done.object.kind})", "seconds": f"{seconds:.0f}"} | numbers


def refined_rows(case: Case, scan: hs.Scan, true: hs.Exposures, experiment: Experiment, method: str) -> list[Row]:
    """The same with the geometry free in the fit, and the errors of where the frames then are."""
    scan = hs.Scan(scan.frames, together(scan, true), scan.is_test)
    began = time.perf_counter()
    done = hs.reconstruct(scan, case.prior, METHODS[method], refine=PoseOptions(experiment.told()))
    said: Row = {"method": f"{method} ({done.object.kind})", "seconds": f"{time.perf_counter() - began:.0f}"}
    rows = [said | row for row in pose_rows(done.placed(scan).exposures, true, scan.is_test)]
    truth = case.truth()
    scores = volume_scores(done.object.voxelise(truth.grid), truth)
    numbers: Row = {"error_delta": f"{scores.relative_error_delta:.4f}", "dice": f"{scores.dice:.4f}"}
    return [*rows, said | {"views": "volume"} | numbers]


def together(scan: hs.Scan, true: hs.Exposures) -> hs.Exposures:
    """The planned exposures, moved as a whole so that the mean turn and shift of the training views are the true ones:
    those of what is found are then the true ones, too."""
    views, train = moved_onto(scan.views, true.views), np.flatnonzero(~scan.is_test)
    rotations, shifts = views.rotations.copy(), views.shifts.copy()
    trained = moved_onto(scan.views[train], true.views[train])
    rotations[train], shifts[train] = trained.rotations, trained.shifts
    return replace(scan.exposures, views=replace(views, rotations=rotations, shifts=shifts))


def main() -> None:
    """Run cases; rows of others stay."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--moments", nargs="*", default=["aligned"], choices=MOMENTS)
    wanted = parser.parse_args()
    commit = source_commit()  # before the table is written, which is part of the tree
    for name in wanted.cases:
        merge(rows_of(name, CASES[name], wanted.moments, commit), TABLE, "case", columns=FIELDS)


if __name__ == "__main__":
    main()
