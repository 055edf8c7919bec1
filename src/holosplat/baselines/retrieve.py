"""`retrieve`: measured frames → projected thickness, and the light, whose unevenness and grain the frames show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ..checks import InputError
from ..materials import DeltaBeta
from ..optics.background import Light, LightOptions
from ..optics.retrieval import RETRIEVALS
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
    """The projected thickness of one material in relative frames [V, H, W], each by itself.

    method: one of `optics.retrieval.RETRIEVALS`. Where the light is uneven, each frame is divided by what its air shows
    of it, continued smoothly to where matter is; one frame alone cannot tell the rest of it from matter. Errors:
    those of `Light.of` and of `Retrieval`, and `InputError` for another method.
    """
    if method not in RETRIEVALS:
        raise InputError(f"method must be one of {', '.join(RETRIEVALS)}, but it is {method!r}.")
    known = checked(frames, exposures, material.delta)
    found = Light.of(known, light)
    thickness = RETRIEVALS[method](found.evened(known), exposures, *material, on_progress=on_progress)
    phase = (-thickness / radian(exposures, material.delta)).to(thickness.dtype)
    return Retrieved(thickness, phase, found)
