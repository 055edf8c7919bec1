"""The page: figures, captions and tables in `template.html`, written as one self-contained file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import jinja2

from ..io.atomic import atomic_path
from .blocks import make_blocks
from .content import ReportContent
from .tables import key_figures, record_tables, score_tables, verdict


def write_report(content: ReportContent, path: str | Path) -> Path:
    """Write `content` as one self-contained HTML file at `path`, atomically: no reader ever sees half of it.

    Returns the path. Raises `InputError` when it cannot be written.
    """
    page = render_page(content)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def render_page(content: ReportContent) -> str:
    """`content` as HTML; equal content gives equal text."""
    source = resources.files(__package__ or "").joinpath("template.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(source).render(
        title=content.title,
        summary=content.summary,
        verdict=verdict(content),
        key_figures=key_figures(content),
        blocks=make_blocks(content),
        scores=score_tables(content),
        records=record_tables(content),
    )
