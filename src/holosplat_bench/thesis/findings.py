"""What the thesis found, held against its study rerun: each verdict follows from the numbers by a rule that it states.

One run of one scene is behind each, so differences below `MARGIN` count as none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import spearmanr

from .configurations import EXTRA, THESIS_TABLE
from .folder import Study

Verdict = Literal["reproduces", "reproduces in part", "does not reproduce", "cannot be judged"]

MARGIN = 0.02
"""A difference of SSIM, FRCM or Dice up to this is none."""
RANK_FOLLOWS = 0.5
"""A rank correlation from which on one score follows the other."""
LOW_FACTOR = 10.0
"""The thesis' δ/β is too small by at least this factor."""
RATIOS = {
    "own_ratio": "mean of the Gaussians' own",
    "median_own_ratio": "their median",
    "ratio": "inside the true cells",
}
"""How δ/β is taken: as the thesis plots it, more robustly, and as a reader of the volume would."""
THESIS_COUNTS = {"8k-v1": 86_300, "8k-v8": 2_200}
"""Gaussians at the end of these configurations in the thesis, from 8000."""
SEEN = 0.3
"""An FRCM from which on a prediction shows what is in the frames."""
THESIS_LEVELS = {"test_ssim": 0.870, "test_frcm": 0.096, "test_psnr": 19.5}
"""The held-out scores that the thesis reached."""


@dataclass(frozen=True)
class Finding:
    """claim: what the thesis found; verdict: whether it is found here; evidence: sentences with the numbers."""

    claim: str
    verdict: Verdict
    evidence: str


def findings(study: Study) -> list[Finding]:
    """All findings, in the order of the questions that the thesis asks."""
    return [
        psnr_misleads(study),
        more_gaussians_hurt(study),
        frcm_peaks_early(study),
        early_stop_helps(study),
        counts_follow_views(study),
        low_frcm(study),
        low_ratio(study),
    ]


def psnr_misleads(study: Study) -> Finding:
    """PSNR misleads if it does not rank as FRCM on the held-out frames, and Dice, do; in part if only its level does.

    The ranks are Spearman's ρ, over the looks of each fit from the end of its warm-up (then the median of the
    configurations) and over the ends of the configurations: it reproduces if one of these is not positive. The level
    misleads if, in half of the configurations, a look whose FRCM is above `SEEN` has no more PSNR than the start, which
    holds next to nothing.
    """
    claim, curves = "PSNR misleads", _judged_curves(study)
    if not curves:
        return Finding(claim, "cannot be judged", "No configuration has three looks after its warm-up.")
    scores = {"test_frcm": "FRCM", "dice": "Dice"}
    ranks = {score: [_rank(curve["test_psnr"], curve[score]) for curve in curves.values()] for score in scores}
    middle = {score: float(np.median(ranks[score])) for score in scores}
    ends = {score: np.array([curve[score][-1] for curve in curves.values()]) for score in ("test_psnr", *scores)}
    across = {score: _rank(ends["test_psnr"], ends[score]) for score in scores if len(curves) > 2}
    blank = float(study.curves[next(iter(curves))]["test_psnr"][0])  # all start alike
    hidden = [float(curve["test_frcm"][curve["test_psnr"] <= blank].max(initial=0.0)) for curve in curves.values()]
    level = 2 * sum(frcm > SEEN for frcm in hidden) >= len(curves)
    verdict: Verdict = "does not reproduce"
    if min(*middle.values(), *across.values()) <= 0:
        verdict = "reproduces"
    elif level or min(*middle.values(), *across.values()) < RANK_FOLLOWS:
        verdict = "reproduces in part"
    evidence = (
        "Spearman's ρ of held-out PSNR over the looks of a fit: "
        + " and ".join(f"{_signed(middle[score])} with {said}" for score, said in scores.items())
        + f" (median of {_configurations(len(curves))}; {_signed(min(map(min, ranks.values())))} at worst)"
    )
    if across:
        evidence += "; over the ends of the configurations: " + " and ".join(
            f"{_signed(across[score])} with {said}" for score, said in scores.items()
        )
    evidence += (
        f". The start, which holds next to nothing, has {blank:.1f} dB; looks of an FRCM up to "
        f"{max(hidden):.2f} have no more."
    )
    return Finding(claim, verdict, evidence)


def more_gaussians_hurt(study: Study) -> Finding:
    """More Gaussians hurt if held-out SSIM and FRCM, and Dice, fall by more than `MARGIN` from the fewest to the most.

    Among the configurations that differ in nothing else. It reproduces if two of the three fall, and does not if
    none does.
    """
    claim = "More Gaussians hurt"
    alike = [c for c in THESIS_TABLE if (c.views, c.position_rate, c.shape_rate) == _ordinary()]
    last = {c.count: study.rows[c.name]["last"] for c in alike if _is_done(study, c.name)}
    if len(last) < 2:
        return Finding(claim, "cannot be judged", "Fewer than two starting counts are finished.")
    few, many = min(last), max(last)
    scores = {"test_ssim": "SSIM", "test_frcm": "FRCM", "dice": "Dice"}
    fallen = [name for name in scores if last[many][name] < last[few][name] - MARGIN]
    verdict: Verdict = ("does not reproduce", "reproduces in part", "reproduces", "reproduces")[len(fallen)]
    said = "; ".join(
        f"{said} " + ", ".join(f"{row[name]:.3f} ({count // 1000}k)" for count, row in sorted(last.items()))
        for name, said in scores.items()
    )
    return Finding(claim, verdict, f"At the end, by the starting count: {said}.")


def frcm_peaks_early(study: Study) -> Finding:
    """FRCM peaks early if its best look lies in the first half of the steps, and the end is worse by over `MARGIN`.

    It reproduces if that is so in more than half of the configurations; in part if in some, or if FRCM falls so far
    from a peak in the first half and recovers; and does not otherwise. A look counts as the median of itself and its
    neighbours: where Gaussians were just split, one look alone is worse.
    """
    claim, curves = "FRCM peaks early, then falls", _judged_curves(study)
    if not curves:
        return Finding(claim, "cannot be judged", "No configuration has three looks after its warm-up.")
    at, lost, fallen = {}, {}, {}
    for name, curve in curves.items():
        frcm, first_half = (
            median_filter(curve["test_frcm"], 3, mode="nearest"),
            curve["step"] <= 0.5 * curve["step"][-1],
        )
        at[name] = float(curve["step"][int(np.argmax(frcm))] / curve["step"][-1])
        lost[name] = float(frcm.max() - frcm[-1])
        highest_yet = np.maximum.accumulate(np.where(first_half, frcm, -np.inf))
        fallen[name] = float((highest_yet - frcm).max())
    early = [name for name in curves if at[name] <= 0.5 and lost[name] > MARGIN]
    deepest = max(fallen, key=lambda name: fallen[name])
    verdict: Verdict = "does not reproduce"
    if 2 * len(early) > len(curves):
        verdict = "reproduces"
    elif early or fallen[deepest] > MARGIN:
        verdict = "reproduces in part"
    evidence = (
        f"The best look comes after {_span([100 * share for share in at.values()], '.0f')} % of the steps, "
        f"and the end is at most {max(lost.values()):.3f} below it: early and lost in {len(early)} of {len(curves)}. "
        f"The deepest fall from a peak in the first half is {fallen[deepest]:.3f} ({deepest})."
    )
    return Finding(claim, verdict, evidence)


def low_frcm(study: Study) -> Finding:
    """The thesis' level reproduces if no configuration beats its FRCM by more than `MARGIN`."""
    claim = "SSIM {test_ssim:.3f} with FRCM {test_frcm:.3f} and PSNR {test_psnr:.1f} dB".format(**THESIS_LEVELS)
    rows = {name: study.rows[name]["last"] for name in _names(study) if _is_done(study, name)}
    if not rows:
        return Finding(claim, "cannot be judged", "No configuration of the thesis is finished.")
    level = THESIS_LEVELS["test_frcm"] + MARGIN
    above = [name for name, row in rows.items() if row["test_frcm"] > level]
    verdict: Verdict = "reproduces in part"
    if len(above) in (0, len(rows)):
        verdict = "does not reproduce" if above else "reproduces"
    ssim, frcm, psnr = ([row[key] for row in rows.values()] for key in THESIS_LEVELS)
    evidence = (
        f"Here, over {_configurations(len(rows))}: SSIM {_span(ssim, '.3f')}, FRCM {_span(frcm, '.3f')}, "
        f"PSNR {_span(psnr, '.1f')} dB."
    )
    return Finding(claim, verdict, evidence)


def low_ratio(study: Study) -> Finding:
    """δ/β is too small as in the thesis if it is so by `LOW_FACTOR` or more, however it is taken (`RATIOS`).

    It reproduces if that is so in all of the thesis' configurations and for all ways, and does not if it is in none.
    """
    claim = "δ/β comes out 10 to 100 times too small"
    true = study.about["true_delta"] / study.about["true_beta"]
    names = [name for name in _names(study) if _is_done(study, name)]
    found = {way: {n: r for n in names if (r := study.rows[n]["last"][way])} for way in RATIOS}
    shares = [ratio / true for ratios in found.values() for ratio in ratios.values()]
    if not shares:
        return Finding(claim, "cannot be judged", "No configuration of the thesis is finished.")
    low = sum(share <= 1 / LOW_FACTOR for share in shares)
    verdict: Verdict = "reproduces in part"
    if low in (0, len(shares)):
        verdict = "reproduces" if low else "does not reproduce"
    said = [f"{text}, {_ratio_span(found[way], true)}" for way, text in RATIOS.items() if found[way]]
    evidence = f"Where {true:.0f} is true, δ/β is: " + "; ".join(said) + "."
    for name in (c.name for c in EXTRA if c.one_unit and _is_done(study, c.name)):
        inside = study.rows[name]["last"]["ratio"]
        evidence += (
            f" With one unit for δ and β at the start ({name}) it is {inside or math.inf:,.0f} inside the cells."
        )
    return Finding(claim, verdict, evidence)


def _ratio_span(found: dict[str, float], true: float) -> str:
    """The least and the greatest δ/β, against the true one."""
    ends = {pick(found, key=lambda name: found[name]): None for pick in (min, max)}
    said = " and ".join(f"{found[name]:,.0f} ({_times(found[name] / true)}, {name})" for name in ends)
    return "between " * (len(ends) > 1) + said


def counts_follow_views(study: Study) -> Finding:
    """Numbers follow the views a step if one view a step makes 8000 Gaussians more than twice as many and eight make
    them fewer; in part if the number at the end falls from one view over four to eight."""
    grown, shrunk = THESIS_COUNTS.values()
    claim = f"One view a step grows 8000 Gaussians to {grown:,}, eight shrink them to {shrunk:,}"
    order = ("8k-v1", "8k-v4", "8k-v8")
    if not all(_is_done(study, name) for name in order):
        return Finding(claim, "cannot be judged", "One, four and eight views a step are not all finished.")
    start = THESIS_TABLE[1].count
    one, four, eight = (study.rows[name]["last"]["count"] for name in order)
    verdict: Verdict = "reproduces in part" if one > four > eight else "does not reproduce"
    if one > 2 * start and eight < start:
        verdict = "reproduces"
    return Finding(claim, verdict, f"Here they end at {one:,.0f}, {four:,.0f} (four views a step) and {eight:,.0f}.")


def early_stop_helps(study: Study) -> Finding:
    """Stopping at the best held-out FRCM helps if that is more than `MARGIN` above the end's, in over half of the
    configurations; in part if in some."""
    claim = "Stopping at the best FRCM helps"
    rows = {name: study.rows[name] for name in _names(study) if _is_done(study, name) and "best" in study.rows[name]}
    if not rows:
        return Finding(claim, "cannot be judged", "No configuration of the thesis is finished.")
    gains = {name: row["best"]["test_frcm"] - row["last"]["test_frcm"] for name, row in rows.items()}
    helped = [name for name, gain in gains.items() if gain > MARGIN]
    verdict: Verdict = "does not reproduce" if not helped else "reproduces in part"
    if 2 * len(helped) > len(rows):
        verdict = "reproduces"
    most = max(gains, key=lambda name: gains[name])
    best, last = rows[most]["best"], rows[most]["last"]
    return Finding(
        claim,
        verdict,
        f"In {len(helped)} of {len(rows)}; most in {most}: FRCM {best['test_frcm']:.3f} at step "
        f"{best['step']:,.0f} against {last['test_frcm']:.3f} at the end, Dice {best['dice']:.3f} against "
        f"{last['dice']:.3f}. A held-out frame would have to choose the step.",
    )


def _judged_curves(study: Study) -> dict[str, dict[str, np.ndarray]]:
    """Curves of the thesis' configurations from the end of the warm-up on; without those of fewer than three looks."""
    found = {}
    for name in _names(study):
        curve = study.curves[name]
        taken = (curve["step"] >= max(1, study.about["warmup_steps"])) & np.isfinite(curve["test_psnr"])
        if np.count_nonzero(taken) > 2:
            found[name] = {key: column[taken] for key, column in curve.items()}
    return found


def _names(study: Study) -> list[str]:
    return [c.name for c in THESIS_TABLE if c.name in study.rows]


def _is_done(study: Study, name: str) -> bool:
    return name in study.rows and study.rows[name]["status"] == "done"


def _ordinary() -> tuple[int, float, float]:
    base = THESIS_TABLE[1]
    return base.views, base.position_rate, base.shape_rate


def _rank(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's ρ; 0 where one of the two does not change."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    return float(spearmanr(a, b).statistic)  # pyright: ignore[reportAttributeAccessIssue]


def _times(share: float) -> str:
    """0.05 → "20.0 times too small"."""
    return f"{share:,.1f} times too large" if share >= 1 else f"{1 / share:,.1f} times too small"


def _span(values: Sequence[float], form: str) -> str:
    """The least and the greatest of `values`, or the one that both are: "0.5 to 0.9"."""
    return " to ".join(dict.fromkeys(format(pick(values), form) for pick in (min, max)))


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")


def _configurations(count: int) -> str:
    return "one configuration" if count == 1 else f"{count} configurations"
