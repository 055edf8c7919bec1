"""One scene for learning: drawn, imaged, and what phase retrieval makes of its frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from ..beamline.declared.case import Case, case_of
from ..beamline.declared.specimens import CrowdedCells, Specimen
from ..checks import InputError
from ..geometry import Grid
from ..learning.images import retrieved_thickness
from ..optics.noise import noise_levels
from ..specimens.scene import MeshScene
from .draw import PURPOSE, drawn
from .ranges import Ranges

FEWER = 0.8
"""Remaining share of the bodies where not all found a place."""


@dataclass(frozen=True)
class Sample:
    """A scene and its frames, those for training first; V frames of H × W pixels.

    contrast: [V, H, W] float16, relative intensity less one
    thickness: [V, H, W] float16, retrieved projected thickness of the material [pixels]; of each frame by itself
    noise: [V] float32, standard deviation of the noise of frames
    rotations, shifts: [V, 3, 3] and [V, 2] [pixels] float64, as `Views` has them
    is_test: [V] bool, frames without noise that are held out
    occupancy: [Z, Y, X] uint8, share of matter in voxels of a pixel, 255 for all; Z = X = W, Y = H; of two materials δ
        over that of the denser one
    facts: [8] float64: pixel size [m], photon energy [keV], distance [m], standard deviation of the point-spread
        function [pixels], photons a pixel (inf: no noise), δ, β (against the medium), and
        the bodies' number or 0
    """

    contrast: np.ndarray
    thickness: np.ndarray
    noise: np.ndarray
    rotations: np.ndarray
    shifts: np.ndarray
    is_test: np.ndarray
    occupancy: np.ndarray
    facts: np.ndarray

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The arrays."""
        return tuple(field.name for field in fields(cls))


def drawn_case(ranges: Ranges, seed: int, index: int) -> Case:
    """The scene number `index` of `seed` as a case; where not all of its bodies find a place, with fewer of them."""
    declared = drawn(ranges, seed, index)
    own = int(np.random.default_rng([PURPOSE, seed, index, 1]).integers(2**31))
    while True:
        try:
            return case_of(declared, f"{seed}-{index}", own)
        except InputError:
            if getattr(declared.specimen, "count", 2) == 1:
                raise
            declared = replace(declared, specimen=_fewer(declared.specimen))


def _fewer(specimen: Specimen) -> Specimen:
    """The same with fewer bodies."""
    if isinstance(specimen, CrowdedCells):
        return replace(specimen, haematocrit=FEWER * specimen.haematocrit)
    count: int = getattr(specimen, "count")  # noqa: B009 (all others have one)
    return replace(specimen, count=max(1, int(FEWER * count)))  # type: ignore[call-arg]


def sample_of(ranges: Ranges, seed: int, index: int) -> Sample:
    """The scene number `index` of `seed`: equal for equal arguments, but for rounding on other machines."""
    case = drawn_case(ranges, seed, index)
    scan, material = case.scan(), case.prior.materials[0]
    frames, views, exposures = torch.from_numpy(scan.frames), scan.views, scan.exposures
    pixel = views.pixel_size
    thickness = retrieved_thickness(frames, exposures, material) / pixel
    truth = case.scene.voxelise(Grid.of_views(views)).delta / material.delta
    photons = math.inf if case.photons is None else case.photons
    optics = (exposures.energy_kev[0], exposures.distance[0], exposures.psf_sigma_px[0])
    return Sample(
        contrast=(scan.frames - 1).astype(np.float16),
        thickness=thickness.numpy().astype(np.float16),
        noise=noise_levels(frames).numpy().astype(np.float32),
        rotations=views.rotations,
        shifts=views.shifts / pixel,
        is_test=scan.is_test,
        occupancy=np.rint(255 * truth.clip(0, 1)).astype(np.uint8),
        facts=np.array([pixel, *optics, photons, *material, _bodies(case)], dtype=np.float64),
    )


def _bodies(case: Case) -> int:
    """How many closed meshes a case has, those of cores among them; 0 where there are none."""
    return len(case.scene.meshes) if isinstance(case.scene, MeshScene) else 0
