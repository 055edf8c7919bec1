"""Input images of a network: the contrast of frames, the thickness retrieved from each, and their noise."""

from __future__ import annotations

import torch
from torch import Tensor

from ..baselines.wave_frames import frames_of, refined
from ..matter import DeltaBeta
from ..model import Instrument
from ..optics.noise import noise_levels
from ..optics.retrieval import FIXED, Tikhonov, tikhonov
from ..optics.sampling import fringe_sampling
from ..scan import Exposures, Scan
from .network import THICKNESS

RETRIEVAL = Tikhonov(iterations=20, prior=FIXED)
"""Of each frame by itself: a third of the steps of the other starts, as a network mends what is left; with the prior of
the retrievals that it learned from."""
CONTRAST = 0.5
"""Of the contrast's root mean square, in the images."""


def retrieved_thickness(
    frames: Tensor, exposures: Exposures, material: DeltaBeta, missing: Tensor | None = None
) -> Tensor:
    """Projected thickness [V, H, W] [m] of `material` in relative frames [V, H, W], each by itself; missing: pixels
    [V, H, W] bool without a value; errors: those of `tikhonov`."""
    return tikhonov(frames, exposures, *material, options=RETRIEVAL, missing=missing)


def seen_in(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Tensor, Tensor]:
    """The contrast [V, H, W] of a scan, the retrieved thickness of `material` [V, H, W] [smallest pixels], and the
    noise [V].

    Missing pixels have no weight: they show the contrast that the retrieved thickness has there.
    """
    frames, optics = torch.from_numpy(scan.frames), scan.exposures.optical
    thickness = retrieved_thickness(frames, scan.exposures, material, scan.gaps)
    if scan.gaps is not None:
        samples = fringe_sampling(optics)
        frames = torch.where(
            scan.gaps, frames_of(Instrument(optics, samples), refined(thickness.float(), samples), material), frames
        )
    return frames - 1, thickness / scan.views.finest, noise_levels(scan.measured)


def images(contrast: Tensor, thickness: Tensor, noise: Tensor) -> Tensor:
    """The network's images [V, 3, H, W] float32 of views.

    contrast: [V, H, W], relative intensity less one; thickness: [V, H, W], retrieved, in pixels; noise: [V], standard
    deviation of the noise of the contrast.
    """
    rms = contrast.float().square().mean().sqrt().clamp_min(torch.finfo(torch.float16).tiny)
    level = (noise.float() / rms)[:, None, None].expand(contrast.shape)
    return torch.stack([CONTRAST * contrast / rms, THICKNESS * thickness, CONTRAST * level], 1).float()
