"""How well `align` finds the poses of few views that judge themselves: docs/data/few_views.csv.

    python benchmarks/few_views.py [--cases NAME …]

Five red cells on 64 × 64 pixels of 1 µm in beams as those of docs/four_beams.md, and scenes of the benchmark, in plans
that are wrong by 1 pixel, 0.6° and 2 % (standard deviations), or right. No frame is held out. Errors are those after
the best motion of the whole object: rms of all views, planned, found, and as `align` says them.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from alignment import FINE, Row, rms_errors
from rows import merge
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.align import align_views
from holosplat.beamline.light import UnevenLight
from holosplat.beamline.misalignment import AS_PLANNED, Misalignment
from holosplat.version import source_commit
from holosplat_bench.suite.case import load_case

TABLE = Path(__file__).resolve().parents[1] / "docs/data/few_views.csv"
ANGLES, TILTS = (0.0, 40.0, 85.0, 130.0, 20.0, 110.0), (0.0, 8.0, -6.0, 4.0, -9.0, 7.0)
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
NUMBERS = ("shift_px", "across_deg", "roll_deg")


@dataclass(frozen=True)
class Experiment:
    """scene: of the benchmark, or "beams"; seed: of the scene and the errors; views; photons a pixel, None for no
    noise; wrong: whether the plan is; smooth, grain: share of light that the flat field does not say, smooth over 25
    pixels or grainy, another in each frame, where there are photons."""

    scene: str
    seed: int
    views: int = 4
    photons: float | None = None
    wrong: bool = True
    smooth: float = 0.0
    grain: float = 0.0

    def measured(self) -> tuple[hs.Scan, hs.Exposures, hs.MaterialPrior]:
        """The scan with the planned exposures, the true ones, and what is known of the matter."""
        if self.scene == "beams":
            cells = hs.specimens.random_cells(5, (60e-6, 56e-6, 60e-6), self.seed + 4, 26e-6)
            scene, prior = hs.MeshScene.of_one_material(cells, MATERIAL), hs.MaterialPrior.known(MATERIAL)
            upright = hs.Views.from_angles(np.array(ANGLES[: self.views]), (64, 64), 1e-6)
            tilts = Rotation.from_euler("x", np.deg2rad(TILTS[: self.views])[:, None]).as_matrix()
            views = replace(upright, rotations=tilts @ upright.rotations)
            planned = hs.Exposures.of(views, 20.0, 0.05, 0.3)
        else:
            case = load_case(self.scene, self.seed)
            train = np.flatnonzero(~case.is_test)
            some = train[np.linspace(0, len(train), self.views, endpoint=False).astype(int)]
            scene, prior, planned = case.scene, case.prior, case.exposures[some]
        errors = Misalignment(1.0, 0.6, 0.02, self.seed) if self.wrong else AS_PLANNED
        true, none = errors.true_exposures(planned), np.zeros(len(planned), dtype=bool)
        if self.smooth or self.grain:
            light = UnevenLight(
                light_smooth=self.smooth, light_smooth_px=25.0, light_grain=self.grain, light_seed=self.seed
            )
            noisy = hs.simulate(scene, true, photons_per_pixel=self.photons, seed=self.seed, light=light, is_test=none)
            return hs.Scan(noisy.frames, planned, none), true, prior
        frames = hs.simulate(scene, true, seed=0, is_test=none).frames
        if self.photons is not None:
            frames = np.random.default_rng(self.seed).poisson(frames * self.photons) / self.photons
        return hs.Scan(frames.astype(np.float32), planned, none), true, prior


CASES = {
    **{f"light of 2 %, 20000 photons, seed {s}": Experiment("beams", s, 4, 20000, smooth=0.02) for s in (1, 2, 3)},
    **{f"grain of 1 %, 20000 photons, seed {s}": Experiment("beams", s, 4, 20000, grain=0.01) for s in (1, 2)},
    "6 beams, light of 2 %, 20000 photons, seed 2": Experiment("beams", 2, 6, 20000, smooth=0.02),
    **{f"beams, 20000 photons, seed {s}": Experiment("beams", s, photons=20000) for s in (1, 2, 3)},
    **{f"beams, 2000 photons, seed {s}": Experiment("beams", s, photons=2000) for s in (1, 2, 3)},
    **{f"beams, no noise, seed {s}": Experiment("beams", s) for s in (1, 2)},
    **{f"3 beams, 20000 photons, seed {s}": Experiment("beams", s, 3, 20000) for s in (1, 2)},
    **{f"6 beams, 20000 photons, seed {s}": Experiment("beams", s, 6, 20000) for s in (1, 2)},
    **{f"beams, right plan, 20000 photons, seed {s}": Experiment("beams", s, 4, 20000, False) for s in (1, 2, 3)},
    "beams, right plan, no noise, seed 1": Experiment("beams", 1, wrong=False),
    **{f"4 of fine cells, seed {s}": Experiment(FINE, s) for s in (1, 2)},
    **{f"4 of soft cells, seed {s}": Experiment("soft12", s) for s in (1, 2, 3)},
    "4 of soft cells, right plan, seed 1": Experiment("soft12", 1, wrong=False),
}


def row_of(name: str, experiment: Experiment) -> Row:
    """Errors of the plan, and of what was found; what is said of them."""
    scan, true, prior = experiment.measured()
    began = time.process_time()
    found = align_views(scan, prior)
    seconds = time.process_time() - began
    row: Row = {"case": name, "views": len(scan)}
    said = np.sqrt(np.square(found.errors).mean(0))[[0, 2, 4]]
    for moment, values in (
        ("planned", rms_errors(scan.exposures, true)[:3]),
        ("found", rms_errors(found.exposures, true)[:3]),
        ("said", said),
    ):
        row |= {f"{moment}_{key}": f"{value:.4f}" for key, value in zip(NUMBERS, values, strict=True)}
    kept = [word.split(" is as planned")[0] for word in found.words if " is as planned" in word]
    return row | {"as_planned": " ".join(kept), "cpu_seconds": f"{seconds:.0f}"}


def main() -> None:
    """Run cases; rows of others stay."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    wanted = parser.parse_args()
    commit = source_commit()  # before the table is written, which is part of the tree
    for name in wanted.cases:
        machine = {"machine": f"{platform.machine()}, one core of two", "commit": commit}
        row = row_of(name, CASES[name]) | machine
        print(row, flush=True)
        merge([row], TABLE, "case", columns=list(row))


if __name__ == "__main__":
    main()
