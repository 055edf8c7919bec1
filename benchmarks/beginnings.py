"""From where a smooth volume is best begun: docs/data/beginnings.csv.

    python benchmarks/beginnings.py --out docs/data/beginnings.csv          # some ten minutes on one core

Scenes of continuous matter, of seeds that no table of results has, with little noise and much, in even light and
drifting, and with denser beads. A row: relative errors (‖found - true‖/‖true‖) of δ, or of β where nothing else is
seen, of the volume that goes on from even, faint matter, and of that which goes on from the start; how many times
likelier the start is when the program chooses (none where the first explains the frames); and which it takes.
"""

from __future__ import annotations

import argparse
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import written

import holosplat as hs
from holosplat.methods import smooth_fit
from holosplat.methods.illumination import prepared
from holosplat.methods.method import Task, begun, run_quietly
from holosplat.methods.volume import SmoothStage
from holosplat.representations import Stored
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import load_case

SCENES: tuple[tuple[str, int, float | None], ...] = (
    ("soft12", 11, None),
    ("soft12", 11, 500_000),
    ("soft12", 11, 50_000),
    ("soft12", 12, 20_000),
    ("soft12", 11, 5000),
    ("soft12", 13, 5000),
    ("light12-5000", 13, 5000),
    ("drift", 11, 20_000),
    ("drift", 13, 20_000),
    ("tissue16", 12, 20_000),
    ("coated", 11, None),
    ("coated", 11, 20_000),
    ("contact91", 11, 10_000),
)
"""Case, seed, photons a pixel."""
COLUMNS = ("case", "seed", "photons", "from_even", "from_start", "likelier", "taken", "commit")


@dataclass(frozen=True)
class Ended:
    """What a fit ended with. error: relative; likelier: how many times the start was, NaN where it was not asked."""

    error: float
    likelier: float


def ended(case: Case, clearly: float) -> Ended:
    """The smooth volume of a case where the start must be `clearly` times likelier to be taken."""
    scan, truth = case.scan(), case.truth()
    method = hs.methods.SmoothVolume()
    task = prepared(Task(scan[np.flatnonzero(~scan.is_test)], case.prior, matter="continuous"), method)
    stage = SmoothStage(method)
    start, task = begun(stage, task, None)
    fit = stage.fit(task, start)
    asked: list[float] = []
    end = smooth_fit.SmoothFit._end

    def noted(self: smooth_fit.SmoothFit, leg: smooth_fit.Leg, descent: smooth_fit.Descent) -> None:
        if leg.kind == "from start" and self._rival is not None and not asked:
            asked.append(self._rival[1] / descent.value)
        end(self, leg, descent)

    with patch.object(smooth_fit, "CLEARLY", clearly), patch.object(smooth_fit.SmoothFit, "_end", noted):
        found = run_quietly(fit, lambda share: None, Stored).voxelise(hs.Grid.of_views(scan.views))
    absorbs = not float(np.max(case.exposures.distance)) > 0
    one, other = ((v.beta if absorbs else v.delta).astype(np.float64) for v in (found, truth))
    return Ended(float(np.linalg.norm(one - other) / np.linalg.norm(other)), asked[0] if asked else math.nan)


def row(name: str, seed: int, photons: float | None) -> dict[str, str]:
    """A row of the table."""
    case = replace(load_case(name, seed), photons=photons)
    even, start = ended(case, math.inf), ended(case, 0.0)
    taken = "start" if even.likelier > smooth_fit.CLEARLY else "even"
    said = {"case": name, "seed": str(seed), "photons": f"{photons or 0:g}", "from_even": f"{even.error:.4f}"}
    likelier = "" if math.isnan(even.likelier) else f"{even.likelier:.3g}"
    return said | {"from_start": f"{start.error:.4f}", "likelier": likelier, "taken": taken, "commit": commit()}


def main() -> None:
    """Write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    written(arguments.out, COLUMNS, (row(*scene) for scene in SCENES))


if __name__ == "__main__":
    main()
