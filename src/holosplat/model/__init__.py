"""From matter to frames: the only way that leads there."""

from .alignment import Alignment
from .instrument import Instrument
from .light import LightField, smooth_modes
from .scene import Model, measure

__all__ = ["Alignment", "Instrument", "LightField", "Model", "measure", "smooth_modes"]
