"""The page of a benchmark as data, and how it is written: as one HTML file, and as Markdown beside its pictures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from holosplat.io.atomic import atomic_path
from holosplat.report.page import Headline, template
from holosplat.report.style import DPI, data_uri, styled

SPECIAL = re.compile(r"([\\`*_<>|\[\]~])")
"""Characters that Markdown would not leave as they are."""


@dataclass(frozen=True)
class Entry:
    """A cell of a table; the best ones are bold, those that became worse red."""

    text: str
    best: bool = False
    worse: bool = False


@dataclass(frozen=True)
class ScoreTable:
    """A table: heads of its columns, and rows whose first cell names the row."""

    head: tuple[str, ...]
    rows: list[tuple[Entry, ...]]
    caption: str = ""

    @classmethod
    def of(cls, head: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> ScoreTable:
        """The table of plain texts."""
        return cls(tuple(head), [tuple(map(Entry, row)) for row in rows], caption)


@dataclass(frozen=True)
class Picture:
    """A picture: its PNG file beside the page, title and caption, and itself as a `data:` URI."""

    path: Path
    title: str
    caption: str
    image: str

    @classmethod
    def of(cls, figure: Figure, path: Path, title: str, caption: str) -> Picture:
        """A figure, written as the PNG file `path`."""
        save(figure, path)
        return cls(path, title, caption, data_uri(figure))


@dataclass(frozen=True)
class Sheet:
    """A section: its anchor and heading, paragraphs, tables, remarks below them, and pictures."""

    anchor: str
    heading: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ScoreTable] = ()
    remarks: Sequence[str] = ()
    pictures: Sequence[Picture] = ()


@dataclass(frozen=True)
class Page:
    """The whole page."""

    title: str
    headline: Headline
    summary: str
    sheets: Sequence[Sheet]


@styled
def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, the same bytes for the same figure."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})


def write_page(page: Page, html: Path, markdown: Path) -> tuple[Path, Path]:
    """Write both files, which lie in the folder of the pictures or above it; returns their paths."""
    for path, text in ((html, as_html(page)), (markdown, as_markdown(page, markdown.parent))):
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return html, markdown


def as_html(page: Page) -> str:
    """The page as one self-contained file."""
    values = {"title": page.title, "headline": page.headline, "summary": page.summary, "sheets": page.sheets}
    return template("bench.html", __package__ or "").render(key_figures=(), blocks=(), scores=(), records=(), **values)


def as_markdown(page: Page, root: Path) -> str:
    """The page as Markdown, with links to its pictures relative to the folder `root`."""
    parts = [
        f"# {escaped(page.title)}",
        *map(escaped, (page.headline.text, *page.headline.words)),
        escaped(page.summary),
    ]
    number = 0
    for sheet in page.sheets:
        parts.append(f"## {escaped(sheet.heading)}")
        parts += [escaped(text) for text in sheet.paragraphs]
        for table in sheet.tables:
            parts += [f"**{escaped(table.caption)}**"] if table.caption else []
            parts.append(_markdown_table(table))
        parts += ["\n".join(f"- {escaped(text)}" for text in sheet.remarks)] if sheet.remarks else []
        for picture in sheet.pictures:
            number += 1
            link = picture.path.relative_to(root).as_posix()
            parts.append(f"![{escaped(picture.title)}]({link})")
            parts.append(f"**Figure {number} | {escaped(picture.title)}** {escaped(picture.caption)}")
    return "\n\n".join(part for part in parts if part) + "\n"


def _markdown_table(table: ScoreTable) -> str:
    lines = ["| " + " | ".join(escaped(name) for name in table.head) + " |"]
    lines.append("| --- |" + " ---: |" * (len(table.head) - 1) if _numeric(table) else "| --- " * len(table.head) + "|")
    for row in table.rows:
        cells = [f"**{escaped(e.text)}**" if e.best and e.text else escaped(e.text) for e in row]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _numeric(table: ScoreTable) -> bool:
    """Whether all cells but the first of each row look like numbers, which stand better to the right."""
    return all(len(entry.text) < 18 for row in table.rows for entry in row[1:])


def escaped(text: str) -> str:
    """`text` as Markdown shows it unchanged, on one line, also inside a table."""
    return SPECIAL.sub(r"\\\1", " ".join(text.split()))
