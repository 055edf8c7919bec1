"""The page: figures, captions and tables in `template.html`, written as one self-contained file."""

from __future__ import annotations

import os
import tempfile
from importlib import resources
from pathlib import Path

import jinja2

from .blocks import make_blocks
from .content import ReportContent
from .tables import key_figures, record_tables, score_tables, verdict


def write_report(content: ReportContent, path: str | os.PathLike[str]) -> Path:
    """Write `content` as one self-contained HTML file at `path`, atomically: no reader ever sees half of it.

    Returns the path. Raises `OSError` when the folder does not exist or cannot be written.
    """
    target = Path(path)
    page = render_page(content)
    descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(page)
        os.chmod(name, 0o644)  # a temporary file is private; a report is to be shared
        os.replace(name, target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return target


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
