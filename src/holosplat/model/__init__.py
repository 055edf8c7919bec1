"""From matter to frames: the only way that leads there."""

from ..optics.patterns import smooth_modes
from .alignment import Alignment
from .instrument import Instrument
from .scene import LightField, Model, SolvedLight, measure

__all__ = ["Alignment", "Instrument", "LightField", "Model", "SolvedLight", "measure", "smooth_modes"]
