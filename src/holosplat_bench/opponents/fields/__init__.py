"""Fields that networks make of matter: of space, of space and time, and of what views show in front of a point."""

from __future__ import annotations

from .aligned_network import AlignedNetwork, PixelAligned
from .neural_field import Network, NeuralField
from .perceptron import Encoding
from .pixel_aligned import PixelAlignedField
from .space_time import SpaceTime, SpaceTimeField

__all__ = [
    "AlignedNetwork",
    "Encoding",
    "Network",
    "NeuralField",
    "PixelAligned",
    "PixelAlignedField",
    "SpaceTime",
    "SpaceTimeField",
]
