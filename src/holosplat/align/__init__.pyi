from .axis import Axis as Axis
from .axis import AxisOptions as AxisOptions
from .axis import find_axis as find_axis
from .poses import PoseOptions as PoseOptions
from .poses import Uncertain as Uncertain
from .views import AlignedViews as AlignedViews
from .views import align_views as align_views
