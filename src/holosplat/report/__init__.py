"""The report of a reconstruction: figures in one style, and a self-contained HTML page. No physics here."""

from .content import HeldOutViews, ProjectedMaps, ReportContent, view_labels
from .figures import hero_figure
from .page import render_page, write_report
from .surface import render_surface

__all__ = [
    "HeldOutViews",
    "ProjectedMaps",
    "ReportContent",
    "hero_figure",
    "render_page",
    "render_surface",
    "view_labels",
    "write_report",
]
