"""The script that compares a benchmark with the committed one."""

from __future__ import annotations

import csv
import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from holosplat_bench.suite.folder import BenchFolder, Row

TEST = {"ssim": 0.9, "frcm": 0.8}
VOLUME = {"dice": 0.95, "relative_error_delta": 0.1}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/same_scores.py."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return importlib.import_module("same_scores")


@pytest.fixture
def bench(tmp_path: Path) -> Callable[..., Path]:
    """Makes a benchmark of the given rows: case, status, and scores that are not as usual."""

    def make(*rows: tuple[str, str, dict[str, float]]) -> Path:
        folder = BenchFolder(tmp_path / "bench")
        folder.create()
        for case, status, changed in rows:
            test, volume = ({name: changed.get(name, value) for name, value in part.items()} for part in (TEST, VOLUME))
            about = ("family", "summary", 0, status, "", "hash", "new", "today")
            folder.write_row(Row(case, 101, "gaussians", *about, test=test, volume=volume))
        return folder.path

    return make


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    """A table of cells8 and foam12, and of shells8, which failed."""
    path = tmp_path / "committed.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["case", "seed", "method", "status", "commit", *TEST, *VOLUME])
        for case, status in (("cells8", "done"), ("foam12", "done"), ("shells8", "failed")):
            writer.writerow([case, 101, "gaussians", status, "old", *TEST.values(), *VOLUME.values()])
    return path


def test_equal_rows_do_not_differ(script, bench, committed):
    (row,) = script.compared(bench(("cells8", "done", {})), committed)
    assert (row["case"], row["seed"], row["method"]) == ("cells8", 101, "gaussians")
    assert (row["commit"], row["before"]) == ("new", "old")
    assert {name: row[name] for name in script.SCORES} == TEST | VOLUME
    assert all(row[f"{name}_change"] == 0 for name in script.SCORES)


def test_a_row_that_differs_says_by_how_much(script, bench, committed):
    same, other = script.compared(bench(("cells8", "done", {}), ("foam12", "done", {"dice": 0.93})), committed)
    assert same["dice_change"] == 0
    assert other["dice_change"] == pytest.approx(-0.02)
    assert other["ssim_change"] == other["frcm_change"] == other["relative_error_delta_change"] == 0


def test_rows_that_only_one_of_them_has_are_left_out(script, bench, committed):
    """Of another case, failed now, and failed before; the table's other rows are not asked for."""
    path = bench(("thesis16", "done", {}), ("foam12", "failed", {}), ("shells8", "done", {}))
    assert script.compared(path, committed) == []


def test_what_it_prints_and_writes(script, bench, committed, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(script.compared, "__defaults__", (committed,))
    script.main(bench(("cells8", "done", {"frcm": 0.75}), ("foam12", "done", {})), tmp_path / "out.csv")
    printed = capsys.readouterr().out
    assert "frcm 0.7500 (-5.0e-02)" in printed
    assert "2 rows; the largest change is 5.0e-02" in printed
    with (tmp_path / "out.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [row["case"] for row in written] == ["cells8", "foam12"]
    assert float(written[0]["frcm_change"]) == pytest.approx(-0.05)


def test_nothing_to_compare_is_said(script, bench, committed, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(script.compared, "__defaults__", (committed,))
    script.main(bench(("thesis16", "done", {})), tmp_path / "out.csv")
    assert "0 rows; the largest change is nan" in capsys.readouterr().out
    assert not (tmp_path / "out.csv").exists()
