"""The report of a benchmark: report.html and report.md in its folder, with the same pictures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from holosplat.checks import require
from holosplat.report.page import Headline, duration
from holosplat.report.style import format_length, scientific
from holosplat.units import number_of, span

from ..folder import BenchFolder, Row
from ..pictures import TRUTH
from .page import Entry, Page, Picture, ScoreTable, Sheet, write_page
from .pictures import Shown, holograms_figure, slices_figure
from .plots import SMALLEST, Marks, curves_figure, marks_of, overview_figure, sizes_figure, tradeoff_figure
from .results import HEADLINE, MEASURES, OURS, Beaten, CaseResult, Measure, MethodResult, beaten, read_results

PROTOCOL = (
    "Each scene is made of closed triangle meshes; its holograms are simulated by a mesh projector on a raster "
    "several times finer than the detector, which no method uses. A method gets the training frames, their "
    "geometry, and what the case says is known of the matter. Held-out frames are free of noise and never reach it:"
    " they serve the scores only, not the choice of options, nor when to stop. Options were tuned on scenes of "
    "seeds below 100, one set for all cases.",
    "SSIM, PSNR and FRCM (the mean Fourier ring correlation, weighted by frequency) compare predicted with measured"
    " held-out frames, all imaged by the same wave optics. Dice (at half of the material's δ), the relative error "
    "‖δ − δ₀‖/‖δ₀‖, the deviation of the mean δ inside the true matter, and the resolution compare volumes with the"
    " truth on voxels of one pixel. The resolution is the full period at which the Fourier shell correlation falls "
    "below ½, which against a noise-free truth corresponds to 0.143 between two halves of the data (Rosenthal & "
    "Henderson 2003); ≤ marks the sampling limit of two pixels. Time is that of the method alone, with "
    "all that it loads when it first runs in a process. Stored size is "
    "what a file of the result needs: float32 parameters of Gaussians, float16 voxels and network weights. Numbers "
    "after ± are standard deviations over seeds; a method is best only with a result for every seed, and methods "
    "equal in the digits shown are best together. References were given the truth and compete with nobody: "
    "truth-on-voxels is the true volume itself on voxels of one pixel, tv-true-lines is total-variation tomography "
    "from thickness without any error of retrieval.",
)
"""How the numbers came about, in two paragraphs."""


def headline(cases: Sequence[CaseResult]) -> Headline:
    """How often ours is behind, in one line, with the sentences that carry it."""
    shared = [case for case in cases if case.method(OURS) is not None]
    lost = sum(bool(beaten(case, measure)) for case in shared for measure in HEADLINE)
    text = (
        f"{OURS} is ahead or equal in {len(shared) * len(HEADLINE) - lost} of {len(shared) * len(HEADLINE)} comparisons"
    )
    return Headline(text if shared else f"A comparison without {OURS}", None, (verdict(cases),))


def verdict(cases: Sequence[CaseResult]) -> str:
    """Where ours wins and where it is beaten, in one or two sentences with numbers."""
    shared = [case for case in cases if case.method(OURS) is not None]
    if not shared:
        return f"{OURS} was run on none of these cases, so this page compares the other methods with each other."
    parts = []
    for measure in HEADLINE:
        first = sum(any(m.name == OURS for m in case.best(measure)) for case in shared)
        parts.append(f"{measure.name} in {first}")
    lost = sum(bool(beaten(case, measure)) for case in shared for measure in HEADLINE)
    failed = sum(bool(method.reasons) for case in shared for method in case.methods if method.name == OURS)
    text = f"Of {number_of(len(shared), 'case')}, {OURS} is best in {', '.join(parts)}; "
    text += f"another method is ahead of it in {lost} of {len(shared) * len(HEADLINE)} comparisons."
    return text + (f" It failed on {number_of(failed, 'case')}." if failed else "")


def summary_table(cases: Sequence[CaseResult]) -> ScoreTable:
    """The best method of each case by each measure, and what ours reaches where it is another."""
    rows = [(Entry(case.name), *(_winner(case, measure) for measure in HEADLINE)) for case in cases]
    caption = f"The best of each case (bold where it is {OURS}), and what {OURS} reaches where it is another"
    return ScoreTable(("case", *(m.name for m in HEADLINE)), rows, caption)


def _winner(case: CaseResult, measure: Measure) -> Entry:
    best = case.best(measure)
    if not best:
        return Entry("–")
    named = ", ".join(method.name for method in best)
    text, own = f"{named} {best[0].text(measure)}", case.method(OURS)
    if any(method.name == OURS for method in best):
        return Entry(text, best=True)
    return Entry(text if own is None or not own.done else f"{text} ({OURS} {own.text(measure)})")


def wins_table(cases: Sequence[CaseResult]) -> ScoreTable:
    """On how many cases each method is best by each measure, and on how many it has a result."""
    names = list(dict.fromkeys(method.name for case in cases for method in case.methods))
    rows = []
    for name in names:
        wins = [sum(any(m.name == name for m in case.best(measure)) for case in cases) for measure in HEADLINE]
        on = [method for case in cases if (method := case.method(name)) is not None]
        whole = f"{sum(not m.reasons for m in on)} of {len(on)}"
        rows.append((wins, (Entry(name), *(Entry(str(n)) for n in wins), Entry(whole))))
    rows.sort(key=lambda pair: -sum(pair[0]))
    head = ("method", *(m.name for m in HEADLINE), "cases without failure")
    return ScoreTable(head, [row for _, row in rows], "Number of cases on which a method is best (ties count for all)")


def beaten_table(cases: Sequence[CaseResult]) -> ScoreTable | None:
    """Every case and measure in which another method is ahead of ours; None if there are none."""
    rows = []
    for case in cases:
        for measure in HEADLINE:
            ahead = beaten(case, measure)
            if ahead:
                said = "; ".join(_ahead(b) for b in ahead)
                rows.append((case.name, measure.name, measure.text(ahead[0].ours), said))
    if not rows:
        return None
    return ScoreTable.of(
        ("case", "score", OURS, "ahead of it"), rows, f"Where {OURS} is beaten, by whom and by how much"
    )


def _ahead(found: Beaten) -> str:
    margin = f"{found.margin:.3f}" if found.margin >= 0.0005 else f"{found.margin:.1g}"
    text = f"{found.method} {found.measure.text(found.theirs)} (by {margin}"
    return f"{text}, in {found.won} of {found.seeds} seeds)" if found.seeds > 1 else f"{text})"


def case_table(case: CaseResult) -> ScoreTable:
    """All methods and references of a case by all measures; the best methods are bold."""
    best = {measure.name: {m.name for m in case.best(measure)} for measure in MEASURES}
    rows = [_row(method, {}) for method in case.references if method.done]
    rows += [_row(method, best, len(case.seeds)) for method in case.methods if method.done]
    return ScoreTable(("method", *(m.name for m in MEASURES)), rows)


def _row(method: MethodResult, best: dict[str, set[str]], seeds: int = 0) -> tuple[Entry, ...]:
    name = f"reference: {method.name}" if method.first.is_reference else method.name
    if seeds and len(method.done) < seeds:
        name += f" ({len(method.done)} of {seeds} seeds)"
    cells = [Entry(method.text(m), method.name in best.get(m.name, ())) for m in MEASURES]
    return (Entry(name), *cells)


def failures(case: CaseResult) -> list[str]:
    """Why which method has no result on which seeds."""
    said = []
    for method in (*case.references, *case.methods):
        for reason, seeds in method.reasons.items():
            which = "" if set(seeds) == set(case.seeds) else f" (seed {', '.join(map(str, seeds))})"
            kind = "no reference" if method.first.is_reference else "failed"
            said.append(f"{method.name}{which}: {kind}: {reason}")
    return said


def case_facts(case: CaseResult) -> list[str]:
    """How a case is measured and what methods are told, in a paragraph; nothing where it was not recorded."""
    facts = case.facts
    if not facts:
        return []
    rows, columns = facts["detector"]
    photons = "no noise" if facts["photons"] is None else f"{facts['photons']:,.0f} photons a pixel"
    axis = "about one axis" if facts["shares_axis"] else "without a common axis"
    seeds, named = ", ".join(map(str, case.seeds)), [f"{text}." for text in (facts["summary"],) if text]
    return [
        *named,
        f"{number_of(facts['training_frames'], 'training frame')} and {facts['held_out_frames']} held out, {axis}, of "
        f"{rows} × {columns} pixels of {format_length(facts['pixel_size_m'])}, {facts['energy_kev']:g} keV, "
        f"{span(1e3 * np.array(facts['distance_m']))} mm behind the sample, point-spread function of "
        f"{span(np.array(facts['psf_sigma_px']))} pixels, {photons}. Methods are told {_prior(facts['prior'])}. "
        f"Seed{'s' * (len(case.seeds) > 1)} {seeds}.",
    ]


def _prior(prior: dict[str, Any]) -> str:
    if prior["kind"] == "known":
        return f"the material, δ = {scientific(prior['delta'])} and β = {scientific(prior['beta'])}"
    return f"δ/β = {prior['ratio']:.4g} of the one material" if prior["kind"] == "ratio" else "nothing of the matter"


def protocol_sheet(cases: Sequence[CaseResult], rows: Sequence[Row]) -> Sheet:
    """How the numbers came about, for whoever wants to have them again."""
    return Sheet("protocol", "Protocol", PROTOCOL, [_methods_table(cases), _records_table(rows)])


def _methods_table(cases: Sequence[CaseResult]) -> ScoreTable:
    found = {m.name: m.first for case in cases for m in (*case.references, *case.methods)}
    rows = [(name, row.family, row.summary) for name, row in found.items()]
    return ScoreTable.of(("method", "family", "what it does"), rows, "Methods")


def _records_table(rows: Sequence[Row]) -> ScoreTable:
    """Machines, versions, commits, seeds and times: all that occur, with the number of rows where they are several."""
    spent = sum(row.seconds or 0.0 for row in rows)
    entries = [
        ("commit", _occurring([row.commit or "not a git checkout" for row in rows])),
        ("versions", _occurring([_joined(row.versions) for row in rows])),
        ("machine", _occurring([_joined(row.machine) for row in rows])),
        ("seeds", ", ".join(map(str, sorted({row.seed for row in rows})))),
        ("time in methods", duration(spent)),
        ("run", f"{min(row.when for row in rows)} to {max(row.when for row in rows)}"),
    ]
    return ScoreTable.of(("record", "value"), entries, "Record")


def _joined(table: dict[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in table.items())


def _occurring(texts: Sequence[str]) -> str:
    counts = {text: texts.count(text) for text in dict.fromkeys(texts)}
    if len(counts) == 1:
        return texts[0]
    return "; ".join(f"{text} ({count} rows)" for text, count in counts.items())


DOWN = "All axes are logarithmic, and better is further down and to the left."


def write_bench_report(folder: BenchFolder) -> tuple[Path, Path]:
    """Write the report of all rows that `folder` holds, of a finished benchmark or not; returns both pages' paths."""
    folder.require_bench()
    cases = read_results(folder)
    require(len(cases) > 0, f"{folder.path} holds no row yet; run `holosplat bench run --out {folder.path}` first.")
    folder.images.mkdir(exist_ok=True)
    marks = marks_of(cases)
    rows = [row for case in cases for method in (*case.references, *case.methods) for row in method.rows.values()]
    sheets = [_summary_sheet(folder, cases, marks)]
    sheets += [_case_sheet(folder, case, marks) for case in cases]
    page = Page("Benchmark", headline(cases), _said(rows), [*sheets, protocol_sheet(cases, rows)])
    return write_page(page, folder.html, folder.markdown)


def _said(rows: Sequence[Row]) -> str:
    methods = {row.method for row in rows if not row.is_reference}
    scenes = {(row.case, row.seed) for row in rows}
    failed = sum(not row.done for row in rows if not row.is_reference)
    return (
        f"{len(methods)} methods on {len(scenes)} scenes ({len({row.case for row in rows})} cases), "
        f"{len(rows)} rows, {failed} of them failed. All were given the same training frames and told the same of the "
        "matter; all were scored by the same wave optics on frames that none had seen, and against the true volume."
    )


def _summary_sheet(folder: BenchFolder, cases: Sequence[CaseResult], marks: Marks) -> Sheet:
    tables = [summary_table(cases), wins_table(cases), beaten_table(cases)]
    pictures = []
    if any(method.done for case in cases for method in case.methods):
        title, caption = (
            "All methods on all cases.",
            "What is missing to a perfect score, on logarithmic axes: further left is better. Means over seeds; "
            f"deficits below {SMALLEST:g} are drawn there.",
        )
        pictures.append(_saved(folder, "overview", overview_figure(cases, marks), title, caption))
    return Sheet("summary", "Which method wins where", (), [t for t in tables if t], (), pictures)


def _case_sheet(folder: BenchFolder, case: CaseResult, marks: Marks) -> Sheet:
    pictures: list[Picture] = []
    truth = folder.read_picture(case.name, case.seeds[0], TRUTH)
    if truth is not None:
        pictures += _side_by_side(folder, case, truth)
    if any(method.done for method in case.methods):
        text = (
            "What is missing to a perfect score, over the time of the method (above) and the size of its result "
            f"(below). {DOWN} The grey steps join the methods that none other beats in both; grey dashes are "
            "references, which were given the truth."
        )
        pictures.append(_saved(folder, f"{case.name}-cost", tradeoff_figure(case, marks), "Quality and cost.", text))
    if truth is not None:
        pictures += _curves(folder, case, marks, float(truth["pixel_size"]))
    return Sheet(case.name, case.name, case_facts(case), [case_table(case)], failures(case), pictures)


def _curves(folder: BenchFolder, case: CaseResult, marks: Marks, pixel_size: float) -> list[Picture]:
    """Correlation curves and, where the case is of balls, what is left of their contrast; pixel_size [m]."""
    found = {shown.name: shown.arrays for shown in _shown(folder, case, case.methods, "")}
    scene, pictures = f"Scene of seed {case.seeds[0]}. ", []
    curves, sizes = curves_figure(found, marks, pixel_size), sizes_figure(found, marks, pixel_size)
    if curves is not None:
        text = (
            "Left: mean over the held-out holograms. Right: δ against the truth; the resolution of the table is where "
            "a curve falls below ½ (dashed). Correlations below −0.1 are not drawn."
        )
        title = "Correlation in Fourier space."
        pictures.append(_saved(folder, f"{case.name}-curves", curves, title, scene + text))
    if sizes is not None:
        text = (
            "Mean δ in the balls of a size, less that around them, as a part of the true difference: 1 where all of "
            "it is left, 0 where nothing is seen."
        )
        pictures.append(_saved(folder, f"{case.name}-sizes", sizes, "Contrast of balls by size.", scene + text))
    return pictures


def _side_by_side(folder: BenchFolder, case: CaseResult, truth: dict) -> list[Picture]:
    seed, everyone = case.seeds[0], [*case.references, *case.methods]
    dice, ssim = (_shown(folder, case, everyone, score) for score in ("dice", "ssim"))
    frame = f"held-out frame {int(truth['index']) + 1} of {case.facts.get('held_out_frames', '?')}"
    return [
        _saved(
            folder,
            f"{case.name}-slices",
            slices_figure(truth, dice),
            "Slices of δ.",
            f"Scene of seed {seed}. Above, the plane across the y axis (xz), below, the plane along it (xy), each "
            "where most of the true matter is; one colour scale for all, in units of the material's δ. Dice is that of "
            "the whole volume. References, which were given the truth, come first.",
        ),
        _saved(
            folder,
            f"{case.name}-holograms",
            holograms_figure(truth, ssim),
            "A held-out hologram.",
            f"Scene of seed {seed}, {frame}: measured, and what each method predicts; below, predicted − measured, on "
            "one scale for all. SSIM is the mean over the held-out frames.",
        ),
    ]


def _shown(folder: BenchFolder, case: CaseResult, methods: Sequence[MethodResult], score: str) -> list[Shown]:
    """The pictures of the first seed that there are, each with its score."""
    seed, found = case.seeds[0], []
    for method in methods:
        arrays = folder.read_picture(case.name, seed, method.name) if seed in method.done else None
        if arrays is not None:
            found.append(Shown(method.name, _note(method.done[seed], score), arrays))
    return found


def _note(row: Row, score: str) -> str:
    measure = next((m for m in HEADLINE if m.name.lower() == score), None)
    value = None if measure is None else measure.value(row)
    return "" if measure is None or value is None else f"{measure.name} {measure.text(value)}"


def _saved(folder: BenchFolder, name: str, figure: Figure, title: str, caption: str) -> Picture:
    """A figure, written as PNG into the folder's pictures."""
    return Picture.of(figure, folder.images / f"{name}.png", title, caption)
