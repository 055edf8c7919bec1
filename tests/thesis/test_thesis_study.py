"""The thesis' study: its configurations in our units, its looks and files, the rules of its verdicts, its report."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from holosplat.bench import case as bench_case
from holosplat.bench.case import Case
from holosplat.checks import InputError
from holosplat.cli import thesis as command
from holosplat.fit.loop import DivergedError, Fit
from holosplat.geometry import Grid, Views
from holosplat.materials import HAEMOGLOBIN, WATER
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import gaussian_fit
from holosplat.methods.presets import preset
from holosplat.scan import Exposures, interleaved_split
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.thesis import pages as report
from holosplat.thesis import study as thesis_study
from holosplat.thesis.findings import (
    findings,
    frcm_peaks_early,
    low_frcm,
    low_ratio,
    more_gaussians_hurt,
    psnr_misleads,
)
from holosplat.thesis.pages import LINES, study_markdown, write_study
from holosplat.thesis.study import (
    CURVES,
    EXTRA,
    PACES,
    THESIS_TABLE,
    Configuration,
    Measured,
    Pace,
    Study,
    StudyFolder,
    configurations,
    load_study,
    mean_inside,
    random_start,
    run_study,
)
from holosplat.volume import Volume

PIXEL = 1e-6
SHAPE = (15, 22)
SMALL = replace(THESIS_TABLE[1], count=60)
QUICK = Pace("quick", 2500)
"""12 steps, a look at each."""


@pytest.fixture(scope="module")
def measured() -> Measured:
    """Two balls in six training and two held-out views of 15 × 22 pixels."""
    sphere, faces = icosphere(2)
    balls = [TriangleMesh(3e-6 * sphere + np.array([x, 0, 0]), faces, "ball") for x in (-5e-6, 5e-6)]
    material = HAEMOGLOBIN.delta_beta(20.0)
    exposures = Exposures.of(Views.evenly_spaced(8, SHAPE, PIXEL), 20.0, 0.05)
    scene = MeshScene.of_one_material(balls, material)
    case = Case("two balls", 3, scene, exposures, interleaved_split(8), MaterialPrior.unknown())
    return Measured.of(case)


@pytest.fixture
def small(monkeypatch):
    """The thesis' eight configurations with few Gaussians."""
    table = tuple(replace(c, count=max(40, c.count // 1000)) for c in THESIS_TABLE)
    monkeypatch.setattr(thesis_study, "THESIS_TABLE", table)
    return table


# --- what the thesis says, in our units ---------------------------------------------------------------------


def test_the_eight_configurations_are_those_of_the_thesis():
    assert [(c.count, c.views) for c in THESIS_TABLE] == [
        *((8_000, 1), (8_000, 4), (8_000, 8)),
        *((32_000, 4), (98_000, 4), (244_000, 4)),
        *((8_000, 4), (8_000, 4)),
    ]
    assert [c.position_rate for c in THESIS_TABLE] == [1.6e-4] * 6 + [3.2e-4, 1.6e-4]
    assert [c.shape_rate for c in THESIS_TABLE] == [1e-3] * 7 + [2e-3]


def test_rates_are_translated_to_detector_pixels():
    """In the thesis' cube [-1, 1]³ half the detector's width is 1."""
    rates = PACES["full"].options(configurations(["8k-v4-position"])[0], width_px=96).rates
    assert rates.centres == pytest.approx(3.2e-4 * 48)
    rates = PACES["full"].options(configurations(["8k-v4-shape"])[0], width_px=128).rates
    assert (rates.log_scales, rates.quaternions) == (2e-3, 2e-3)
    assert rates.centres == pytest.approx(preset("thesis").fit.rates.centres, rel=0.03)


@pytest.mark.parametrize(("name", "steps", "warmup", "every"), [("full", 30_000, 1000, 500), ("short", 3000, 100, 50)])
def test_the_schedule_is_that_of_the_thesis_or_ten_times_shorter(name, steps, warmup, every):
    options = PACES[name].options(THESIS_TABLE[0], 96)
    schedule, density = options.schedule, options.density
    assert (schedule.steps, schedule.warmup_steps, schedule.views_per_step) == (steps, warmup, 1)
    assert schedule.validation_views == 0, "no training view is taken away to judge"
    assert density.every == every
    events = [step for step in range(steps) if density.due(step, steps)]
    assert (events[0] + 1, events[-1] + 1) == (steps // 10, steps // 2), "3000 to 15000 of 30000"
    assert PACES[name].look_every % every != 0, "most looks do not fall on an event of density control"


def test_the_worst_views_of_a_batch_do_not_learn_unless_asked():
    rule = {c.name: PACES["full"].options(c, 96).schedule.detach_worst for c in (*THESIS_TABLE, *EXTRA)}
    assert [name for name, holds in rule.items() if not holds] == ["8k-v4-all-learn"]


def test_unknown_configurations_and_paces_are_refused():
    assert configurations() == THESIS_TABLE
    assert [c.name for c in configurations(["8k-v8", "8k-v1", "8k-v8"])] == ["8k-v8", "8k-v1"]
    with pytest.raises(InputError, match=r"one of 8k-v1, .*8k-v4-one-unit, but it is '9k'"):
        configurations(["9k"])
    with pytest.raises(InputError, match="shortened must be at least 1, but it is 0"):
        Pace("none", 0)


def test_the_random_start_is_faint_uniform_and_without_prior():
    views = Views.evenly_spaced(4, (31, 64), PIXEL)
    cloud = random_start(replace(SMALL, count=4000), views, 20.0, seed=1)
    half = np.array([32, 15.5, 32])
    centres = cloud.centres.numpy() / half
    assert np.abs(centres).max() <= 1
    np.testing.assert_allclose(centres.mean(0), 0, atol=0.04)
    np.testing.assert_allclose(centres.var(0), 1 / 3, rtol=0.06)  # of a uniform distribution on [-1, 1]
    water = WATER.delta_beta(20.0)
    volume = cloud.voxelise(Grid.centred((24, 12, 24), PIXEL))
    assert float(volume.delta.mean()) == pytest.approx(0.01 * water.delta, rel=0.1, abs=0)
    assert float(volume.beta.mean()) == pytest.approx(0.01 * water.beta, rel=0.1, abs=0)
    same, other = (random_start(replace(SMALL, count=4000), views, 20.0, seed) for seed in (1, 2))
    assert same.centres.equal(cloud.centres)
    assert not other.centres.equal(cloud.centres)


def test_one_unit_starts_delta_and_beta_alike():
    views = Views.evenly_spaced(4, SHAPE, PIXEL)
    volume = random_start(replace(SMALL, one_unit=True), views, 20.0, 0).voxelise(Grid.of_views(views))
    np.testing.assert_allclose(volume.delta, volume.beta, rtol=1e-6)


def test_means_inside_are_weighted_by_true_matter():
    grid = Grid.centred((1, 1, 3), PIXEL)
    truth = Volume(np.array([[[0.0, 1.0, 3.0]]]), np.zeros((1, 1, 3)), grid)
    found = Volume(np.array([[[9.0, 2.0, 4.0]]]), np.array([[[9.0, 0.0, 8.0]]]), grid)
    assert mean_inside(found, truth) == pytest.approx((0.25 * 2 + 0.75 * 4, 0.75 * 8))


# --- runs ---------------------------------------------------------------------------------------------------


def test_a_configuration_leaves_its_curves_and_its_row(measured, tmp_path):
    folder, seen = StudyFolder(tmp_path / "study"), []
    run_study(measured, [SMALL], QUICK, 5, folder, lambda *report: seen.append(report))
    study = load_study(folder)
    curves, row = study.curves["8k-v4"], study.rows["8k-v4"]
    assert tuple(curves) == CURVES
    np.testing.assert_array_equal(curves["step"], np.arange(13))
    assert row["status"] == "done"
    assert row["last"]["test_ssim"] == curves["test_ssim"][-1]
    assert row["configuration"]["count"] == 60
    assert curves["train_l1"][-1] < curves["train_l1"][0], "it fits"
    true = study.about["true_delta"] / study.about["true_beta"]
    assert true == pytest.approx(HAEMOGLOBIN.delta_beta(20.0).ratio, rel=1e-5)
    assert study.about["true_delta"] > 0.5 * HAEMOGLOBIN.delta_beta(20.0).delta
    assert [name for name, _, _ in seen] == ["8k-v4"] * 12
    assert seen[-1][1] == 1.0
    config = json.loads((folder.path / "8k-v4.config.json").read_text())
    assert config["fit"]["rates"]["centres"] == pytest.approx(1.6e-4 * 11)


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
        same = np.array_equal(one[key], two[key])
        assert same != key.startswith("test_") or key == "seconds", key


def test_finished_configurations_are_skipped_and_interrupted_ones_start_anew(measured, tmp_path, small):
    folder = StudyFolder(tmp_path)

    def interrupt(name, fraction, record):
        if name == "8k-v8" and fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(measured, small[:4], QUICK, 5, folder, interrupt)
    assert list(load_study(folder).rows) == ["8k-v1", "8k-v4"]
    with (tmp_path / "8k-v8.curves.csv").open() as file:
        assert 0 < len(list(csv.reader(file))) < 13, "what was seen so far is kept"
    ran = []
    run_study(measured, small[:4], QUICK, 5, folder, lambda name, *_: ran.append(name))
    assert set(ran) == {"8k-v8", "32k-v4"}
    assert len(load_study(folder).curves["8k-v8"]["step"]) == 13


def test_a_fit_that_diverges_is_a_result(measured, tmp_path, monkeypatch):
    work = Fit._work
    monkeypatch.setattr(Fit, "_work", lambda fit, batch: work(fit, batch) * (math.nan if fit.step == 6 else 1))
    folder = StudyFolder(tmp_path)
    run_study(measured, [SMALL], QUICK, 5, folder)
    row = load_study(folder).rows["8k-v4"]
    assert (row["status"], row["diverged_at"], row["last"]["step"]) == ("diverged", 7, 6)
    assert "8k-v4 (diverged at step 7)" in study_markdown(load_study(folder), [])


def test_the_loop_raises_what_the_study_catches(measured):
    options = QUICK.options(SMALL, SHAPE[1])
    wild = replace(options, rates=replace(options.rates, raw_amplitudes=1e38))
    fit = gaussian_fit(measured.scan.train(), random_start(SMALL, measured.scan.views, 20.0, 0), wild, 0)
    with pytest.raises(DivergedError, match="diverged at step") as caught:
        fit.run(lambda record: None)
    assert 1 <= caught.value.step <= 12


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
    with pytest.raises(InputError, match="another seed"):
        run_study(measured, [SMALL], QUICK, 6, folder)
    with pytest.raises(InputError, match="another pace"):
        run_study(measured, [SMALL], Pace("quick", 2400), 5, folder)
    run_study(measured, [SMALL], QUICK, 5, folder)
    (folder.path / "8k-v4.curves.csv").write_text("step,seconds\n1,2\n")
    with pytest.raises(InputError, match=r"8k-v4.curves.csv must hold a study's curves"):
        load_study(folder)


# --- verdicts -----------------------------------------------------------------------------------------------

LOOKS = 20


def invented(**columns) -> Study:
    """A study of the eight configurations whose curves all rise, but for `columns`: name → [looks] or (8 × [looks])."""
    rise = np.linspace(0.1, 0.9, LOOKS)
    rows, curves = {}, {}
    for index, configuration in enumerate(THESIS_TABLE):
        curve = dict.fromkeys(CURVES, rise + 0.001 * index)
        curve |= {"step": np.arange(LOOKS) * 100.0, "test_psnr": 10 + 20 * rise + 0.1 * index}
        curve |= {"ratio": np.full(LOOKS, 2800.0)}
        for name, values in columns.items():
            curve[name] = np.asarray(values[index] if len(values) == len(THESIS_TABLE) else values, dtype=float)
        curves[configuration.name] = curve
        last = {key: float(column[-1]) for key, column in curve.items()}
        rows[configuration.name] = {"status": "done", "diverged_at": None, "steps": 1900, "last": last}
    return Study({"warmup_steps": 150, "true_delta": 2.8e-7, "true_beta": 1e-10}, rows, curves)


def test_psnr_misleads_only_where_it_does_not_rank_as_the_others_do():
    rise = np.linspace(0, 1, LOOKS)
    assert psnr_misleads(invented()).verdict == "does not reproduce"
    falling = invented(test_frcm=1 - rise)
    assert psnr_misleads(falling).verdict == "reproduces"
    assert "−1.00 with FRCM" in psnr_misleads(falling).evidence
    dip = np.where((rise > 0.3) & (rise < 0.5), 9.0, 10 + 20 * rise)
    hidden = invented(test_psnr=[dip + 0.1 * k * (rise > 0) for k in range(8)])
    assert psnr_misleads(hidden).verdict == "reproduces in part"
    assert "has 10.0 dB; looks of an FRCM up to 0.49 have no more" in psnr_misleads(hidden).evidence
    crossed = invented(test_psnr=[10 + (20 - k) * rise for k in range(8)])
    assert psnr_misleads(crossed).verdict == "reproduces", "the configurations of less PSNR have more FRCM at the end"


def test_more_gaussians_hurt_only_where_the_ends_say_so():
    def ends(drop):
        steps = dict(zip((8, 32, 98, 244), range(4)))
        counts = [steps[c.count // 1000] for c in THESIS_TABLE]
        return [np.linspace(0, 0.9 - drop * k, LOOKS) for k in counts]

    assert more_gaussians_hurt(invented()).verdict == "does not reproduce"
    assert more_gaussians_hurt(invented(dice=ends(0.005))).verdict == "does not reproduce", "within the margin"
    assert more_gaussians_hurt(invented(dice=ends(0.05))).verdict == "reproduces in part"
    both = more_gaussians_hurt(invented(dice=ends(0.05), test_frcm=ends(0.1)))
    assert both.verdict == "reproduces"
    assert "FRCM 0.900 (8k), 0.800 (32k), 0.700 (98k), 0.600 (244k)" in both.evidence


def test_frcm_peaks_early_only_where_it_falls_again():
    rise = np.linspace(0, 1, LOOKS)
    early = np.where(rise < 0.3, rise, 0.3 - 0.3 * (rise - 0.3))
    assert frcm_peaks_early(invented()).verdict == "does not reproduce"
    assert frcm_peaks_early(invented(test_frcm=early)).verdict == "reproduces"
    assert frcm_peaks_early(invented(test_frcm=[early, early, *[rise] * 6])).verdict == "reproduces in part"
    dip = frcm_peaks_early(invented(test_frcm=rise - 0.3 * (np.abs(rise - 0.4) < 0.1)))
    assert dip.verdict == "reproduces in part", "it falls, and recovers"
    assert "from a peak in the first half is 0.142" in dip.evidence
    shock = frcm_peaks_early(invented(test_frcm=rise - 0.3 * (np.arange(LOOKS) == 8)))
    assert shock.verdict == "does not reproduce", "one look where Gaussians were just split"
    late = frcm_peaks_early(invented(test_frcm=rise - 0.3 * (rise > 0.9)))
    assert late.verdict == "does not reproduce", "it falls, but late"
    assert frcm_peaks_early(invented(test_frcm=0.9 - 0.01 * rise)).verdict == "does not reproduce", "within the margin"


def test_the_thesis_levels_and_its_ratio():
    assert low_frcm(invented()).verdict == "does not reproduce"
    assert low_frcm(invented(test_frcm=np.full(LOOKS, 0.1))).verdict == "reproduces"
    assert low_ratio(invented()).verdict == "does not reproduce"
    assert low_ratio(invented(ratio=np.full(LOOKS, 28.0))).verdict == "reproduces"
    assert low_ratio(invented(ratio=np.full(LOOKS, 1e5))).verdict == "does not reproduce", "wrong the other way"
    mixed = low_ratio(invented(ratio=[np.full(LOOKS, r) for r in (28.0, *[2800.0] * 7)]))
    assert mixed.verdict == "reproduces in part"
    assert "between 28 (100.0 times too small, 8k-v1) and 2,800 (1.0 times too large, 8k-v4)" in mixed.evidence


def test_what_was_not_run_cannot_be_judged():
    study = invented()
    for curve in study.curves.values():
        for key in CURVES:
            curve[key] = curve[key][:2]
    study.rows.clear()
    assert {finding.verdict for finding in findings(study)} == {"cannot be judged"}


# --- report and command -------------------------------------------------------------------------------------


def test_the_report_says_what_the_files_say(measured, tmp_path, small):
    folder = StudyFolder(tmp_path)
    run_study(measured, small, QUICK, 5, folder)
    study = load_study(folder)
    html, markdown, *pictures = write_study(study, tmp_path)
    page = html.read_text()
    assert "http" not in page.replace("http://www.w3.org", ""), "self-contained"
    assert all(f"{row['last']['test_ssim']:.3f}" in page for row in study.rows.values())
    text = markdown.read_text()
    rows = [line for line in text.splitlines() if line.startswith(("| 8k", "| 32k", "| 98k", "| 244k"))]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == [c.name for c in THESIS_TABLE]
    for finding in findings(study):
        assert f"| {finding.claim} | {finding.verdict} | {finding.evidence} |" in text
    assert all(picture.read_bytes().startswith(b"\x89PNG") and f"({picture.name})" in text for picture in pictures)


def test_the_command_runs_and_reports(measured, tmp_path, monkeypatch, small, capsys):
    asked, reported = [], []
    monkeypatch.setattr(bench_case, "load_case", lambda *wanted: asked.append(wanted) or measured, raising=False)
    monkeypatch.setattr(Measured, "of", lambda case: case)
    monkeypatch.setattr(report, "write_study", lambda study, path: reported.append(list(study.rows)) or [path])
    monkeypatch.setitem(PACES, "short", QUICK)
    command.thesis(tmp_path / "study", configurations=("8k-v1",), seed=5)
    assert asked == [("thesis16", 5, None)]
    assert reported == [["8k-v1"]]
    assert f"wrote {tmp_path / 'study'}" in capsys.readouterr().err

    def interrupt(*wanted):
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat.thesis.study.run_study", interrupt)
    with pytest.raises(SystemExit) as left:
        command.thesis(tmp_path / "study", seed=5)
    assert left.value.code == 130
    assert "goes on behind them" in capsys.readouterr().err


def test_configurations_are_drawn_apart():
    names = [c.name for c in (*THESIS_TABLE, *EXTRA)]
    assert list(LINES) == names
    assert len(set(LINES.values())) == len(names)
    assert all(isinstance(c, Configuration) for c in EXTRA)


def test_the_preset_random_starts_at_random_and_judges_on_no_training_frame():
    settings = preset("random")
    assert settings.start == "random"
    assert settings.fit.schedule.validation_views == 0
    assert settings.fit.density.every > 0
    assert settings.random_count <= 10_000
