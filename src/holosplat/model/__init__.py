"""From matter to frames: the only way that leads there."""

from ..optics.modes import smooth_modes
from .alignment import Alignment
from .instrument import Instrument
from .light import LightField, SolvedLight
from .scene import Model, measure

__all__ = ["Alignment", "Instrument", "LightField", "Model", "SolvedLight", "measure", "smooth_modes"]
