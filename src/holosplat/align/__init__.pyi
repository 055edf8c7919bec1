from .axis import Axis as Axis
from .axis import AxisOptions as AxisOptions
from .axis import find_axis as find_axis
