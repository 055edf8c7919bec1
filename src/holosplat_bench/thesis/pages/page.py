"""The thesis' study as a page: its Table 2, all its curves, and what of its findings reproduces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from holosplat.io.atomic import atomic_path
from holosplat.report.blocks import Block
from holosplat.report.content import flatten
from holosplat.report.page import template
from holosplat.report.style import data_uri, scientific
from holosplat.report.tables import Table, duration

from ..findings import Finding, findings
from ..folder import Study
from .figures import Picture, pictures, save

TITLE = "The thesis' study, rerun"
HEAD = ("configuration", "SSIM", "FRCM", "best FRCM (step)", "PSNR (dB)", "L1")
HEAD += ("Dice", "δ/β in cells", "δ/β own", "Gaussians", "time")
FRAMES, VOLUME = (0, 1, 2, 3, 4, 5), (0, 6, 7, 8, 9, 10)
"""Columns of `HEAD` of the two tables that fit side by side on the page."""


def write_study(study: Study, folder: Path) -> list[Path]:
    """Write thesis.html, thesis.md and the pictures (`figures.PICTURES`) into `folder`; returns their paths."""
    found = findings(study)
    drawn = {picture: picture.draw(study) for picture in pictures(study)}
    texts = {"thesis.html": render_study(study, found, drawn), "thesis.md": study_markdown(study, found, list(drawn))}
    for picture, figure in drawn.items():
        with atomic_path(folder / picture.file) as temporary:
            save(figure, temporary)
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [folder / name for name in (*texts, *(picture.file for picture in drawn))]


def render_study(study: Study, found: Sequence[Finding], drawn: Mapping[Picture, Figure]) -> str:
    """The page as HTML, with its figures."""
    rows = table_rows(study)
    verdicts = Table("Findings of the thesis", [(f.claim, f.verdict, f.evidence) for f in found], ("", "", "evidence"))
    frames, volume = (
        Table(caption, [tuple(row[i] for i in columns) for row in rows], tuple(HEAD[i] for i in columns))
        for caption, columns in (("Held-out frames, at the end", FRAMES), ("Volume and cost", VOLUME))
    )
    blocks = [
        Block(picture.heading, picture.caption, f"{picture.heading}.", data_uri(figure, "svg"), 100, number)
        for number, (picture, figure) in enumerate(drawn.items(), 1)
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


def study_markdown(study: Study, found: Sequence[Finding], drawn: Sequence[Picture] = ()) -> str:
    """The page as Markdown, with the pictures beside it."""
    lines = [f"# {TITLE}", "", verdict(found), "", summary(study), "", "## Table 2", ""]
    lines += markdown_table(HEAD, table_rows(study))
    lines += ["", "## Findings", ""]
    lines += markdown_table(("finding", "verdict", "evidence"), [(f.claim, f.verdict, f.evidence) for f in found])
    for picture in drawn:
        lines += ["", f"## {picture.heading}", "", f"![{picture.heading}]({picture.file})", "", picture.caption]
    lines += ["", "## Record", ""]
    for table in _records(study):
        lines += [f"- {table.caption}: " + "; ".join(f"{name} {value}" for name, value in table.rows)]
    return "\n".join(lines) + "\n"


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


def _records(study: Study) -> list[Table]:
    about = study.about
    what: list[tuple[str, ...]] = [
        ("case", str(about["case"])),
        ("physics", str(about["physics"])),
        ("seed", str(about["seed"])),
        ("schedule", f"{about['pace']['name']} (steps divided by {about['pace']['shortened']})"),
        ("scan", str(about["scan_hash"])),
        ("commit", about["commit"] or "not recorded"),
    ]
    named = {"Versions": about["versions"], "Machine": about["machine"]}
    return [Table("Study", what)] + [Table(name, list(flatten(values).items())) for name, values in named.items()]


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
