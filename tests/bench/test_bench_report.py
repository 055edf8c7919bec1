"""The benchmark's report: who is best, who is beaten, and pages that are whole with much or little in the folder."""

from __future__ import annotations

import math

import pytest

from helpers.bench_rows import failed, results, row
from holosplat_bench.suite.folder import REFERENCE
from holosplat_bench.suite.pages.report import beaten_table, case_table, summary_table, verdict, wins_table
from holosplat_bench.suite.pages.results import BYTES, ERROR, MEASURES, SECONDS, SSIM, beaten

MEAN, RESOLUTION = MEASURES[5], MEASURES[6]


def names(methods) -> list[str]:
    return [method.name for method in methods]


# --- who is best --------------------------------------------------------------------------------------------


def test_the_best_is_the_highest_the_lowest_or_the_nearest_to_zero(tmp_path):
    (case,) = results(tmp_path, [row("fbp", 0.5), row("gaussians", 0.88), row("neural-field", 0.97)])
    assert names(case.best(SSIM)) == ["neural-field"]
    assert names(case.best(ERROR)) == ["neural-field"]
    assert names(case.best(SECONDS)) == ["fbp"]
    assert names(case.best(MEAN)) == ["gaussians"]  # -1 %, the others -20 % and +3.5 %
    assert names(case.best(BYTES)) == ["fbp", "gaussians", "neural-field"]


def test_what_cannot_be_told_apart_in_the_digits_shown_is_best_together(tmp_path):
    (case,) = results(tmp_path, [row("fbp", 0.90001), row("gaussians", 0.90002), row("neural-field", 0.8994)])
    assert names(case.best(SSIM)) == ["gaussians", "fbp"]
    bold = {r[0].text: r[1].best for r in case_table(case).rows}
    assert bold == {"fbp": True, "gaussians": True, "neural-field": False}


def test_references_compete_with_nobody(tmp_path):
    (case,) = results(tmp_path, [row("truth-on-voxels", 1.0, family=REFERENCE), row("fbp", 0.5)])
    assert names(case.best(SSIM)) == ["fbp"]
    first, second = case_table(case).rows
    assert first[0].text == "reference: truth-on-voxels"
    assert not any(cell.best for cell in first)
    assert (first[-2].text, first[-1].text) == ("–", "–")  # its time and size mean nothing
    assert all(cell.best for cell in second[1:])


def test_means_and_spreads_are_over_seeds(tmp_path):
    rows = [row("fbp", quality, seed=seed) for seed, quality in ((1, 0.80), (2, 0.84), (3, 0.88))]
    (case,) = results(tmp_path, rows)
    method = case.method("fbp")
    assert method.mean(SSIM) == pytest.approx(0.84)
    assert method.text(SSIM) == "0.840 ± 0.040"
    assert method.text(MEAN) == "−3.0 ± 2.0 %"
    assert method.text(SECONDS) == "8.40 ± 0.40"
    assert method.text(BYTES) == "20.0"
    assert case.seeds == [1, 2, 3]


def test_a_mean_over_fewer_scenes_does_not_win(tmp_path):
    rows = [row("gaussians", 0.8, seed=1), row("gaussians", 0.8, seed=2), row("fbp", 0.99, seed=1)]
    rows.append(failed("fbp", "no axis", seed=2))
    (case,) = results(tmp_path, rows)
    assert names(case.best(SSIM)) == ["gaussians"]
    assert "fbp (1 of 2 seeds)" in [r[0].text for r in case_table(case).rows]


def test_resolution_says_where_the_sampling_ends(tmp_path):
    limited = dict(row("fbp").volume, resolution_half=None)
    lost = dict(row("fbp").volume, resolution_half=math.inf)
    rows = [row("fbp", volume=limited), row("gaussians", 0.8), row("neural-field", volume=lost)]
    (case,) = results(tmp_path, rows)
    texts = {name: case.method(name).text(RESOLUTION) for name in ("fbp", "gaussians", "neural-field")}
    assert texts == {"fbp": "≤ 2.00", "gaussians": "5.00", "neural-field": "∞"}
    assert names(case.ranked(RESOLUTION)) == ["fbp", "gaussians", "neural-field"]


def test_infinite_and_missing_scores_are_shown_as_such(tmp_path):
    test = {"ssim": 1.0, "frcm": math.nan, "psnr": math.inf, "l1": 0.0}
    (case,) = results(tmp_path, [row("fbp", test=test, stored_bytes=None)])
    cells = dict(zip(case_table(case).head, case_table(case).rows[0]))
    assert cells["PSNR (dB)"].text == "∞"
    assert cells["FRCM"].text == "–"
    assert cells["stored (kB)"].text == "–"


# --- who is beaten ------------------------------------------------------------------------------------------


def test_every_method_ahead_of_ours_is_named_with_its_margin(tmp_path):
    rows = [row("gaussians", q, seed=s) for s, q in ((1, 0.90), (2, 0.90))]
    rows += [row("fbp", q, seed=s) for s, q in ((1, 0.97), (2, 0.89))]
    rows += [row("sirt-nonneg", q, seed=s) for s, q in ((1, 0.905), (2, 0.905))]
    rows += [row("neural-field", 0.5, seed=s) for s in (1, 2)]
    cases = results(tmp_path, rows)
    found = beaten(cases[0], SSIM)
    assert [(b.method, b.won, b.seeds) for b in found] == [("fbp", 1, 2), ("sirt-nonneg", 2, 2)]
    assert [b.margin for b in found] == pytest.approx([0.03, 0.005])
    assert [b.margin for b in beaten(cases[0], ERROR)] == pytest.approx([0.03, 0.005])
    table = beaten_table(cases)
    assert [r[1].text for r in table.rows] == ["SSIM", "FRCM", "Dice", "relative error of δ"]
    assert (
        table.rows[0][3].text == "fbp 0.930 (by 0.030, in 1 of 2 seeds); sirt-nonneg 0.905 (by 0.005, in 2 of 2 seeds)"
    )


def test_pairs_are_compared_on_their_common_scenes(tmp_path):
    rows = [
        row("gaussians", 0.9, seed=1),
        row("gaussians", 0.5, seed=2),
        row("fbp", 0.8, seed=1),
        failed("fbp", "x", 2),
    ]
    (case,) = results(tmp_path, rows)
    assert beaten(case, SSIM) == []  # although 0.8 is above ours' mean over both
    rows = [
        row("gaussians", 0.9, case="b", seed=1),
        row("fbp", 0.95, case="b", seed=1),
        row("fbp", 0.1, case="b", seed=2),
    ]
    (other, *_) = results(tmp_path, rows)
    assert [(b.method, b.seeds) for b in beaten(other, SSIM)] == [("fbp", 1)]


def test_the_verdict_counts_wins_and_defeats(tmp_path):
    rows = [row("gaussians", 0.9), row("fbp", 0.8), row("gaussians", 0.9, case="star"), row("fbp", 0.95, case="star")]
    cases = results(tmp_path, rows)
    assert "gaussians is best in SSIM in 1, FRCM in 1, Dice in 1, relative error of δ in 1" in verdict(cases)
    assert "in 4 of 8 comparisons" in verdict(cases)
    summary = {r[0].text: r[1] for r in summary_table(cases).rows}
    assert (summary["ball"].text, summary["ball"].best) == ("gaussians 0.900", True)
    assert (summary["star"].text, summary["star"].best) == ("fbp 0.950 (gaussians 0.900)", False)
    assert {r[0].text: r[1].text for r in wins_table(cases).rows} == {"gaussians": "1", "fbp": "1"}


def test_without_ours_there_is_still_a_verdict(tmp_path):
    cases = results(tmp_path, [row("fbp")])
    assert "none of these cases" in verdict(cases)
    assert beaten_table(cases) is None
