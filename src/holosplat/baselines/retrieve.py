"""`retrieve`: measured frames → projected thickness, and the light, whose unevenness and grain the frames show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor
from torch.nn.functional import pad

from ..checks import InputError
from ..matter import DeltaBeta
from ..model import Instrument
from ..optics.background import DARKEST, Background, Light, LightOptions
from ..optics.noise_model import NoiseModel
from ..optics.retrieval import RETRIEVALS, tikhonov
from ..optics.retrieval.spectra import checked, radian
from ..progress import Advance
from ..scan import Exposures

EVEN_OR_NOT = LightOptions()
ROUNDS = 2
"""How often the light of uneven frames is found anew beside the matter. The first round mends what fringes that passed
for air did to it; on simulated fibres the error still falls in the second, and no longer in the third."""
BODY, TOP = 0.3, 0.999
"""Matter is where the thickness exceeds this part of its quantile TOP: less is often the shadow of uneven light. The
fringes of thinner matter are divided out, too."""
RIM = 3
"""How far from matter its fringes are predicted well enough to see the light beside them [pixels]."""


@dataclass(frozen=True)
class Retrieved:
    """thickness: [V, H, W] in metres; phase: -kδT [V, H, W] in radians, of the exit wave; light: as it was found."""

    thickness: Tensor
    phase: Tensor
    light: Light


def retrieve(
    frames: Tensor | np.ndarray,
    exposures: Exposures,
    material: DeltaBeta,
    method: str = "tikhonov",
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Advance = lambda fraction: None,
) -> Retrieved:
    """The projected thickness of one material in relative frames [V, H, W], each by itself, and the phase behind it.

    material: δ and β at the reference energy; the phase depends on their ratio alone
    method: one of `optics.retrieval.RETRIEVALS`
    light: where it is uneven, each frame is divided by it. It is found in air; then twice more wherever no matter is,
        after the fringes that the retrieved matter throws there are divided out. Behind matter it goes on smoothly, for
        one frame cannot tell the rest of it from matter.

    Errors: those of `Light.of` and of `Retrieval`, and `InputError` for another method.
    """
    if method not in RETRIEVALS:
        raise InputError(f"method must be one of {', '.join(RETRIEVALS)}, but it is {method!r}.")
    known = checked(frames, exposures, material.delta)
    found = Light.of(known, light)
    air = found.air
    rounds = ROUNDS if found.background is not None and exposures.distance.all() else 0
    for done in range(rounds):
        part = _part(on_progress, done, rounds + 1)
        matter = tikhonov(found.evened(known), exposures, *material, on_progress=part)
        found = _beside(matter, known, exposures, material, air)
    part = _part(on_progress, rounds, rounds + 1)
    thickness = RETRIEVALS[method](found.evened(known), exposures, *material, on_progress=part)
    phase = (-thickness / radian(exposures, material.delta)).to(thickness.dtype)
    return Retrieved(thickness, phase, found)


def _part(on_progress: Advance, done: int, count: int) -> Advance:
    return lambda fraction: on_progress((done + fraction) / count)


def _beside(thickness: Tensor, frames: Tensor, exposures: Exposures, material: DeltaBeta, air: Tensor) -> Light:
    """The light of frames [V, H, W] in air [V, H, W] bool, and beside matter of this thickness [V, H, W], whose fringes
    are divided out."""
    ratio = frames.double() / _predicted(thickness, exposures, material).clamp_min(DARKEST)
    free = torch.from_numpy(np.stack([~_body(one) for one in thickness.detach().cpu().numpy()]))
    seen = free | air
    noise = NoiseModel.of_frames(ratio, seen)
    return Light(seen, noise, Background.of_air(ratio, seen, noise))


def _body(thickness: np.ndarray) -> np.ndarray:
    """Where matter is, [H, W] bool, and a rim about it."""
    return np.asarray(binary_dilation(thickness > BODY * max(np.quantile(thickness, TOP), 0.0), iterations=RIM))


def _predicted(thickness: Tensor, exposures: Exposures, material: DeltaBeta) -> Tensor:
    """Frames [V, H, W], float64, of matter of this thickness [V, H, W] in even light; it goes on beyond the borders."""
    images = []
    for v in range(len(exposures)):
        instrument = Instrument(exposures[[v]], 1, torch.float64)
        (rows, columns), (h, w) = instrument.views.shape, exposures.views.shape
        top, left = (rows - h) // 2, (columns - w) // 2
        beyond = (left, columns - w - left, top, rows - h - top)
        wide = pad(thickness[None, v : v + 1].double(), beyond, mode="replicate")[0]
        images.append(instrument.image(wide * material.beta, wide * material.delta)[0])
    return torch.stack(images)
