"""A few trials of `benchmarks/faults.py`, which does many; and what it counts as what."""

from __future__ import annotations

import importlib
import json
import random
import signal
import time
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib.figure import Figure

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
    """One cell, its scan and a run; nothing else is there. Figures stay blank."""
    path = tmp_path_factory.mktemp("faults")
    shop = importlib.import_module("fault_shop")
    (cell,) = random_cells(1, (shop.COLUMNS * shop.PIXEL,) * 3, 1, 10 * shop.PIXEL)
    write_mesh(path / "cell.vtk", cell, "um")
    made = faults.Shop(path, (path / "cell.vtk",))
    made.quick.write_text(json.dumps(shop.QUICK))
    made.case.write_text(shop.two_cells(shop.ROWS, shop.COLUMNS, shop.PIXEL, 24e-6, 5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", Figure.savefig)  # which is put back in the end
        faults.loaded()
        for command in (made.simulate(made.scan), made.reconstruct(made.run)):
            assert importlib.import_module("forked").run(command).code == 0
        yield made


def writer(faults, name: str):
    return next(one for one in faults.WRITERS if one.name == name)


KINDS = [
    "kill -9",
    "full disk",
    "no permission",
    "little memory",
    "bit flips",
    "tampered runs",
    "hostile files",
    "odd values",
    "two writers",
    "extreme kernels",
    "files of all formats",
    "files of a run",
    "outputs over inputs",
    "values of other files",
]


def test_all_kinds_are_known(faults):
    assert sorted(KINDS) == sorted([*faults.DISTURBED, *faults.LIMITED, *faults.SINGLE])


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_tried(faults, shop, kind):
    found = faults.trials(shop, kind, 2, random.Random(2), (writer(faults, "convert"),))
    assert found == {"trials": 2}


def test_kernels_are_given_extreme_numbers_of_every_kind(faults, shop):
    assert faults.trials(shop, "extreme kernels", 30, random.Random(5)) == {"trials": 30}


@pytest.mark.parametrize("seed", range(4))
def test_inputs_and_folders_are_barred(faults, shop, seed):
    """By turns; both are as they were in the end."""
    mode = shop.scan.stat().st_mode
    assert faults.trials(shop, "no permission", 1, random.Random(seed), (writer(faults, "convert"),)) == {"trials": 1}
    assert shop.scan.stat().st_mode == mode


def test_what_is_taken_without_permission_is_counted(faults, shop, tmp_path, monkeypatch):
    limits = importlib.import_module("fault_limits")
    monkeypatch.setattr(limits, "powerless", lambda: None)
    monkeypatch.setattr(limits, "run", lambda command, first: importlib.import_module("forked").Ended(0, 0, "", 0.1))
    assert limits.denied(shop, writer(faults, "convert"), random.Random(1), tmp_path) == "silent"


def test_a_command_that_only_reads_may_work_where_nothing_can_be_written(faults, shop, tmp_path):
    limits = importlib.import_module("fault_limits")
    assert limits.denied(shop, writer(faults, "evaluate"), random.Random(1), tmp_path) == ""


def test_memory_that_does_not_do_ends_in_a_sentence(faults, shop, tmp_path):
    """Not even for the libraries; and for these alone, where it may do in what earlier tests have given back."""
    limits, kills = (importlib.import_module(name) for name in ("fault_limits", "fault_kills"))
    command = writer(faults, "convert").command(shop, tmp_path)
    never, after = (
        limits._anew(command, 200 << 20),
        importlib.import_module("forked").run(command, first=lambda: limits.limited(1 << 20)),
    )
    assert never.code == 2
    for ended in (never, after):
        assert kills.sentence(ended) == "", ended.said
        assert ended.code == 0 or "memory" in ended.said


def test_a_kernel_that_crashes_or_fails_is_counted(faults, shop, tmp_path, monkeypatch):
    limits = importlib.import_module("fault_limits")
    acts = {
        "crash": lambda *_: signal.raise_signal(signal.SIGTRAP),
        "traceback": lambda *_: 1 // 0,
        "": lambda *_: None,
    }
    for verdict, act in acts.items():
        monkeypatch.setattr(limits, "_used", act)
        assert limits.extreme(shop, random.Random(1), tmp_path) == verdict


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


class Drawn:
    """In place of random numbers: a kill before the change of files `number`, from 0 on."""

    def __init__(self, number: int) -> None:
        self.number = number

    def random(self) -> float:
        return 0.0

    def randrange(self, stop: int) -> int:
        assert self.number < stop
        return self.number


def test_nothing_is_lost_before_any_change_of_files(faults, shop, tmp_path):
    """A volume and its record are whole or none, and no half-written one stays once the command is given again."""
    kills, export = importlib.import_module("fault_kills"), writer(faults, "export .vti")
    cost = importlib.import_module("fault_cost").Cost.of(shop, export)
    assert cost.changes >= 4  # a volume and its record, each written and put in its place
    for number in range(cost.changes):
        (tmp_path / f"{number}").mkdir()
        assert kills.killed(shop, export, cost, Drawn(number), tmp_path / f"{number}") == ""


def test_a_kill_comes_before_the_change_that_is_drawn(faults, tmp_path):
    """The file that is begun then is not there, the one before it is."""
    forked = importlib.import_module("forked")

    def act() -> None:
        forked.at_events(tmp_path, lambda number: signal.raise_signal(signal.SIGKILL) if number == 2 else None)
        for name in ("one", "two"):
            (tmp_path / name).write_text((BENCHMARKS / "faults.py").read_text())

    assert forked.attempted(act).signal == signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


def test_a_machine_that_does_something_else_is_no_hang(faults):
    """A command that took ten seconds of a processor was called hanging where twelve others ran."""
    forked = importlib.import_module("forked")
    assert forked.attempted(lambda: time.sleep(0.3), limit=0.1).code == 0
    assert forked.attempted(lambda: time.sleep(9.0), limit=0.02).signal == signal.SIGALRM
    assert forked.attempted(lambda: sum(iter(int, 1)), limit=0.1).signal == signal.SIGPROF


@pytest.mark.parametrize(
    ("code", "by", "said", "verdict"),
    [
        (0, 0, "", ""),
        (2, 0, "holosplat: x must be y.", ""),
        (1, 0, "Traceback (most recent call last):", "traceback"),
        (1, 0, "", "traceback"),
        (None, signal.SIGSEGV, "", "crash"),
        (None, signal.SIGALRM, "", "hang"),
        (None, signal.SIGPROF, "", "hang"),
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
