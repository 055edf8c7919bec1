"""How finely the thesis' case is sampled, in angle and by waves: docs/data/thesis_study/sampling.csv.

    python benchmarks/thesis_sampling.py --snapshots DIR

Waves: the held-out frames of `thesis16` from exact line integrals of its meshes, with 1 to 8 wave samples a pixel,
beside those with 12: root mean square of the difference over that of the contrast. Angle: what even views over
180° resolve of a body of the matter's width, π D / N (Crowther, DeRosier & Klug 1970), in pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from machine import commit
from rows import written

from holosplat.model import Instrument
from holosplat_bench.declaration import Case
from holosplat_bench.suite.case import load_case
from holosplat_bench.thesis.configurations import PHYSICS

OUT = Path(__file__).resolve().parents[1] / "docs" / "data" / "thesis_study" / "sampling.csv"
SAMPLES, FINEST = (1, 2, 3, 4, 6, 8), 12
VIEWS = (4, 8, 12, 16, 32)


def waves(case: Case, physics: str) -> Iterator[tuple[str, str, int, float]]:
    """Rows of one physics setting."""
    taken = PHYSICS[physics].of(case)
    exposures = taken.exposures[np.flatnonzero(taken.is_test)]

    def frames(samples: int) -> np.ndarray:
        instrument = Instrument(exposures, samples)
        return instrument.image(*taken.scene.project(instrument.views)).numpy()

    best = frames(FINEST)
    for samples in SAMPLES:
        error = np.sqrt(np.mean((frames(samples) - best) ** 2) / np.mean((best - 1) ** 2))
        yield "waves", physics, samples, float(error)


def angles(case: Case) -> Iterator[tuple[str, str, int, float]]:
    """Rows of numbers of views: what they resolve [pixels] of the matter's extent across the axis."""
    delta = case.truth().delta
    across = [np.flatnonzero(delta.any(axis=other)) for other in ((1, 2), (0, 1))]
    extent = float(np.hypot(*(np.ptp(index) + 1 for index in across)))
    for count in VIEWS:
        yield "angle", f"{extent:.1f} pixels across", count, np.pi * extent / count


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--snapshots", type=Path, required=True)
    case = load_case("thesis16", 0, parser.parse_args().snapshots)
    rows = [*(row for physics in ("declared", "far") for row in waves(case, physics)), *angles(case)]
    columns = ("what", "of", "count", "value", "seed", "commit")
    written(OUT, columns, (dict(zip(columns, (*row, f"{value:.4g}", case.seed, commit()))) for *row, value in rows))


if __name__ == "__main__":
    main()
