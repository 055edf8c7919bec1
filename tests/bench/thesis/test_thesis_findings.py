"""The rules by which findings of the thesis are held against its study rerun."""

from __future__ import annotations

import numpy as np

from holosplat_bench.thesis.configurations import THESIS_TABLE
from holosplat_bench.thesis.findings import (
    counts_follow_views,
    early_stop_helps,
    findings,
    frcm_peaks_early,
    low_frcm,
    low_ratio,
    more_gaussians_hurt,
    psnr_misleads,
)
from holosplat_bench.thesis.folder import CURVES, Study

LOOKS = 20


def invented(**columns) -> Study:
    """A study of the eight configurations whose curves all rise, but for `columns`: name → [looks] or (8 × [looks])."""
    rise = np.linspace(0.1, 0.9, LOOKS)
    rows, curves = {}, {}
    for index, configuration in enumerate(THESIS_TABLE):
        curve = dict.fromkeys(CURVES, rise + 0.001 * index)
        curve |= {"step": np.arange(LOOKS) * 100.0, "test_psnr": 10 + 20 * rise + 0.1 * index}
        curve |= {name: np.full(LOOKS, 2800.0) for name in ("ratio", "own_ratio", "median_own_ratio")}
        for name, values in columns.items():
            curve[name] = np.asarray(values[index] if len(values) == len(THESIS_TABLE) else values, dtype=float)
        curves[configuration.name] = curve
        last = {key: float(column[-1]) for key, column in curve.items()}
        at = int(np.argmax(curve["test_frcm"]))
        best = {key: float(column[at]) for key, column in curve.items()}
        rows[configuration.name] = {"status": "done", "diverged_at": None, "steps": 1900, "last": last, "best": best}
    return Study({"warmup_steps": 150, "true_delta": 2.8e-7, "true_beta": 1e-10}, rows, curves, {})


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
    ways = ("ratio", "own_ratio", "median_own_ratio")
    assert low_ratio(invented(**{way: np.full(LOOKS, 28.0) for way in ways})).verdict == "reproduces"
    own_alone = low_ratio(invented(own_ratio=np.full(LOOKS, 28.0)))
    assert own_alone.verdict == "reproduces in part", "it depends on how the ratio is taken"
    assert "mean of the Gaussians' own, 28 (100.0 times too small" in own_alone.evidence
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


def test_numbers_follow_the_views_a_step_only_where_they_grow_and_shrink():
    def ends(one, four, eight):
        count = {"8k-v1": one, "8k-v4": four, "8k-v8": eight}
        return [np.linspace(8000, count.get(c.name, 8000), LOOKS) for c in THESIS_TABLE]

    assert counts_follow_views(invented(count=ends(80_000, 20_000, 2_000))).verdict == "reproduces"
    falling = counts_follow_views(invented(count=ends(80_000, 30_000, 9_000)))
    assert falling.verdict == "reproduces in part"
    assert "80,000, 30,000 (four views a step) and 9,000" in falling.evidence
    assert counts_follow_views(invented(count=ends(9_000, 9_000, 9_000))).verdict == "does not reproduce"


def test_an_early_stop_helps_only_where_the_end_is_worse():
    rise = np.linspace(0.1, 0.9, LOOKS)
    assert early_stop_helps(invented()).verdict == "does not reproduce"
    peaked = np.where(rise < 0.5, rise, 0.3)
    assert early_stop_helps(invented(test_frcm=peaked)).verdict == "reproduces"
    some = early_stop_helps(invented(test_frcm=[peaked, *[rise] * 7]))
    assert some.verdict == "reproduces in part"
    assert "In 1 of 8; most in 8k-v1: FRCM 0.479 at step 900 against 0.300" in some.evidence
