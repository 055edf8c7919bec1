"""`retrieve`: measured frames → projected thickness, and the light, whose unevenness and grain the frames show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ..checks import InputError
from ..matter import DeltaBeta
from ..optics.background import Light, LightOptions
from ..optics.retrieval import RETRIEVAL_OPTIONS, RETRIEVALS
from ..optics.retrieval.spectra import checked, radian
from ..progress import Advance
from ..scan import Exposures

EVEN_OR_NOT = LightOptions()


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
    light: where it is uneven, each frame is divided by it. It is found in air; behind matter it goes on smoothly, for
        one frame cannot tell the rest of it from matter, and what is not known of it counts as noise.

    Errors: those of `Light.of` and of `Retrieval`, and `InputError` for another method.
    """
    if method not in RETRIEVALS:
        raise InputError(f"method must be one of {', '.join(RETRIEVALS)}, but it is {method!r}.")
    known = checked(frames, exposures, material.delta)
    found = Light.of(known, light)
    how = {} if found.background is None else {"options": RETRIEVAL_OPTIONS[method](noise=found.doubt)}
    thickness = RETRIEVALS[method](found.evened(known), exposures, *material, **how, on_progress=on_progress)
    phase = (-thickness / radian(exposures, material.delta)).to(thickness.dtype)
    return Retrieved(thickness, phase, found)
