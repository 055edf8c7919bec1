"""The page: figures, captions and tables in `template.html`, written as one self-contained file."""

from __future__ import annotations

from pathlib import Path

import jinja2

from ..io.atomic import atomic_path
from .blocks import make_blocks
from .content import ReportContent
from .tables import headline, key_figures, record_tables, score_tables


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
    return template("template.html").render(
        title=content.title,
        run=content.run,
        summary=content.summary,
        headline=headline(content),
        key_figures=key_figures(content),
        blocks=make_blocks(content),
        scores=score_tables(content),
        records=record_tables(content),
    )


def template(name: str, package: str = "") -> jinja2.Template:
    """The page template `name` of this room or of another `package`; all extend this room's `template.html`."""
    folders = [jinja2.PackageLoader(folder, "") for folder in (package, __package__ or "") if folder]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(folders),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["zip"] = zip
    return environment.get_template(name)
