"""What a compact file of a series saves: rows of docs/data/compact_series.csv.

    python benchmarks/compact_series.py NAME RUN [RUN …] [--write]

RUN is a finished run; of one whose matter moves, the object at each time of its frames is taken, as if each had been
written by itself. Files: all objects as runs hold them, each in a compact file of its own, and all in one file that
shares what does not change; the largest difference of a place between the last two is given in pixels. With --write,
the row stands in the table in place of an earlier one of the same name.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from machine import commit
from rows import merge

import holosplat as hs
from holosplat.io.objects import Steps, names_of, read_object, read_series, write_compact, write_object, write_series
from holosplat.representations import MovingGaussians, MovingSurfaces, Stored
from holosplat.workflows.reconstruction import instants_of

OUT = Path(__file__).resolve().parents[1] / "docs" / "data" / "compact_series.csv"
COLUMNS = ("name", "kind", "objects", "plain_bytes", "alone_bytes", "series_bytes", "largest_difference_px", "commit")


def objects_of(runs: list[Path]) -> dict[str, Stored]:
    """The objects of the runs, or of one run at its times, by name."""
    folders = [hs.RunFolder(run) for run in runs]
    found = [read_object(folder.result()) for folder in folders]
    if len(found) == 1 and isinstance(found[0], MovingSurfaces | MovingGaussians):
        return {f"t{k:04d}": found[0].at(time) for k, time in enumerate(instants_of(folders[0]))}
    return dict(zip(names_of(runs), found))


def row(name: str, objects: dict[str, Stored]) -> dict[str, str]:
    """The row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        one, plain, alone, apart = Path(folder, "one.h5"), 0, 0, 0.0
        write_series(Path(folder, "series.h5"), objects, Steps())
        shared = read_series(Path(folder, "series.h5"))
        for key, obj in objects.items():
            write_object(one, obj)
            plain += one.stat().st_size
            write_compact(one, obj, Steps())
            alone += one.stat().st_size
            apart = max(apart, _apart(read_object(one), shared[key]))
        size = Path(folder, "series.h5").stat().st_size
    kind = next(iter(objects.values())).kind
    sizes = {"plain_bytes": str(plain), "alone_bytes": str(alone), "series_bytes": str(size)}
    about = {"name": name, "kind": kind, "objects": str(len(objects))}
    return about | sizes | {"largest_difference_px": f"{apart:.2g}", "commit": commit()}


def _apart(one: Stored, other: Stored) -> float:
    """How far apart the places of two objects are, which may be in another order [pixels]."""
    name = next(iter(one.parameters()))
    a, b = (np.sort(o.parameters()[name].double().numpy(), axis=0) for o in (one, other))
    return float(np.abs(a - b).max(initial=0.0))


def main() -> None:
    """Print the row, and write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name")
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    made = row(given.name, objects_of(given.runs))
    print(made)
    if given.write:
        merge([made], OUT, "name", columns=COLUMNS)


if __name__ == "__main__":
    main()
