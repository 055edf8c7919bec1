"""The command line within a test's process, and the tiny scene that its tests share."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
from tyro import _unsafe_cache

from holosplat.baselines import HolographicTV
from holosplat.cli import main
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.methods import FitOptions, Gaussians

_unsafe_cache.clear_cache = lambda: None  # what the parser has read of docstrings and types it reads once a process

PIXEL = 3.2e-6
ROWS, COLUMNS = 24, 28
FORMULA = "C2952H4664N812O832S8Fe4"
MATTER = ["--length-unit", "um", "--material", FORMULA, "--density", "1.335"]
BEAM = ["--energy-kev", "20", "--distance", "0.1", "--pixel-size", "3.2e-6", "--detector", "24", "28"]

QUICK = Gaussians(
    spacing_px=2.0,
    approximate_steps=5,
    volume=HolographicTV(iterations=30, corrections=2, inner=8, refine=1),
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=6)),
)
"""Options for runs whose quality does not matter."""


@dataclass(frozen=True)
class Outcome:
    """What a command gave back."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """stderr on one line, without frames."""
        return re.sub(r"[\s│╭╮╰╯─|+-]+", " ", self.err)


def holosplat(*arguments: object) -> Outcome:
    """Run a command within this process, where any exception but a clean exit fails the test."""
    out, err, before = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["holosplat", *map(str, arguments)]
    code: object = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        code = end.code or 0
    finally:
        sys.argv = before
    assert isinstance(code, int)
    return Outcome(code, out.getvalue(), err.getvalue())


PROGRAM = [sys.executable, "-c", "from holosplat.cli import main; main()"]


def in_a_shell(*arguments: object, cwd: Path) -> Outcome:
    """Run a command as a process of its own."""
    done = subprocess.run([*PROGRAM, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert "Traceback" not in done.stderr
    return Outcome(done.returncode, done.stdout, done.stderr)


def worked(outcome: Outcome) -> Outcome:
    assert outcome.code == 0, outcome.err
    assert "holosplat:" not in outcome.err
    return outcome


@dataclass(frozen=True)
class Workshop:
    """Files that several tests read: meshes, their scan and true volume, quick settings, and a run."""

    path: Path
    cells: tuple[Path, ...]
    scan: Path
    truth: Path
    quick: Path
    run: Path


def simulate(shop: Workshop, *options: object) -> Outcome:
    return holosplat("simulate", *shop.cells, *MATTER, *BEAM, *options)


def known(shop: Workshop) -> list[object]:
    """The material, that it has levels, and the quick settings."""
    return ["--material", "haemoglobin", "--matter", "levels", "--config", shop.quick]


def copied(source: Path, folder: Path, change: Callable[[h5py.File], object]) -> Path:
    """A changed copy of an HDF5 file."""
    target = Path(shutil.copy(source, folder))
    with h5py.File(target, "r+") as file:
        change(file)
    return target


def refused(outcome: Outcome, *words: str) -> None:
    """Exit code 2 and one clear sentence (or two) on stderr, holding `words`."""
    assert outcome.code == 2, outcome
    assert "Traceback" not in outcome.err
    lines = [line for line in outcome.err.splitlines() if line.startswith("holosplat: ")]
    assert len(lines) == 1, outcome.err
    assert outcome.err.rstrip().endswith(lines[0])
    assert lines[0].endswith((".", "?"))
    assert not lines[0].endswith("..")
    assert "np." not in lines[0]
    for word in words:
        assert word in lines[0], f"{word!r} not in {lines[0]!r}"


def everything_in(folder: Path) -> set[str]:
    """All that is in a folder, hidden files too, with sizes and times."""
    return {f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in folder.rglob("*")}


DETECTOR = "entry/instrument/detector"


def put(name: str, value: object, units: str | None = None) -> Callable[[h5py.File], None]:
    """A change that replaces a dataset, keeping its unit unless another one is given."""

    def change(file: h5py.File) -> None:
        before = file[name].attrs.get("units")
        del file[name]
        file[name] = value
        if units or before:
            file[name].attrs["units"] = units or before

    return change


def drop(name: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(name)


def truncated(file: Path, folder: Path) -> Path:
    """The first half of a file."""
    target = folder / file.name
    target.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return target


def altered(*pairs: str, drop: str = "") -> list[str]:
    """`simulate`'s options with some replaced, and perhaps one left out."""
    usual = {
        "--length-unit": "um",
        "--material": "haemoglobin",
        "--energy-kev": "20",
        "--distance": "0.1",
        "--pixel-size": "3.2e-6",
        "--detector": "24 28",
        "--views": "2",
    }
    usual |= dict(zip(pairs[::2], pairs[1::2]))
    usual.pop(drop, None)
    return [word for flag, values in usual.items() for word in (flag, *values.split())]
