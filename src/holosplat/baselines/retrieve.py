"""`retrieve`: measured frames → projected thickness, and the light, whose unevenness and grain the frames show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError
from ..matter import DeltaBeta
from ..optics.background import Light, LightOptions
from ..optics.retrieval import RETRIEVALS, usual_options
from ..optics.retrieval.spectra import checked, radian
from ..preprocess import require_relative
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
    missing: np.ndarray | None = None,
    on_progress: Advance = lambda fraction: None,
) -> Retrieved:
    """Retrieve the phase and the projected thickness of one material from single frames [V, H, W], each by itself.

    frames: [V, H, W] relative to the flat field
    material: δ and β at the reference energy, against the medium; the phase depends on their ratio alone
    method: one of `optics.retrieval.RETRIEVALS`
    light: if the light is uneven, each frame is divided by it. The light is measured in air and continued smoothly
        behind the object; its uncertainty counts as noise there.
    missing: pixels [V, H, W] bool without a value (`Scan.missing`), which have no weight

    Thickness [m] and phase [rad] of the result are tensors [V, H, W]. Errors: `InputError` for another method, a δ that
    is 0, and frames of another shape or not relative to the flat field.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> found = hs.retrieve(scan.frames, scan.exposures, water)
        >>> _, D = scene.project(views)
        >>> print(f"{1e6 * found.thickness.max():.1f} µm, true {1e6 * D.max() / water.delta:.1f} µm")
        7.7 µm, true 7.5 µm
    """
    if method not in RETRIEVALS:
        raise InputError(f"method must be one of {', '.join(RETRIEVALS)}, but it is {method!r}.")
    known = checked(frames, exposures, material.delta)
    require_relative(known.detach().cpu().numpy())
    found = Light.of(known, light)
    retrieval, how = RETRIEVALS[method], dict[str, Any]()
    if found.background is not None:
        how["options"] = replace(usual_options(retrieval), noise=found.doubt)
    how |= {"missing": None if missing is None else torch.from_numpy(missing), "on_progress": on_progress}
    thickness = retrieval(found.evened(known), exposures, *material, **how)
    phase = (-thickness / radian(exposures, material.delta)).to(thickness.dtype)
    return Retrieved(thickness, phase, found)
