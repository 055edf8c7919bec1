"""The thesis' study as a page: its Table 2, all its curves as figures, and which findings reproduce."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from holosplat.report.content import flatten
from holosplat.report.page import Headline, duration
from holosplat.report.style import (
    CYCLE,
    FAINT,
    INK,
    WIDTH,
    colour_bar,
    decimal_scale,
    letter,
    new_figure,
    scale_bar,
    scientific,
    styled,
)

from ...suite.pages.page import Page, ScoreTable, Sheet, write_page
from ...suite.pages.page import Picture as Shown
from ..findings import Finding, findings
from ..folder import Study

SOLID, DASHED, DOTTED, DASH_DOTTED = "-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (4, 1.2, 1, 1.2))
LINES: dict[str, tuple[str, Any]] = {
    "8k-v1": (CYCLE[0], DOTTED),
    "8k-v4": (CYCLE[0], SOLID),
    "8k-v8": (CYCLE[0], DASHED),
    "32k-v4": (CYCLE[4], SOLID),
    "98k-v4": (CYCLE[1], SOLID),
    "244k-v4": (CYCLE[3], SOLID),
    "8k-v4-position": (CYCLE[5], DASHED),
    "8k-v4-shape": (CYCLE[2], DASHED),
    "8k-v2": (CYCLE[0], DASH_DOTTED),
    "8k-v4-position-half": (CYCLE[5], DOTTED),
    "8k-v4-shape-half": (CYCLE[2], DOTTED),
    "8k-v4-both": (CYCLE[2], SOLID),
    "8k-v4-amplitude": (CYCLE[1], DASHED),
    "8k-v4-volume-tv": (CYCLE[4], DASHED),
    "8k-v4-threshold": (CYCLE[3], DASHED),
    "8k-v4-faint": (CYCLE[3], DOTTED),
    "8k-v4-all-learn": (CYCLE[6], SOLID),
    "8k-v4-one-unit": (CYCLE[6], DOTTED),
}
"""Colour and dashes of each configuration."""

PANELS = (
    ("test_ssim", "SSIM", "Held-out SSIM"),
    ("test_frcm", "FRCM", "Held-out FRCM"),
    ("test_psnr", "PSNR (dB)", "Held-out PSNR"),
    ("test_l1", "L1", "Held-out L1"),
    ("train_ssim", "SSIM", "Training SSIM"),
    ("train_l1", "L1", "Training L1"),
    ("dice", "Dice", "Dice of the volume"),
    ("count", "Gaussians", "Number of Gaussians"),
    ("loss", "loss", "Loss of the last step"),
    ("mean_delta", "δ", "Mean δ in the cells"),
    ("mean_beta", "β", "Mean β in the cells"),
    ("ratio", "δ/β", "Mean δ / mean β"),
    ("own_ratio", "δ/β", "Mean of Gaussians' own"),
    ("median_own_ratio", "δ/β", "Median of their own"),
)
LOGARITHMIC = ("test_l1", "train_l1", "count", "loss", "ratio", "own_ratio", "median_own_ratio")
RATIO_PANELS = ("ratio", "own_ratio", "median_own_ratio")


CURVES_CAPTION = (
    "Scores of each configuration over steps, looked at on the way and never acted on. The dashed grey line is the "
    "truth; δ and β are means inside the true cells, weighted by true matter."
)
PSNR_CAPTION = (
    "Each look of each fit after its warm-up: FRCM of the held-out frames, and Dice of the volume, against held-out "
    "PSNR; the dot is the end. Where PSNR ranks as they do, curves rise to the right."
)
LINES_CAPTION = (
    "Phase shift and absorption of one held-out view, as the Gaussians of 8k-v4 have them on their way, and the truth; "
    "colours end at the truth's."
)
GEOMETRY_CAPTION = "δ in the middle slice of the field at the end of each configuration, on one scale, and the truth."
MAIN = "8k-v4"
"""The configuration that is shown through training."""


@styled
def curves_figure(study: Study) -> Figure:
    """All curves over steps, a panel a score."""
    figure = new_figure(WIDTH, 7.2)
    grid = figure.subplots(4, 4)
    panels = list(grid.flat)
    truth = {name: study.about[f"true_{name}"] for name in ("delta", "beta")}
    lines = {f"mean_{name}": value for name, value in truth.items()}
    lines |= dict.fromkeys(RATIO_PANELS, truth["delta"] / truth["beta"])
    for index, (axes, (key, label, title)) in enumerate(zip(panels, PANELS)):
        _panel(axes, study, key, label, lines.get(key))
        letter(axes, index, title)
    for axes in grid[-1]:
        axes.set_xlabel("step")
    names = list(study.rows)
    for axes, part in zip(panels[-2:], (names[:9], names[9:])):
        _legend(axes, part)
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
    _legend(panels[-1], list(study.rows))
    return figure


@styled
def lines_figure(study: Study) -> Figure:
    """Phase and absorption of a held-out view through training: a row each, a column a look, the truth last."""
    maps = study.maps.get(MAIN) or next(iter(study.maps.values()))
    every = np.concatenate((maps["lines"], maps["true_lines"][None]))
    titles = [f"step {step}" for step in maps["steps"]] + ["truth"]
    figure = new_figure(WIDTH, 1.35)
    grid = figure.subplots(2, len(every) + 1, squeeze=False, width_ratios=[*[1.0] * len(every), 0.06])
    for row, (label, axes_row) in enumerate(zip(("k∫δ (rad)", "k∫β"), grid)):
        top = float(np.percentile(maps["true_lines"][row], 99.5)) or 1.0
        for axes, lines, title in zip(axes_row[:-1], every, titles):
            drawn = axes.imshow(lines[row], vmin=0, vmax=top, cmap="magma")
            axes.set(xticks=[], yticks=[], title=title if row == 0 else "")
        axes_row[0].set_ylabel(label)
        if row == 0:
            scale_bar(axes_row[0], every.shape[-1] * study.about["pixel_size_m"], height=0.1, beside=True)
        colour_bar(figure, drawn, axes_row[-1], "rad" if row == 0 else "", extend="max")
    return figure


@styled
def geometry_figure(study: Study) -> Figure:
    """The middle slice of δ of each configuration, and the truth."""
    names = list(study.maps)
    true = next(maps["true_slice"] for maps in study.maps.values() if "true_slice" in maps)
    columns = 4
    rows = len(names) // columns + 1
    figure = new_figure(WIDTH, 0.95 * rows)
    grid = figure.subplots(rows, columns + 1, squeeze=False, width_ratios=[*[1.0] * columns, 0.05])
    panels, top = list(grid[:, :-1].flat), float(true.max())
    scale, power = decimal_scale(top)
    for axes, title, picture in zip(panels, ("truth", *names), (true, *(study.maps[n]["slice"] for n in names))):
        drawn = axes.imshow(picture / scale, vmin=0, vmax=1.5 * top / scale, cmap="magma")
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, loc="left")
    for axes in (*panels[len(names) + 1 :], *grid[1:, -1]):
        axes.axis("off")
    scale_bar(panels[0], true.shape[1] * study.about["pixel_size_m"], height=0.1, beside=True)
    colour_bar(figure, drawn, grid[0, -1], f"δ ({power})", extend="max")
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


def _legend(axes: Axes, names: list[str]) -> None:
    """The names of the configurations, in the place of a panel."""
    axes.axis("off")
    for name in names:
        colour, dashes = LINES[name]
        axes.plot([], [], color=colour, ls=dashes, label=name)
    if names:
        axes.legend(loc="center", labelcolor=INK, handlelength=2.6)


@dataclass(frozen=True)
class Picture:
    """file: its name; heading, caption: of the figure; draw: makes it; mapped: whether it needs maps."""

    file: str
    heading: str
    caption: str
    draw: Callable[[Study], Figure]
    mapped: bool = False


PICTURES = (
    Picture("thesis_curves.png", "Curves", CURVES_CAPTION, curves_figure),
    Picture("thesis_psnr.png", "What PSNR sees", PSNR_CAPTION, psnr_figure),
    Picture("thesis_lines.png", "Line integrals through training", LINES_CAPTION, lines_figure, mapped=True),
    Picture("thesis_geometry.png", "Geometry", GEOMETRY_CAPTION, geometry_figure, mapped=True),
)
"""All pictures of a study."""


def pictures(study: Study) -> list[Picture]:
    """Those that can be drawn of `study`."""
    return [picture for picture in PICTURES if study.maps or not picture.mapped]


TITLE = "The thesis' study, rerun"
HEAD = ("configuration", "SSIM", "FRCM", "best FRCM (step)", "PSNR (dB)", "L1")
HEAD += ("Dice", "δ/β in cells", "δ/β own", "Gaussians", "time")


def write_study(study: Study, folder: Path) -> list[Path]:
    """Write thesis.html, thesis.md and the pictures (`PICTURES`) into `folder`; returns their paths."""
    drawn = [Shown.of(one.draw(study), folder / one.file, f"{one.heading}.", one.caption) for one in pictures(study)]
    texts = write_page(page_of(study, drawn), folder / "thesis.html", folder / "thesis.md")
    return [*texts, *(one.path for one in drawn)]


def page_of(study: Study, drawn: Sequence[Shown] = ()) -> Page:
    """The page of a study with its pictures."""
    found = findings(study)
    verdicts = [(f.claim, f.verdict, f.evidence) for f in found]
    sheets = (
        Sheet("table", "Table 2", tables=[ScoreTable.of(HEAD, table_rows(study))]),
        Sheet("findings", "Findings", tables=[ScoreTable.of(("finding", "verdict", "evidence"), verdicts)]),
        Sheet("figures", "Figures", pictures=drawn),
        Sheet("record", "Record", tables=[ScoreTable.of(("record", "value"), _records(study))]),
    )
    return Page(TITLE, Headline(TITLE, None, (verdict(found),)), summary(study), sheets)


def table_rows(study: Study) -> list[tuple[str, ...]]:
    """Texts of Table 2, a row a configuration, in the columns `HEAD`."""
    return [_table_row(name, row) for name, row in study.rows.items()]


def _table_row(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    last, best = row["last"], row["best"]
    ended = "" if row["status"] == "done" else f" (diverged at step {row['diverged_at']})"
    return (
        name + ended,
        f"{last['test_ssim']:.3f}",
        f"{last['test_frcm']:.3f}",
        f"{best['test_frcm']:.3f} ({best['step']:.0f})",
        f"{last['test_psnr']:.1f}",
        f"{last['test_l1']:.4f}",
        f"{last['dice']:.3f}",
        scientific(last["ratio"], 4),
        scientific(last["own_ratio"], 4),
        f"{row['configuration']['count']} → {last['count']:.0f}",
        duration(row["seconds"]),
    )


def summary(study: Study) -> str:
    """What was run, in two sentences."""
    about, count = study.about, len(study.rows)
    frames, rows, columns = about["frames"]
    steps = max(row["steps"] for row in study.rows.values())
    return (
        f"Case {about['case']}, physics “{about['physics']}”: {frames - about['held_out']} training and "
        f"{about['held_out']} held-out frames of {rows} × {columns} pixels of {1e6 * about['pixel_size_m']:.3g} µm, "
        f"seed {about['seed']}. "
        f"{count} configuration{'s' if count > 1 else ''}, schedule “{about['pace']['name']}” of {steps} steps, "
        "Gaussians with a density, δ and β each, from a random start, no prior; held-out frames judge only."
    )


def verdict(found: Sequence[Finding]) -> str:
    """All verdicts in one sentence."""
    return "; ".join(f"“{f.claim}” {f.verdict}" for f in found) + "."


def _records(study: Study) -> list[tuple[str, str]]:
    """Name and value of what made the study."""
    about = study.about
    return [
        ("case", str(about["case"])),
        ("physics", str(about["physics"])),
        ("seed", str(about["seed"])),
        ("schedule", f"{about['pace']['name']} (steps divided by {about['pace']['shortened']})"),
        ("scan", str(about["scan_hash"])),
        ("commit", about["commit"] or "not recorded"),
        *flatten(about["versions"]).items(),
        *flatten(about["machine"]).items(),
    ]
