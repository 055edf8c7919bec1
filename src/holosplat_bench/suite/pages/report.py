"""The report of a benchmark: report.html and report.md in its folder, with the same pictures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from holosplat.checks import require
from holosplat.io.atomic import atomic_path
from holosplat.report.style import DPI, data_uri, styled

from ..folder import BenchFolder
from ..pictures import TRUTH
from ..rows import Row
from .marks import marks_of
from .page import Page, Picture, Sheet, as_html, as_markdown
from .pictures import Shown, holograms_figure, slices_figure
from .plots import SMALLEST, Marks, curves_figure, overview_figure, sizes_figure, tradeoff_figure
from .results import HEADLINE, CaseResult, MethodResult, read_results
from .text import beaten_table, case_facts, case_table, failures, headline, protocol_sheet, summary_table, wins_table

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
    for path, text in ((folder.html, as_html(page)), (folder.markdown, as_markdown(page, folder.path))):
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return folder.html, folder.markdown


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


@styled
def _saved(folder: BenchFolder, name: str, figure: Figure, title: str, caption: str) -> Picture:
    """A figure, written as PNG into the folder's pictures."""
    path = folder.images / f"{name}.png"
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})
    return Picture(path, title, caption, data_uri(figure))
