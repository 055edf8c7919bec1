"""A measured living cell by default, scored by other people's program: docs/data/measured_cell.csv.

    python benchmarks/measured_cell.py --data FOLDER                # all cases: a quarter of an hour on one core
    python benchmarks/measured_cell.py --data FOLDER --case 12-20-0

FOLDER holds the measured fields of an HL60 cell (RI-imaging/ODTbrain, CC0), `hl60_holograms.py`, which propagates them
to in-line holograms, and `hl60_score.py`, which projects an exported volume by itself. A case is named by its views, by
λz / pixel² and by the photons a pixel (0: no photon noise), with `-unknown` where no ratio δ/β is told. Rows that are
there are not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tarfile
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from machine import commit
from rows import machine, read, replaced, shown

import holosplat as hs

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "measured_cell.csv"
RATIO = 1e5
CASES = ("12-50-0", "12-50-0-unknown", "4-50-0", "12-50-2000", "12-20-0", "12-120-0")


@dataclass(frozen=True)
class Row:
    """phase, hologram: relative errors of held-out views; shape: the phase's after the best factor; mass: total phase
    over the true one; decided: each decision; seconds: of the processor"""

    case: str
    phase: float
    shape: float
    mass: float
    hologram: float
    decided: str
    result: str
    seconds: float
    machine: str
    commit: str


def run(case: str, data: Path, folder: Path) -> Row:
    """The default on one case."""
    views, fresnel, photons, *unknown = case.split("-")
    with tarfile.open(data / "hl60_qlsi_A140.tar.lzma", "r:xz") as archive:
        archive.extractall(folder, filter="data")
    made = [sys.executable, data / "hl60_holograms.py", folder / "series.h5", folder / "angles.txt", folder / "cell"]
    told = ["--train", views, "--fresnel", fresnel, "--photons", photons]
    subprocess.run([*map(str, made), *told], check=True, capture_output=True)
    scan, began = hs.io.read_scan(folder / "cell.nxs"), time.process_time()
    prior = hs.MaterialPrior.unknown() if unknown else hs.MaterialPrior.of_ratio(RATIO)
    done = hs.reconstruct(scan, prior)
    seconds = time.process_time() - began
    volume = done.object.voxelise(hs.Grid.of_views(scan.views))
    hs.io.write_volume(folder / "cell.h5", volume)
    score = [sys.executable, str(data / "hl60_score.py"), str(folder / "cell.truth.npz"), str(folder / "cell.h5")]
    found = json.loads(subprocess.run(score, check=True, capture_output=True, text=True).stdout)
    errors = (found[name] for name in ("phase", "shape", "mass", "hologram"))
    decided = " | ".join(each.line for each in done.choice.decisions)
    return Row(case, *errors, decided, done.object.kind, round(seconds, 1), machine(), commit())


def main() -> None:
    """Make the rows that are asked for and not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of measured frames")
    parser.add_argument("--case", nargs="+", default=CASES, metavar="CASE")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for case in options.case:
        if case in {row["case"] for row in read(options.out)}:
            continue
        with tempfile.TemporaryDirectory() as folder:
            row = run(case, options.data, Path(folder))
        replaced(options.out, row, key=1)
        shown(row)


if __name__ == "__main__":
    main()
