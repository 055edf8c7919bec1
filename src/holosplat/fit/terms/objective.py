"""`Objective`: the weights of the terms on frames and on the object, the same for every representation."""

from __future__ import annotations

from ...checks import require
from ...ranges import Pixels, Share, Weight, checked_dataclass

IMAGE_TERMS = ("l1", "l2_amplitude", "ssim", "tv_image", "frc", "rounded", "spectral")
"""The weights of which one at least must be above zero."""
VOLUME_TERMS = ("tv_volume", "overfull", "two_levels")


@checked_dataclass
class Objective:
    """Weights of the terms; a weight of zero leaves the term out.

    The first seven compare predicted with measured frames, in units of the training frames' range. The terms on the
    volume see what the object adds up to; they are sums along the beam in units of 100 voxels, mean over pixels, so
    that they weigh the same however fine the pixels or wide the field, and they weigh more with fewer views (the
    weights are those for eight, and go with one over the root).
    """

    l1: float = 1.0
    """Mean absolute difference of frames."""
    l2_amplitude: float = 0.0
    """Mean squared difference of amplitudes √I (Godard et al. 2012, eq. 9)."""
    ssim: float = 0.0
    """1 - SSIM."""
    tv_image: float = 0.0
    """Total variation of the predicted frames."""
    frc: float = 0.0
    """1 - FRCM; the weight is ramped from 0."""
    rounded: float = 0.0
    """`√(r² + c²) - c` of the differences r, smooth where they may be noise."""
    spectral: float = 0.0
    """Differences of amplitudes in pixels of thickness, low frequencies raised (`fit.terms.frames`)."""
    frc_ramp: Share = 1.0
    """Share of the steps over which the weight of `frc` is ramped."""
    noise_width: float = 0.0
    """Differences below so many standard deviations of the frames' own noise count in `l1` by their square."""
    coarse: Pixels = 0.0
    """`l1` compares frames blurred by so many pixels at first, where noise is half their contrast or more (by less in
    proportion where it is less), and not blurred at the end."""
    rounding: Weight = 3.0
    """c of `rounded`, in standard deviations of the noise."""
    floor: float = 0.1
    """`spectral`: the smaller, the larger the shapes that are fitted, and the more of the noise."""
    anisotropy: float = 0.0
    """Gaussians: longest over shortest axis beyond `anisotropy_limit`."""
    anisotropy_limit: float = 10.0
    """Ratio of axes that costs nothing."""
    tv_volume: float = 0.0
    """Total variation of the volume."""
    overfull: float = 0.0
    """Square of what exceeds an occupancy of one; only where values are occupancies of a known level."""
    two_levels: float = 0.0
    """Occupancies between nothing and one; ramped from 0, for at its beginning matter may still be too faint."""
    noise_gain: float = 0.0
    """What the weights of `two_levels` and `bending` grow by, times the share of the frames' contrast that is noise."""
    bending: float = 0.0
    """Surfaces: Σ |L² x|² over the pixels of a frame, L x the distance of vertices x from their neighbours' mean."""

    def __post_init__(self) -> None:
        compared = sum(getattr(self, name) for name in IMAGE_TERMS)
        require(compared > 0, f"the objective needs a term on the frames: one of {', '.join(IMAGE_TERMS)}.")
        require(self.floor > 0, f"floor must be positive, but it is {self.floor}.")

    @property
    def uses_volume(self) -> bool:
        """Whether a term needs the voxelised object."""
        return any(getattr(self, name) > 0 for name in VOLUME_TERMS)
