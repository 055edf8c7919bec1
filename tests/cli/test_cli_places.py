"""Outputs of commands: no file that the command reads, none twice, none among the files of a run."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest

from helpers.cli import holosplat
from holosplat.cli import series
from holosplat.cli.entry import COMMANDS, command
from holosplat.cli.places import is_run, is_written
from holosplat.ranges import hints_of
from holosplat_bench.cli import bench

pytestmark = pytest.mark.usefixtures("unjudged_runs")

BEAM = ["--detector", "8", "9", "--views", "2"]
READS = "must not be what the command reads"
INSIDE = "must be outside of run folders"
TWICE = "must be different places"
ONES = "must not replace a file of the folder"

WAYS: dict[str, tuple[list[str], str]] = {
    "render: the scan": (["render", "run", "--scan", "a", "--out", "a"], READS),
    "render: an object of the run": (["render", "run", "--scan", "a", "--out", "run/object.h5"], INSIDE),
    "render: a new file in the run": (["render", "run", "--scan", "a", "--out", "run/new.nxs"], INSIDE),
    "export: volume": (["export", "run", "--volume", "run/object.h5"], INSIDE),
    "export: compact": (["export", "run", "--compact", "run/object.h5"], INSIDE),
    "export: splats": (["export", "run", "--splats", "run/object.h5"], INSIDE),
    "export: bodies": (["export", "run", "--bodies", "run/bodies/deeper"], INSIDE),
    "export: another run": (["export", "none", "--compact", "c", "--together", "a", "--volume", "a"], READS),
    "export: twice": (["export", "run", "--volume", "x.h5", "--compact", "x.h5"], TWICE),
    "export: times": (["export", "run", "--volume", "x_t0000.h5", "--compact", "x.h5"], TWICE),
    "simulate: the mesh": (["simulate", "b", "a", *BEAM, "--out", "a"], READS),
    "simulate: a link to it": (["simulate", "a", *BEAM, "--out", "link"], READS),
    "simulate: truth": (["simulate", "a", *BEAM, "--out", "c", "--truth", "a"], READS),
    "simulate: true exposures": (["simulate", "a", *BEAM, "--out", "c", "--true-exposures", "./a"], READS),
    "simulate: materials": (["simulate", "a", *BEAM, "--out", "b", "--materials", "b"], READS),
    "simulate: spectrum": (["simulate", "a", *BEAM, "--out", "b", "--spectrum", "b"], READS),
    "simulate: rotations": (["simulate", "a", "--detector", "8", "9", "--rotations", "b", "--out", "b"], READS),
    "simulate: exposures": (["simulate", "a", "--detector", "8", "9", "--exposures", "b", "--out", "b"], READS),
    "simulate: twice": (["simulate", "a", *BEAM, "--out", "c", "--truth", "c"], TWICE),
    "simulate: in a run": (["simulate", "a", *BEAM, "--out", "run/c"], INSIDE),
    "calibrate: the phantom": (["calibrate", "a", "--phantom", "b", "--material", "H2O", "--out", "b"], READS),
    "calibrate: the scan": (["calibrate", "a", "--phantom", "b", "--material", "H2O", "--out", "a"], READS),
    "calibrate: angles": (["calibrate", "a", "--beads", "1e-6", "--angles", "b", "--out", "b"], READS),
    "align: exposures": (["align", "a", "--exposures", "b", "--out", "b"], READS),
    "align: the scan": (["align", "a", "--out", "c", "--table", "a"], READS),
    "align: table twice": (["align", "a", "--out", "c", "--table", "c"], TWICE),
    "align: geometry twice": (["align", "a", "--out", "c", "--table", "d", "--geometry-out", "d"], TWICE),
    "align: of a folder": (["align", "folder", "--out", "folder/frames.tif"], ONES),
    "align: flats": (["align", "a", "--flats", "folder", "--out", "folder/frames.tif"], ONES),
    "retrieve: the scan": (["retrieve", "a.h5", "--out", "a.h5"], READS),
    "record: truth": (["record", "a", "--out", "c", "--truth", "a"], READS),
    "record: twice": (["record", "a", "--out", "c", "--truth", "c"], TWICE),
    "correct: darks": (["correct", "a", "--darks", "b", "--out", "b"], READS),
    "join: the second": (["join", "a", "b", "--out", "b"], READS),
    "join: exposures": (["join", "a", "a", "--exposures", "b", "--out", "b"], READS),
    "convert: truth": (["convert", "a", "b", "--to", "r2-gaussian", "--truth", "b"], READS),
    "convert: itself": (["convert", "folder", "folder", "--to", "tiff"], READS),
    "plan: the mesh": (["plan", "--mesh", "a", "--energy-range", "10", "20", "--out", "a"], READS),
    "reconstruct: options": (["reconstruct", "a", "--config", "b", "--out", "b"], READS),
    "reconstruct: weights": (["reconstruct", "a", "--set", "weights=b", "--out", "b"], READS),
    "reconstruct: itself": (["reconstruct", "run", "--out", "run", "--resume"], READS),
    "reconstruct: in a run": (["reconstruct", "a", "--out", "run/inner"], INSIDE),
    "track: the body": (["track", "a", "--body", "b", "--out", "b"], READS),
    "track: in a run": (["track", "a", "--out", "run/inner"], INSIDE),
    "forecast: in the run": (["forecast", "run", "--out", "run/later"], INSIDE),
    "surface: in the run": (["surface", "run", "--out", "run/surfaces"], INSIDE),
    "grow: in a run": (["grow", "--out", "run/cells"], INSIDE),
    "demo: in a run": (["demo", "--out", "run/demo"], INSIDE),
    "dataset: in a run": (["dataset", "--out", "run/scenes"], INSIDE),
    "train: the scenes": (["train", "folder", "--out", "folder"], READS),
    "watch: the folder": (["watch", "folder", "--out", "folder"], READS),
    "series: a scan": (["series", "plan", "a", "b", "--out", "b"], READS),
    "series: in a run": (["series", "plan", "a", "--out", "run/series"], INSIDE),
    "bench: a case": (["bench", "run", "--cases", "case.toml", "--out", "case.toml"], READS),
    "bench: in a run": (["bench", "run", "--out", "run/bench"], INSIDE),
    "compare: the scan of a run": (["compare", "run", "run", "--out", "a", "--force"], READS),
    "simulate: β": (["simulate", "v.mrc", *BEAM, "--out", "c", "--truth", "v.beta.mrc", "--force"], READS),
    "simulate: β twice": (["simulate", "a", *BEAM, "--out", "n.beta.mrc", "--truth", "n.mrc"], TWICE),
    "info: whence a file comes": (["info", "a.png.provenance.json", "--picture", "a.png"], READS),
    "a log in a run": (["info", "a", "--log", "run/new.log"], INSIDE),
    "thesis: snapshots": (["bench", "thesis", "--snapshots", "folder", "--out", "folder"], READS),
}


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """Two files, a link, a folder with a file, and a run."""
    monkeypatch.chdir(tmp_path)
    more = ("v.mrc", "v.beta.mrc", "a.png.provenance.json", "folder/frames.tif", "run/config.json", "run/object.h5")
    for name in ("a", "b", "a.h5", "case.toml", *more):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({}))
    (tmp_path / "run/source.json").write_text(json.dumps({"scan": "a"}))
    (tmp_path / "link").symlink_to("a")
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    found = (Path(path, name) for path, _, names in os.walk(folder) for name in names)
    return {str(path): path.read_bytes() for path in found}


@pytest.mark.parametrize("way", WAYS)
def test_what_would_be_lost_is_refused(place, way):
    arguments, said = WAYS[way]
    before = files(place)
    ended = holosplat(*arguments)
    assert ended.code == 2
    assert said in ended.err
    assert files(place) == before


def test_what_loses_nothing_is_not_refused_for_its_place(place):
    """Other files, a folder beside that of a run, a new file within a folder that is read, and settings of one's own
    web page."""
    (place / "page").mkdir()
    (place / "page" / "config.json").write_text("{}")
    assert is_run(place / "run")
    assert not is_run(place / "page")
    for out in ("b", "run2", "page/out", "folder/new"):
        assert not any(said in holosplat("align", "folder", "--out", out).err for said in (READS, INSIDE, TWICE, ONES))
    assert INSIDE not in holosplat("reconstruct", "a", "--out", "run", "--resume", "--config", "run/config.json").err


@pytest.mark.parametrize("where", [".lock", "times/t0000/.lock"])
def test_a_folder_that_another_process_writes_is_not_replaced(place, where):
    lock = place / "other" / where
    lock.parent.mkdir(parents=True)
    lock.write_text(json.dumps({"host": "elsewhere", "process": 1}))
    for name in ("config.json", "object.h5"):
        (place / "other" / name).write_text("{}")
    before = files(place)
    for arguments in (
        ["reconstruct", "a", "--out", "other"],
        ["dataset", "--out", "other"],
        ["grow", "--out", "other"],
    ):
        assert "must have one writer, but process 1 on elsewhere" in holosplat(*arguments, "--force").err
    assert files(place) == before


@pytest.mark.parametrize("out", [".", "/"])
def test_an_output_has_a_name(place, out):
    for arguments in (
        ["convert", "a", out, "--to", "tiff"],
        ["reconstruct", "a", "--out", out],
        ["demo", "--out", out],
    ):
        assert "is a folder without a name" in holosplat(*arguments, "--force").err


def leaves(function: Any) -> Iterator[tuple[str, Any]]:
    """Names and types of all arguments, those of dataclasses in their place."""
    for name, hint in hints_of(function).items():
        kinds = [kind for kind in (hint, *get_args(hint)) if isinstance(kind, type) and dataclasses.is_dataclass(kind)]
        yield from leaves(kinds[0]) if kinds else [(name, hint)]


WRITTEN = {
    "align": {"out", "table", "geometry_out"},
    "backends": set(),
    "check": set(),
    "doctor": set(),
    "evaluate": set(),
    "export": {"volume", "bodies", "compact", "splats"},
    "info": {"picture"},
    "init": set(),
    "materials": set(),
    "run": set(),
    "record": {"out", "truth"},
    "rehearse": set(),
    "simulate": {"out", "truth", "true_exposures", "truth_mesh"},
    "view": set(),
}
"""What commands write; the others, what --out names alone."""


def test_every_option_that_names_what_is_written_is_an_output():
    acts = {name: command(name) for name in COMMANDS if name not in ("series", "bench", "data")}
    acts |= {"plan a series": series.plan, "run a benchmark": bench.run, "thesis": bench.thesis}
    for name, act in acts.items():
        assert {option for option, hint in leaves(act) if is_written(hint)} == WRITTEN.get(name, {"out"}), name
