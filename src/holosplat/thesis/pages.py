"""The thesis' study as a page: its Table 2, all its curves, and what of its findings reproduces."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..io.atomic import atomic_path
from ..report.blocks import Block
from ..report.content import flatten
from ..report.page import template
from ..report.style import (
    CYCLE,
    DPI,
    FAINT,
    INK,
    WIDTH,
    data_uri,
    decimal_scale,
    letter,
    new_figure,
    scientific,
    styled,
)
from ..report.tables import Table, duration
from .findings import Finding, findings
from .folder import Study

TITLE = "The thesis' study, rerun"
HEAD = ("configuration", "SSIM", "FRCM", "PSNR (dB)", "L1", "Dice", "δ/β", "Gaussians", "ms a step", "time")
FRAMES, VOLUME = (0, 1, 2, 3, 4), (0, 5, 6, 7, 8, 9)
"""Columns of `HEAD` of the two tables that fit side by side on the page."""

SOLID, DASHED, DOTTED = "-", (0, (4, 1.5)), (0, (1, 1.2))
LINES: dict[str, tuple[str, Any]] = {
    "8k-v1": (CYCLE[0], DOTTED),
    "8k-v4": (CYCLE[0], SOLID),
    "8k-v8": (CYCLE[0], DASHED),
    "32k-v4": (CYCLE[4], SOLID),
    "98k-v4": (CYCLE[1], SOLID),
    "244k-v4": (CYCLE[3], SOLID),
    "8k-v4-position": (CYCLE[5], DASHED),
    "8k-v4-shape": (CYCLE[2], DASHED),
    "8k-v4-all-learn": (CYCLE[6], SOLID),
    "8k-v4-one-unit": (CYCLE[6], DOTTED),
}
"""Colour and dashes of each configuration: solid for four views at the usual rates."""

PANELS = (
    ("test_ssim", "SSIM", "Held-out SSIM"),
    ("test_frcm", "FRCM", "Held-out FRCM"),
    ("test_psnr", "PSNR (dB)", "Held-out PSNR"),
    ("test_l1", "L1", "Held-out L1"),
    ("train_ssim", "SSIM", "Training SSIM"),
    ("train_l1", "L1", "Training L1"),
    ("dice", "Dice", "Dice of the volume"),
    ("count", "Gaussians", "Number of Gaussians"),
    ("mean_delta", "δ", "Mean δ in the cells"),
    ("mean_beta", "β", "Mean β in the cells"),
    ("ratio", "δ/β", "Mean δ / mean β"),
)
LOGARITHMIC = ("test_l1", "train_l1", "count", "ratio")


def write_study(study: Study, folder: Path) -> list[Path]:
    """Write thesis.html, thesis.md, thesis_curves.png and thesis_psnr.png into `folder`; returns their paths."""
    found = findings(study)
    drawn = {"thesis_curves.png": curves_figure(study), "thesis_psnr.png": psnr_figure(study)}
    texts = {"thesis.html": render_study(study, found, list(drawn.values())), "thesis.md": study_markdown(study, found)}
    for name, figure in drawn.items():
        with atomic_path(folder / name) as temporary:
            _save(figure, temporary)
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [folder / name for name in (*texts, *drawn)]


def render_study(study: Study, found: Sequence[Finding], figures: Sequence[Figure]) -> str:
    """The page as HTML: `figures` are the curves and the scores against PSNR."""
    rows = table_rows(study)
    verdicts = Table("Findings of the thesis", [(f.claim, f.verdict, f.evidence) for f in found], ("", "", "evidence"))
    frames, volume = (
        Table(caption, [tuple(row[i] for i in columns) for row in rows], tuple(HEAD[i] for i in columns))
        for caption, columns in (("Held-out frames, at the end", FRAMES), ("Volume and cost", VOLUME))
    )
    captions = zip((CURVES_CAPTION, PSNR_CAPTION), figures, ("Curves", "What PSNR sees"))
    blocks = [
        Block(heading, text, f"{heading}.", data_uri(figure, "svg"), 100, number)
        for number, (text, figure, heading) in enumerate(captions, 1)
    ]
    return template("template.html").render(
        title=TITLE,
        summary=summary(study),
        verdict=verdict(found),
        key_figures=[],
        blocks=blocks,
        scores=[verdicts, frames, volume],
        records=_records(study),
    )


def study_markdown(study: Study, found: Sequence[Finding]) -> str:
    """The page as Markdown, with the pictures beside it."""
    lines = [f"# {TITLE}", "", verdict(found), "", summary(study), "", "## Table 2", ""]
    lines += _markdown_table(HEAD, table_rows(study))
    lines += ["", "## Findings", ""]
    lines += _markdown_table(("finding", "verdict", "evidence"), [(f.claim, f.verdict, f.evidence) for f in found])
    lines += ["", "## Curves", "", "![Curves](thesis_curves.png)", "", CURVES_CAPTION]
    lines += ["", "![What PSNR sees](thesis_psnr.png)", "", PSNR_CAPTION, "", "## Record", ""]
    for table in _records(study):
        lines += [f"- {table.caption}: " + "; ".join(f"{name} {value}" for name, value in table.rows)]
    return "\n".join(lines) + "\n"


def table_rows(study: Study) -> list[tuple[str, ...]]:
    """Texts of Table 2, a row a configuration, in the columns `HEAD`."""
    return [_table_row(name, row, study.curves[name]) for name, row in study.rows.items()]


def _table_row(name: str, row: dict[str, Any], curve: dict[str, np.ndarray]) -> tuple[str, ...]:
    last = row["last"]
    # The median between looks: what else the machine did now and then does not count.
    step = float(np.median(np.diff(curve["seconds"]) / np.diff(curve["step"]))) if len(curve["step"]) > 1 else 0.0
    ended = "" if row["status"] == "done" else f" (diverged at step {row['diverged_at']})"
    return (
        name + ended,
        f"{last['test_ssim']:.3f}",
        f"{last['test_frcm']:.3f}",
        f"{last['test_psnr']:.1f}",
        f"{last['test_l1']:.4f}",
        f"{last['dice']:.3f}",
        scientific(last["ratio"], 4),
        f"{row['configuration']['count']} → {last['count']:.0f}",
        f"{1e3 * step:.0f}",
        duration(row["seconds"]),
    )


def summary(study: Study) -> str:
    """What was run, in two sentences."""
    about, count = study.about, len(study.rows)
    frames, rows, columns = about["frames"]
    steps = max(row["steps"] for row in study.rows.values())
    return (
        f"Case {about['case']}: {frames - about['held_out']} training and {about['held_out']} held-out frames of "
        f"{rows} × {columns} pixels of {1e6 * about['pixel_size_m']:.3g} µm, seed {about['seed']}. "
        f"{count} configuration{'s' if count > 1 else ''}, schedule “{about['pace']['name']}” of {steps} steps, "
        "two-channel Gaussians from a random start, no prior; held-out frames judge only."
    )


def verdict(found: Sequence[Finding]) -> str:
    """All verdicts in one sentence."""
    return "; ".join(f"“{f.claim}” {f.verdict}" for f in found) + "."


CURVES_CAPTION = (
    "Scores of each configuration over steps, looked at on the way and never acted on. The dashed grey line is the "
    "truth; δ and β are means inside the true cells, weighted by true matter."
)
PSNR_CAPTION = (
    "Each look of each fit after its warm-up: FRCM of the held-out frames, and Dice of the volume, against held-out "
    "PSNR; the dot is the end. Where PSNR ranks as they do, curves rise to the right."
)


@styled
def curves_figure(study: Study) -> Figure:
    """All curves over steps, a panel a score."""
    figure = new_figure(WIDTH, 5.4)
    grid = figure.subplots(3, 4)
    panels = list(grid.flat)
    truth = {name: study.about[f"true_{name}"] for name in ("delta", "beta")}
    lines = {"mean_delta": truth["delta"], "mean_beta": truth["beta"], "ratio": truth["delta"] / truth["beta"]}
    for index, (axes, (key, label, title)) in enumerate(zip(panels, PANELS)):
        _panel(axes, study, key, label, lines.get(key))
        letter(axes, index, title)
    for axes in grid[-1]:
        axes.set_xlabel("step")
    _legend(panels[-1], study)
    return figure


@styled
def psnr_figure(study: Study) -> Figure:
    """FRCM and Dice against PSNR, one line a fit."""
    figure = new_figure(WIDTH, 2.5)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 0.5))
    for index, (axes, key, label) in enumerate(zip(panels, ("test_frcm", "dice"), ("FRCM", "Dice"))):
        for name in study.rows:
            curve, (colour, dashes) = study.curves[name], LINES[name]
            taken = curve["step"] >= max(1, study.about["warmup_steps"])
            psnr, score = curve["test_psnr"][taken], curve[key][taken]
            axes.plot(psnr, score, color=colour, ls=dashes)
            axes.plot(psnr[-1:], score[-1:], "o", ms=3, color=colour)
        axes.set(xlabel="held-out PSNR (dB)", ylabel=label)
        letter(axes, index, f"{label} against PSNR")
    _legend(panels[-1], study)
    return figure


def _panel(axes: Axes, study: Study, key: str, label: str, truth: float | None) -> None:
    curves = {name: study.curves[name][key] for name in study.rows}
    finite = [np.abs(curve[np.isfinite(curve)]) for curve in curves.values()]
    largest = max((float(values.max()) for values in finite if values.size), default=1.0)
    scale, power = (1.0, "") if key in LOGARITHMIC else decimal_scale(max(largest, truth or 0.0))
    for name, curve in curves.items():
        colour, dashes = LINES[name]
        axes.plot(study.curves[name]["step"], curve / scale, color=colour, ls=dashes, lw=0.9)
    if truth is not None:
        axes.axhline(truth / scale, color=FAINT, lw=0.8, ls=DASHED)
    axes.set(ylabel=f"{label} ({power})" if power else label, yscale="log" if key in LOGARITHMIC else "linear")
    axes.set_xlim(0, max(float(study.curves[name]["step"][-1]) for name in study.rows))
    axes.locator_params(axis="x", nbins=4)


def _legend(axes: Axes, study: Study) -> None:
    """The names of the configurations, in the place of a panel."""
    axes.axis("off")
    for name in study.rows:
        colour, dashes = LINES[name]
        axes.plot([], [], color=colour, ls=dashes, label=name)
    axes.legend(loc="center", labelcolor=INK, handlelength=2.6)


@styled
def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})


def _records(study: Study) -> list[Table]:
    about = study.about
    what: list[tuple[str, ...]] = [
        ("case", str(about["case"])),
        ("seed", str(about["seed"])),
        ("schedule", f"{about['pace']['name']} (steps divided by {about['pace']['shortened']})"),
        ("scan", str(about["scan_hash"])),
        ("commit", about["commit"] or "not recorded"),
    ]
    named = {"Versions": about["versions"], "Machine": about["machine"]}
    return [Table("Study", what)] + [Table(name, list(flatten(values).items())) for name, values in named.items()]


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
