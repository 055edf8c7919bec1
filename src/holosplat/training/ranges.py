"""Stated ranges that scenes for learning are drawn from."""

from __future__ import annotations

from typing import Literal

from ..checks import at_least, require
from ..geometry import Views
from ..ranges import Angle, Many, Natural, Pixels, Positive, Share, SomeShare, Weight, checked_dataclass
from ..scan import Exposures
from ..units import wavelength

Kind = Literal["red-cells", "crowd", "ellipsoids", "capsules", "filled-capsules", "foam", "soft-cells"]
"""What a scene may be made of."""


@checked_dataclass
class Ranges:
    """Ranges (least, most) that scenes are drawn from; lengths of bodies are in pixels, so that scenes of any
    magnification are the same to a network."""

    kinds: tuple[Kind, ...] = ("red-cells",)
    """What scenes are made of, each kind as often as the others; crowd: red cells as close as they can be; capsules:
    shells about nothing; filled-capsules: about another material; soft-cells: continuous, with nuclei and vacuoles."""
    rows: Natural = 80
    """Of a frame [pixels]."""
    columns: Natural = 80
    """Of a frame [pixels]."""
    views: Many = 6
    """Frames with noise, for training."""
    held_out: Many = 2
    """Frames without noise, which show how well others are predicted."""
    tilted: Share = 0.2
    """Share of scenes whose views have no common axis."""
    tilt: Angle = 40.0
    """Tilt of these beams out of the plane, at most [degrees]."""
    across: tuple[Positive, Positive] = (10.0, 22.0)
    """Diameter of a body [pixels], evenly."""
    filled: tuple[SomeShare, SomeShare] = (0.01, 0.15)
    """Share of the room that bodies fill, evenly in its logarithm."""
    crowded: tuple[SomeShare, SomeShare] = (0.15, 0.22)
    """Share of the room that a crowd fills, evenly."""
    core: tuple[Share, Share] = (0.2, 0.8)
    """δ inside filled capsules over that of their shells, of the same δ/β, evenly."""
    medium: Share = 0.0
    """Share of scenes whose bodies lie in a medium that absorbs more than they do, as red cells in plasma: δ/β is then
    negative."""
    deform: tuple[Share, Share] = (0.0, 0.08)
    """Bending of red cells [diameters], evenly."""
    stretch: tuple[Share, Share] = (0.0, 0.35)
    """Stretch of red cells in flow, evenly in the logarithm of the lengths."""
    energy_kev: tuple[Positive, Positive] = (8.0, 30.0)
    """Photon energy [keV], evenly in its logarithm."""
    fresnel: tuple[Positive, Positive] = (0.02, 0.6)
    """Fresnel number of a pixel, p²/λz, evenly in its logarithm."""
    phase: tuple[Positive, Positive] = (0.02, 0.8)
    """Phase of a body's largest thickness [radians], evenly in its logarithm."""
    ratio: tuple[Positive, Positive] = (300.0, 4000.0)
    """δ/β of the matter, evenly in its logarithm."""
    noise: tuple[Positive, Positive] = (0.01, 0.2)
    """Standard deviation of the noise [radians] over that phase, evenly in its logarithm: the frames' contrast is about
    a third of the phase, and what is far below the noise teaches nothing."""
    noiseless: Share = 0.4
    """Share of scenes whose frames have no noise."""
    blur_px: tuple[Pixels, Pixels] = (0.0, 0.7)
    """Standard deviation of the point-spread function [pixels], evenly."""
    uneven: tuple[Weight, Weight] = (0.0, 0.0)
    """Smooth deviation of the light of every frame (rms), evenly; none by default."""
    misaligned_px: tuple[Pixels, Pixels] = (0.0, 0.0)
    """Standard deviation of unknown shifts of each view [pixels], evenly; none by default."""

    def __post_init__(self) -> None:
        at_least(self, 16, "rows", "columns")
        at_least(self, 2, "views")
        require(len(self.kinds) > 0, "kinds must name at least one kind of specimen, but it is empty; give one.")
        for name, pair in vars(self).items():
            if name != "kinds" and isinstance(pair, tuple):
                require(pair[0] <= pair[1], f"{name} must be (least, most), but it is {pair}; exchange them.")

    def extremes(self) -> list[Exposures]:
        """Frames of both ends of the Fresnel numbers, between which those of all scenes lie."""
        pixel, energy = 1e-6, 20.0  # on which nothing depends beside the Fresnel number
        views = Views.evenly_spaced(self.views + self.held_out, (self.rows, self.columns), pixel)
        return [Exposures.of(views, energy, pixel**2 / (wavelength(energy) * number)) for number in self.fresnel]
