"""Properties of frames that change the resources of their reconstruction: foreground and noise."""

from __future__ import annotations

from ..methods import Method
from ..methods.gaussians import Gaussians
from ..methods.window import windows_of
from ..optics.noise import noise_levels, noise_share
from ..optics.noise_model import NoiseModel
from ..scan import Scan
from .needs import UNSEEN, Seen, Sizes

MOST_PIXELS = 100_000_000
"""Of all frames that are looked at: more take longer than an estimate is worth."""


def can_be_seen(scan: Scan) -> bool:
    """Whether the frames of `scan` are few enough to be looked at before all else."""
    rows, columns = scan.views.shape
    return 0 < len(scan) * rows * columns <= MOST_PIXELS


def seen_of(scan: Scan, method: Method, whole: bool = False) -> Seen:
    """Measure the training frames of `scan`; nothing where all frames are too many, or of several times.

    whole: whether a run works on whole frames whatever they show, as with free poses. Noise counts as white here, and
    light as even: in other light windows hold whole frames.
    """
    if not can_be_seen(scan) or scan.is_series:
        return UNSEEN
    scan = scan.train().in_memory()
    noise = NoiseModel.white_only(noise_levels(scan.measured), scan.views.shape)
    windows = None if whole else windows_of(scan, noise)
    worked = scan if windows is None else windows.of(scan)
    return Seen(None if windows is None else Sizes.of(worked.exposures), _is_noisy(worked, method))


def _is_noisy(scan: Scan, method: Method) -> bool:
    """Whether surfaces begin as they do in noise, on the pixels that they begin on (`methods.first_surfaces`)."""
    gaussians = getattr(method, "gaussians", None)
    if not isinstance(gaussians, Gaussians):
        return False
    factor = gaussians.coarse.factor(scan.views.shape)
    coarse = scan.binned(factor) if factor > 1 else scan
    return noise_share(coarse.measured) > gaussians.volume.noisy
