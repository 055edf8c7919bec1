"""The thesis' study: its looks and files, what an interruption leaves, its report and command."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.fit.loop import Fit
from holosplat.materials import HAEMOGLOBIN
from holosplat_bench.cli import bench as command
from holosplat_bench.suite import case as bench_case
from holosplat_bench.suite.pages.page import as_markdown, escaped
from holosplat_bench.thesis import study as thesis_study
from holosplat_bench.thesis.configurations import EVERY, PACES, THESIS_TABLE, Measured, Pace
from holosplat_bench.thesis.findings import findings
from holosplat_bench.thesis.folder import CURVES, StudyFolder, load_study
from holosplat_bench.thesis.pages import page as report
from holosplat_bench.thesis.pages.page import LINES, PICTURES, page_of, pictures, write_study
from holosplat_bench.thesis.study import run_study

SMALL = replace(THESIS_TABLE[1], count=60, threshold=1.0, amplitude_rate=0.1)
"""Fast amplitudes, and no growth, so that 12 steps fit something."""
QUICK = Pace("quick", 2500)
"""12 steps, a look at each."""


def test_a_configuration_leaves_its_curves_its_maps_and_its_row(measured, tmp_path):
    folder, seen = StudyFolder(tmp_path / "study"), []
    run_study(measured, [SMALL], QUICK, 5, folder, lambda *report: seen.append(report))
    study = load_study(folder)
    curves, row, maps = study.curves["8k-v4"], study.rows["8k-v4"], study.maps["8k-v4"]
    assert tuple(curves) == CURVES
    np.testing.assert_array_equal(curves["step"], np.arange(13))
    assert row["status"] == "done"
    assert row["last"]["test_ssim"] == curves["test_ssim"][-1]
    assert row["best"]["test_frcm"] == curves["test_frcm"].max()
    assert row["configuration"]["count"] == 60
    assert curves["train_l1"][-1] < curves["train_l1"][0], "it fits"
    assert np.isnan(curves["loss"][0])
    assert (curves["loss"][1:] > 0).all()
    true = study.about["true_delta"] / study.about["true_beta"]
    assert true == pytest.approx(HAEMOGLOBIN.delta_beta(20.0).ratio, rel=1e-5)
    assert study.about["true_delta"] > 0.5 * HAEMOGLOBIN.delta_beta(20.0).delta
    assert [name for name, _, _ in seen] == ["8k-v4"] * 12
    assert seen[-1][1] == 1.0
    assert maps["steps"].tolist() == [0, 1, 2, 3, 6, 12]
    assert maps["lines"].shape == (6, 2, 15, 22)
    assert maps["slice"].shape == maps["true_slice"].shape == measured.truth.delta.shape[1:]
    matter = 2 * 4 / 3 * np.pi * 3e-6**3 * HAEMOGLOBIN.delta_beta(20.0).delta
    k = 2 * np.pi * 20.0 / 12.398e-10
    assert maps["true_lines"][0].sum() * 1e-12 == pytest.approx(k * matter, rel=0.05), "∫∫k∫δ of two balls"
    config = json.loads((folder.path / "8k-v4.config.json").read_text())
    assert config["recipe"]["fit"]["rates"]["centres"] == pytest.approx(1.6e-4 * 11)
    assert not list(folder.path.glob("*.checkpoint.pt"))


def test_held_out_frames_judge_only(measured, tmp_path):
    """Other held-out frames change the curves' test scores, and nothing else."""
    frames = measured.scan.frames.copy()
    frames[measured.scan.is_test] = np.roll(frames[measured.scan.is_test], 3, axis=1)
    others = replace(measured, scan=replace(measured.scan, frames=frames))
    folders = [StudyFolder(tmp_path / name) for name in ("one", "two")]
    for scene, folder in zip((measured, others), folders):
        run_study(scene, [SMALL], QUICK, 5, folder)
    one, two = (load_study(folder).curves["8k-v4"] for folder in folders)
    for key in CURVES:
        same = np.array_equal(one[key], two[key], equal_nan=True)
        assert same != key.startswith("test_") or key == "seconds", key


def test_an_interrupted_study_goes_on_as_if_nothing_had_happened(measured, tmp_path, few, monkeypatch):
    """Growth and pruning lie on either side of the interruption; files are the same, but for the seconds."""
    whole, cut, pace = StudyFolder(tmp_path / "whole"), StudyFolder(tmp_path / "cut"), Pace("quick", 2000)
    eager = replace(few[1], count=60, threshold=1e-6)
    run_study(measured, [eager], pace, 5, whole)
    monkeypatch.setattr(thesis_study, "SAVE_EVERY_S", 0.0)

    def interrupt(name, fraction, record):
        if fraction > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(measured, [eager], pace, 5, cut, interrupt)
    monkeypatch.undo()
    assert (cut.path / "8k-v4.checkpoint.pt").is_file()
    steps = []
    run_study(measured, [eager], pace, 5, cut, lambda name, fraction, record: steps.append(record["step"]))
    assert steps[0] == 7, "it goes on, and does not start anew"
    one, two = (load_study(folder) for folder in (whole, cut))
    assert one.curves["8k-v4"]["count"].max() > 60, "it grew"
    for key in set(CURVES) - {"seconds"}:
        np.testing.assert_array_equal(one.curves["8k-v4"][key], two.curves["8k-v4"][key], err_msg=key)
    for key, values in one.maps["8k-v4"].items():
        np.testing.assert_array_equal(values, two.maps["8k-v4"][key], err_msg=key)
    run_study(measured, [eager], pace, 5, cut, lambda *seen: pytest.fail("what is finished is skipped"))


def test_a_damaged_checkpoint_starts_the_configuration_anew(measured, tmp_path):
    folder = StudyFolder(tmp_path)
    run_study(measured, [], QUICK, 5, folder)
    (tmp_path / "8k-v4.checkpoint.pt").write_bytes(b"half a check")
    run_study(measured, [SMALL], QUICK, 5, folder)
    assert len(load_study(folder).curves["8k-v4"]["step"]) == 13


def test_a_fit_that_diverges_is_a_result(measured, tmp_path, monkeypatch):
    work = Fit._work
    monkeypatch.setattr(Fit, "_work", lambda fit, batch: work(fit, batch) * (math.nan if fit.step == 6 else 1))
    folder = StudyFolder(tmp_path)
    run_study(measured, [SMALL], QUICK, 5, folder)
    row = load_study(folder).rows["8k-v4"]
    assert (row["status"], row["diverged_at"], row["last"]["step"]) == ("diverged", 7, 6)
    assert "8k-v4 (diverged at step 7)" in as_markdown(page_of(load_study(folder)), tmp_path)


def test_a_folder_of_something_else_or_of_another_study_is_refused(measured, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"must be new or empty, but .* a study to go on with"):
        run_study(measured, [SMALL], QUICK, 5, StudyFolder(tmp_path))
    with pytest.raises(InputError, match="must lie in an existing folder"):
        run_study(measured, [SMALL], QUICK, 5, StudyFolder(tmp_path / "no" / "where"))
    folder = StudyFolder(tmp_path / "study")
    with pytest.raises(InputError, match="must hold a finished configuration"):
        load_study(folder)
    run_study(measured, [], QUICK, 5, folder)
    for key, other in {"seed": (measured, QUICK, 6), "pace": (measured, Pace("quick", 2400), 5)}.items():
        with pytest.raises(InputError, match=f"another {key}"):
            run_study(other[0], [SMALL], other[1], other[2], folder)
    with pytest.raises(InputError, match="another physics"):
        run_study(replace(measured, physics="far"), [SMALL], QUICK, 5, folder)
    run_study(measured, [SMALL], QUICK, 5, folder)
    (folder.path / "8k-v4.maps.npz").write_bytes(b"no maps")
    with pytest.raises(InputError, match=r"8k-v4.maps.npz must be the maps of a study"):
        load_study(folder)
    (folder.path / "8k-v4.curves.csv").write_text("step,seconds\n1,2\n")
    with pytest.raises(InputError, match=r"8k-v4.curves.csv must be the curves of a study"):
        load_study(folder)


# --- report and command -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study_of_all(measured, few, tmp_path_factory) -> StudyFolder:
    """A finished study of the thesis' eight."""
    folder = StudyFolder(tmp_path_factory.mktemp("study"))
    run_study(measured, few, Pace("quickest", 6000), 5, folder)
    return folder


def test_the_report_says_what_the_files_say(study_of_all, tmp_path):
    study = load_study(study_of_all)
    html, markdown, *drawn = write_study(study, tmp_path)
    page = html.read_text()
    assert "http" not in page.replace("http://www.w3.org", ""), "self-contained"
    assert all(f"{row['last']['test_ssim']:.3f}" in page for row in study.rows.values())
    text = markdown.read_text()
    rows = [line for line in text.splitlines() if line.startswith(("| 8k", "| 32k", "| 98k", "| 244k"))]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == [c.name for c in THESIS_TABLE]
    for finding in findings(study):
        assert f"| {' | '.join(map(escaped, (finding.claim, finding.verdict, finding.evidence)))} |" in text
    assert [path.name for path in drawn] == [picture.file for picture in PICTURES]
    assert all(path.read_bytes().startswith(b"\x89PNG") and f"({path.name})" in text for path in drawn)


def test_without_maps_there_are_fewer_pictures(study_of_all):
    study = load_study(study_of_all)
    assert pictures(study) == list(PICTURES)
    assert [picture.file for picture in pictures(replace(study, maps={}))] == ["thesis_curves.png", "thesis_psnr.png"]


def test_the_command_runs_and_reports(measured, tmp_path, monkeypatch, few, capsys):
    asked, reported = [], []
    monkeypatch.setattr("holosplat_bench.thesis.configurations.EVERY", few)
    monkeypatch.setattr(bench_case, "load_case", lambda *wanted: asked.append(wanted) or measured, raising=False)
    monkeypatch.setattr(Measured, "of", lambda case, physics: asked.append(physics) or case)
    monkeypatch.setattr(report, "write_study", lambda study, path: reported.append(list(study.rows)) or [path])
    monkeypatch.setitem(PACES, "short", QUICK)
    command.thesis(tmp_path / "study", configurations=("8k-v1",), case="thesis8", physics="far", seed=5)
    assert asked == [("thesis8", 5, None), "far"]
    assert reported == [["8k-v1"]]
    assert f"wrote {tmp_path / 'study'}" in capsys.readouterr().err

    def interrupt(*wanted):
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat_bench.thesis.study.run_study", interrupt)
    with pytest.raises(SystemExit) as left:
        command.thesis(tmp_path / "study", seed=5)
    assert left.value.code == 130
    assert "goes on from there" in capsys.readouterr().err


def test_configurations_are_drawn_apart():
    names = [c.name for c in EVERY]
    assert list(LINES) == names
    assert len(set(LINES.values())) == len(names)
