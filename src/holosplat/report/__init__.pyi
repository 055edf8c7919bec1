from .content import HeldOutViews as HeldOutViews
from .content import ProjectedMaps as ProjectedMaps
from .content import ReportContent as ReportContent
from .content import view_labels as view_labels
from .page import render_page as render_page
from .page import write_report as write_report
from .surface import render_surface as render_surface
