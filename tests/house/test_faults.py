"""A few trials of `benchmarks/faults.py`, which does many; and what it counts as what."""

from __future__ import annotations

import importlib
import json
import random
import signal
from pathlib import Path
from types import ModuleType

import pytest

from holosplat.io.vtk import write_mesh
from holosplat.specimens.red_cells import random_cells

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def faults() -> ModuleType:
    """benchmarks/faults.py, which imports its neighbours by bare names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        return importlib.import_module("faults")


@pytest.fixture(scope="module")
def shop(faults, tmp_path_factory):
    """One cell and its scan; nothing else is there."""
    path = tmp_path_factory.mktemp("faults")
    shop = importlib.import_module("fault_shop")
    (cell,) = random_cells(1, (shop.COLUMNS * shop.PIXEL,) * 3, 1, 10 * shop.PIXEL)
    write_mesh(path / "cell.vtk", cell, "um")
    made = faults.Shop(path, (path / "cell.vtk",))
    assert faults.run(made.simulate(made.scan)).code == 0
    return made


def writer(faults, name: str):
    return next(one for one in faults.WRITERS if one.name == name)


@pytest.mark.parametrize("kind", ["kill -9", "full disk"])
def test_writers_are_disturbed(faults, shop, kind):
    found = faults.trials(shop, kind, 2, random.Random(2), (writer(faults, "convert"),))
    assert found == {"trials": 2}


def test_odd_values_and_hostile_meshes(faults, shop, monkeypatch):
    files = importlib.import_module("fault_files")
    monkeypatch.setattr(files, "FLAGS", {"simulate": "energy-kev distance misalign-shift", "grow": "flow diameter"})
    assert faults.trials(shop, "odd values", 3, random.Random(1)) == {"trials": 3}


def test_a_file_that_is_lost_is_counted(faults, shop, monkeypatch):
    """A writer that writes in place, and is killed."""

    def in_place(arguments: list[object], **_: object):
        (Path(str(arguments[2])) / "frames.tif").parent.mkdir(exist_ok=True)
        return importlib.import_module("forked").Ended(None, signal.SIGKILL, "", 0.1)

    monkeypatch.setattr(importlib.import_module("fault_kills"), "run", in_place)
    assert faults.trials(shop, "kill -9", 1, random.Random(1), (writer(faults, "convert"),)) == {"trials": 1, "lost": 1}


@pytest.mark.parametrize(
    ("code", "by", "said", "verdict"),
    [
        (0, 0, "", ""),
        (2, 0, "holosplat: x must be y.", ""),
        (1, 0, "Traceback (most recent call last):", "traceback"),
        (1, 0, "", "traceback"),
        (None, signal.SIGSEGV, "", "crash"),
        (None, signal.SIGALRM, "", "hang"),
    ],
)
def test_ends_are_told_apart(faults, code, by, said, verdict):
    ended = importlib.import_module("forked").Ended(code, int(by), said, 0.1)
    assert importlib.import_module("fault_kills").sentence(ended) == verdict


@pytest.mark.parametrize(
    ("noticed", "frames", "verdict"),
    [(True, [1.0, 1.0], ""), (False, [1.0, 1.0], "silent"), (True, [1.0, 2.0], "silent")],
)
def test_what_an_altered_run_may_say(faults, tmp_path, monkeypatch, noticed, frames, verdict):
    """Nothing but what it said before, and `check` has to notice."""
    files = importlib.import_module("fault_files")
    for name in ("config.json", "summary.json"):
        (tmp_path / name).write_text(json.dumps({"energy_kev": 20.0}))
    said = iter(frames)
    monkeypatch.setattr(files, "copied_run", lambda shop, folder: tmp_path)
    monkeypatch.setattr(files, "_predicted", lambda shop, found: next(said))
    monkeypatch.setattr(files, "check", lambda path: (2, ["altered"] if noticed else []))
    assert faults.SINGLE["tampered runs"](None, random.Random(2), tmp_path) == verdict


def test_a_kind_that_is_tried_again_takes_its_row(faults):
    rows = [{"kind": "a", "trials": 1}, {"kind": "b", "trials": 2}]
    assert faults.replaced(rows, {"kind": "a", "trials": 5}) == [{"kind": "a", "trials": 5}, rows[1]]
    assert faults.replaced(rows, {"kind": "c", "trials": 5}) == [*rows, {"kind": "c", "trials": 5}]
