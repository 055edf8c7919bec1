"""What whole runs are said to take beside what they take: `holosplat info`'s estimates against processor time and peak
memory of `reconstruct` in a process of its own. The estimates were mended by these scans: choose others to judge them.

python benchmarks/needs_runs.py --csv docs/data/needs_runs.csv [--scans single noisy] [--again]

Estimates are ranges where the frames decide between ways. Wanted: no more than a factor of 1.5 beyond a range. Other
programs beside it make processor time longer.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import tempfile
from pathlib import Path

import machine
from forked import run
from needs import peak
from rows import read, write

from holosplat.io import read_scan
from holosplat.io.atomic import read_json
from holosplat.matter import MatterKind
from holosplat.methods import Auto
from holosplat.planning.needs import Sizes, of_reconstruction
from holosplat.planning.scan_facts import seen_of
from holosplat.workflows.demo import write_demo_meshes

KNOWN = ("--material", "haemoglobin")
FINE, ALL = ("--pixel-size", 1e-6), ("--test-every", 0)
SCANS: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "cells": (("--detector", 128, 128, "--views", 24), KNOWN),
    "single": (("--detector", 128, 128, "--views", 1, *ALL), KNOWN),
    "noisy": (("--detector", 96, 112, "--pixel-size", 4e-6, "--views", 5, "--photons-per-pixel", 500, *ALL), KNOWN),
    "tissue": (("--detector", 64, 72, *FINE, "--views", 4, "--photons-per-pixel", 5000, *ALL), ()),
    "fibres": (("--detector", 80, 80, *FINE, "--views", 12, "--photons-per-pixel", 3000), ()),
    "soft-cells": (("--detector", 24, 256, "--views", 6), ()),
    "head-phantom": (
        ("--detector", 48, 64, "--pixel-size", 2e-5, "--views", 61, "--distance", 0, "--photons-per-pixel", 10000),
        (),
    ),
}
"""Specimens, or else the cells of the demo; how they are simulated, and the options of `reconstruct`."""
LIKE_CELLS = ("cells", "single", "noisy")


def row(name: str, measured: dict[str, object] | None = None) -> dict[str, object]:
    """What a run is said to take, and takes [MB, s], if that is not `measured`."""
    beam, told = SCANS[name]
    with tempfile.TemporaryDirectory() as folder:
        scan, out = Path(folder) / "scan.nxs", Path(folder) / "run"
        what = _cells(Path(folder) / "meshes") if name in LIKE_CELLS else ["--specimen", name]
        ended = run(["simulate", *what, *beam, "--out", scan], limit=3600)
        if ended.code != 0:
            raise SystemExit(ended.said)
        said = compared(scan, told)
        if measured is not None:
            return measured | said
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        memory = peak(["reconstruct", scan, "--out", out, *told])
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - began.ru_utime - began.ru_stime
        kind = read_json(out / "summary.json")["kind"]
    found = {"result": kind, "measured_mb": round(memory / 1e6), "measured_s": round(seconds)}
    machine_ = {"machine": f"{os.cpu_count()} × {platform.machine()}, shared", "commit": machine.commit()}
    return {"scan": name} | said | found | machine_


def _cells(folder: Path) -> list[object]:
    """Files of the demo's cells."""
    folder.mkdir()
    return list(write_demo_meshes(folder))


def compared(scan: Path, told: tuple[str, ...]) -> dict[str, int]:
    """What a run is said to take."""
    train = read_scan(scan).train()
    kind: MatterKind | None = "levels" if told else None
    said = of_reconstruction(Sizes.of(train.exposures), Auto(), kind, seen_of(train, Auto()), bool(told))
    assert said is not None
    ends = {"least_mb": (said.least_memory or said.memory) / 1e6, "most_mb": said.memory / 1e6}
    ends |= {"least_s": said.seconds, "most_s": said.most_seconds or said.seconds}
    return {end: round(value) for end, value in ends.items()}


def main() -> None:
    """All scans that are asked for, and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--scans", nargs="*", default=list(SCANS))
    parser.add_argument("--again", action="store_true", help="estimates anew, beside the measurements of the table")
    given = parser.parse_args()
    rows = {str(one["scan"]): dict(one) for one in read(given.csv)} if given.csv.exists() else {}
    for name in given.scans:
        rows[name] = row(name, rows.get(name) if given.again else None)
        print(rows[name], flush=True)
        write(list(rows.values()), given.csv)


if __name__ == "__main__":
    main()
