"""The benchmark's names and folders, its command, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import holosplat as hs
from helpers.bench_shop import SHAPES, Recorder, fail, make_case, suite
from helpers.cli import holosplat as run_command
from holosplat import version
from holosplat_bench.suite.folder import BenchFolder
from holosplat_bench.suite.prepare import MEASURED
from holosplat_bench.suite.run import chosen, run_suite

pytestmark = pytest.mark.usefixtures("unjudged_runs", "plain_light")

# --- names and folders --------------------------------------------------------------------------------------


def test_names_are_chosen_in_the_tables_order_or_refused():
    table = ["a", "b", "c"]
    assert chosen("--cases", [], table) == table
    assert chosen("--cases", ["c", "a", "c"], table) == ["a", "c"]
    with pytest.raises(hs.InputError, match="--cases must be among a, b, c, but x, y is not"):
        chosen("--cases", ["a", "x", "y"], table)


@pytest.mark.parametrize(
    ("cases", "seeds", "words"),
    [
        ((), (1,), "one of the cases"),
        (("a",), (), "seeds"),
        (("a",), (-1,), "0 or more"),
        (("a", "../b"), (1,), "but one is '../b'"),
    ],
)
def test_a_suite_of_nothing_is_refused(recorder, cases, seeds, words):
    with pytest.raises(hs.InputError, match=words):
        suite([recorder.method("one")], cases, seeds)


@pytest.mark.parametrize("kind", ["foreign", "file", "orphan", "other json"])
def test_folders_that_are_no_benchmark_are_left_alone(recorder, tmp_path, kind):
    path = tmp_path / "bench"
    if kind == "foreign":
        path.mkdir()
        (path / "thesis.tex").write_text("ten years of work")
    elif kind == "file":
        path.write_text("a file")
    elif kind == "orphan":
        path = tmp_path / "no" / "such"
    else:
        path.mkdir()
        (path / "bench.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(hs.InputError, match="must lie in an existing folder" if kind == "orphan" else "--out"):
        run_suite(suite([recorder.method("one")]), BenchFolder(path))
    assert sorted(tmp_path.rglob("*")) == before
    assert not recorder.calls


def test_names_that_could_leave_the_folder_are_refused(tmp_path):
    with pytest.raises(hs.InputError, match="letters, digits"):
        BenchFolder(tmp_path).has_row("../../etc", 1, "m")


# --- the command line ---------------------------------------------------------------------------------------


def holosplat(*arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command run within this process."""
    done = run_command(*arguments)
    return done.code, done.out, done.err


@pytest.fixture
def shop(recorder, monkeypatch) -> Recorder:
    """The command line with two small cases and two fast methods."""
    methods = {name: recorder.method(name) for name in ("one", "two")}
    monkeypatch.setattr("holosplat_bench.suite.methods.METHODS", methods)
    monkeypatch.setattr("holosplat_bench.suite.methods.ALIGNED", {})
    monkeypatch.setattr("holosplat_bench.suite.methods.REFERENCES", {})
    monkeypatch.setattr("holosplat_bench.suite.case.case_names", lambda: list(SHAPES))

    def load(name, seed, snapshots):
        return replace(make_case("round", seed), name="mine") if name.endswith(".toml") else make_case(name, seed)

    def planned(source, snapshots):
        case = load(source, 0, snapshots)
        return case.exposures, case.is_test

    monkeypatch.setattr("holosplat_bench.suite.case.load_case", load)
    monkeypatch.setattr("holosplat_bench.suite.case.planned_frames", planned)
    return recorder


def test_the_command_runs_lists_and_reports(shop, tmp_path):
    code, out, _ = holosplat("bench", "run", "--list")
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == [
        "cases:",
        "round",
        "wide",
        *MEASURED,
        "methods:",
        "one",
        "two",
    ]
    folder = tmp_path / "bench"
    command = ("bench", "run", "--cases", "round", "wide", "--methods", "two", "--seeds", 3, "--out", folder)
    code, _, err = holosplat(*command)
    assert code == 0, err
    assert "round 3 two: SSIM 0." in err
    assert "(0 to go)" in err
    assert len(BenchFolder(folder).read_rows()) == 2
    assert shop.names == ["two", "two"]
    code, _, err = holosplat("bench", "report", folder)
    assert code == 0, err
    assert (folder / "report.html").is_file()


def test_a_case_of_ones_own_is_a_file(shop, tmp_path):
    holosplat("bench", "run", "--cases", "my_case.toml", "--seeds", 3, "--out", tmp_path / "bench")
    assert {row.case for row in BenchFolder(tmp_path / "bench").read_rows()} == {"mine"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--cases", "main99"), "--cases must be among round, wide, capsule-dome, capsule, tooth, but main99"),
        (("--methods", "magic"), "--methods must be among one, two, but magic"),
        (("--seeds", "-3"), "--seeds must not be negative"),
    ],
)
def test_bad_requests_are_refused_in_one_line(shop, tmp_path, arguments, words):
    code, _, err = holosplat("bench", "run", *arguments, "--out", tmp_path / "bench")
    assert code == 2
    assert words in err
    assert not (tmp_path / "bench").exists()


def test_a_case_whose_name_can_be_no_files_is_refused_before_there_is_a_folder(shop, tmp_path, monkeypatch):
    case = replace(make_case("round", 3), name="my case")
    monkeypatch.setattr("holosplat_bench.suite.case.load_case", lambda name, seed, snapshots: case)
    code, _, err = holosplat("bench", "run", "--cases", "my case.toml", "--out", tmp_path / "bench")
    assert code == 2
    assert "names of cases and methods must be of letters, digits, '-', '_' and '+', but one is 'my case'" in err
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_says_how_to_go_on(shop, tmp_path, monkeypatch):
    stopped = {"one": shop.method("one"), "two": shop.method("two", fail(KeyboardInterrupt()))}
    monkeypatch.setattr("holosplat_bench.suite.methods.METHODS", stopped)
    code, _, err = holosplat("bench", "run", "--cases", "round", "--out", tmp_path / "bench")
    assert code == 130
    assert "the same command goes on" in err
    assert [row.method for row in BenchFolder(tmp_path / "bench").read_rows()] == ["one"]


def test_the_commit_is_that_of_the_source_tree(monkeypatch, tmp_path):
    root = Path(__file__).resolve().parents[2]  # tests/bench and src/holosplat lie in one tree
    assert bool(version.source_commit()) == (root / ".git").exists()
    monkeypatch.setattr(version, "__file__", str(tmp_path / "a/b/version.py"))
    assert version.source_commit.__wrapped__() == ""
