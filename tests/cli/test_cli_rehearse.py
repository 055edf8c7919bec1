"""`holosplat rehearse`: intervals and verdict on the command line, in summary.json and in the report."""

from __future__ import annotations

import csv
import shutil

import h5py
import numpy as np
import pytest

import holosplat as hs
from helpers.cli import holosplat, refused, worked
from holosplat.io.atomic import read_json, write_json
from holosplat.methods.volume import SmoothVolume
from holosplat.show.parts import LEVEL, likely_surfaces, objects_of
from holosplat.workflows import certainty, rehearsal


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A linear run of four small frames."""
    folder = tmp_path_factory.mktemp("rehearsed")
    water = hs.materials.parse_material("water").delta_beta(20.0)
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(1, (14e-6, 14e-6, 14e-6), 1, 9e-6), water)
    views = hs.Views.evenly_spaced(4, (16, 17), 1e-6)
    hs.write_scan(folder / "scan.nxs", hs.simulate(scene, hs.Exposures.of(views, 20.0, 0.03)))
    out = folder / "run"
    said = worked(
        holosplat("reconstruct", folder / "scan.nxs", "--out", out, "--method", "ctf-tv", "--material", "water")
    )
    assert f"verdict beside them: holosplat rehearse {out}" in said.err
    assert "No rehearsal was made" in (out / "report.html").read_text(encoding="utf-8")
    return out


def test_intervals_are_printed_and_kept(run, monkeypatch):
    monkeypatch.setattr(certainty, "MISTAKES", {})
    said = worked(holosplat("rehearse", run, "--times", 2))
    assert "verdict by 2 rehearsals" in said.out
    assert ", by 2 rehearsals and" in said.out
    assert "Dice: at least" in said.out
    table = read_json(run / "summary.json")["rehearsal"]
    assert table["word"] in said.out
    assert set(table["intervals_of_errors"]) == {"total", "delta", "volume", "centre", "dice", "error", "resolution"}
    assert "Intervals of " in (run / "report.html").read_text(encoding="utf-8")
    assert "Where matter is" in (run / "report.html").read_text(encoding="utf-8")
    worked(holosplat("check", run))
    again = worked(holosplat("rehearse", run, "--times", 2))
    assert again.out == said.out
    about = worked(holosplat("info", run)).out
    assert said.out.splitlines()[0] in about
    assert "Dice: at least" in about
    page = run.parent / "compared.html"
    compared = worked(holosplat("compare", run, run, "--out", page)).out
    trusted = {"consistent": "Both explain", "limited": "as good as its method gets", "wrong": "Trust neither"}
    assert trusted[table["word"]] in compared


def test_a_volume_that_was_told_levels_once_is_rehearsed(run, tmp_path, monkeypatch):
    """As older versions let it be."""
    monkeypatch.setattr(certainty, "MISTAKES", {})
    mine = tmp_path / "run"
    few = ("--method", "volume", "--set", "volume.iterations=4", "--set", "iterations=2", "--material", "water")
    worked(holosplat("reconstruct", run.parent / "scan.nxs", *few, "--out", mine))
    summary = read_json(mine / "summary.json")
    write_json(mine / "summary.json", summary | {"decided": summary["decided"] | {"matter": "levels"}})
    worked(holosplat("rehearse", mine, "--times", 2))


def test_a_page_keeps_the_truth_by_which_the_run_was_evaluated(run, tmp_path, monkeypatch):
    monkeypatch.setattr(certainty, "MISTAKES", {})
    mine, page = tmp_path / "run", tmp_path / "run/report.html"
    shutil.copytree(run, mine)
    done = hs.load_reconstruction(hs.RunFolder(mine))
    hs.write_volume(tmp_path / "truth.h5", done.object.voxelise(hs.Grid.of_views(hs.read(mine).views)))
    said = "a Dice coefficient of 1.000"
    worked(holosplat("evaluate", mine, "--truth", tmp_path / "truth.h5"))
    for there in (True, False):
        assert said in page.read_text(encoding="utf-8")
        worked(holosplat("rehearse", mine, "--times", 2))
        assert (said in page.read_text(encoding="utf-8")) == there
        (tmp_path / "truth.h5").unlink(missing_ok=True)


def test_all_times_of_a_series_are_rehearsed_and_those_that_began_warm_from_their_frames_alone(
    run, tmp_path, monkeypatch
):
    monkeypatch.setattr(certainty, "MISTAKES", {})
    series, rows = tmp_path / "series", tmp_path / "series" / "series.csv"
    scans = [shutil.copy(run.parent / "scan.nxs", tmp_path / name) for name in ("1.nxs", "2.nxs")]
    how = ("--method", "volume", "--material", "water", "--set", "volume.iterations=4")
    worked(holosplat("series", "plan", *scans, "--out", series, *how))
    worked(holosplat("series", "run", series))
    began = []
    real = rehearsal.Again
    monkeypatch.setattr(
        rehearsal, "Again", lambda prior, method, *more: began.append(method) or real(prior, method, *more)
    )
    worked(holosplat("rehearse", series, "--times", 2))
    assert [type(method) for method in began] == [SmoothVolume] * 2
    with rows.open(newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    for row in found:
        said = rehearsal.read_rehearsal(hs.RunFolder(series / row["run"]))
        assert said is not None
        assert row["rehearsed"] == said.word
        assert float(row["dice_at_least"]) == pytest.approx(said.least_dice, rel=1e-5)
        assert float(row["total_low_m3"]) < float(row["total_m3"]) < float(row["total_high_m3"])


def test_the_map_of_matter_is_exported_and_viewed(run, tmp_path, monkeypatch):
    monkeypatch.setattr(certainty, "MISTAKES", {})
    worked(holosplat("rehearse", run, "--times", 2))
    likely = rehearsal.matter_of(hs.RunFolder(run))
    assert likely is not None
    worked(holosplat("export", run, "--volume", tmp_path / "volume.h5", "--shape", 17, 16, 17))
    with h5py.File(tmp_path / "volume.h5") as file:
        assert file["matter"].dtype == np.float32
        assert file["matter"][()] == pytest.approx(likely.values, abs=1e-6)
        assert file["views"][()].max() == 3  # one is held out
    objects, _, slider = objects_of(run)
    assert slider == "shown"
    shown = [label for label in objects if label]
    assert shown == list(likely_surfaces(likely))
    assert shown
    for label in shown:
        level = float(label.split("%")[0].split()[-1]) / 100
        cut = objects[label].voxelise(likely.found.grid).delta >= LEVEL
        assert np.array_equal(cut, likely.values >= np.float32(level))


def test_bad_input_is_refused(run, tmp_path):
    refused(holosplat("rehearse", run, "--times", 1), "times must be 2 rehearsals or more", "1")
    refused(holosplat("rehearse", tmp_path), "must hold a reconstruction")
    broken = tmp_path / "broken"
    shutil.copytree(run, broken)
    write_json(broken / "config.json", read_json(broken / "config.json") | {"prior": {"kind": "none"}})
    refused(holosplat("rehearse", broken, "--times", 2), "config.json")
