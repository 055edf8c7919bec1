"""What the configurations of the study are fitted to: a case of the benchmark, in one of several physics settings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from holosplat.beamline.declared.case import Case
from holosplat.checks import InputError
from holosplat.ranges import ranged
from holosplat.scan import Scan
from holosplat.volume import Object, Volume


@dataclass(frozen=True)
@ranged
class Physics:
    """What differs from the case as it is declared; None for nothing.

    distance: of propagation [m]; psf_sigma_px: of the point-spread function [detector pixels]; photons: a pixel of the
    frames for training.
    """

    distance: float | None = None
    psf_sigma_px: float | None = None
    photons: float | None = None

    def of(self, case: Case) -> Case:
        """The case in this physics."""
        given = {"distance": self.distance, "psf_sigma_px": self.psf_sigma_px}
        changed = {name: np.asarray(value) for name, value in given.items() if value is not None}
        photons = case.photons if self.photons is None else self.photons
        return replace(case, exposures=replace(case.exposures, **changed), photons=photons)


PHYSICS = {
    "declared": Physics(),
    "contact": Physics(distance=0.0),
    "far": Physics(distance=0.5),
    "blurred": Physics(psf_sigma_px=0.5),
    "noisy": Physics(photons=2000.0),
}
"""The case as declared (10 cm, a sharp detector, no noise), and four that differ in one thing each: absorption alone,
five times the distance, a point-spread function ten times as wide, 2000 photons a pixel."""


@dataclass(frozen=True)
class Measured:
    """A case, measured once for all configurations: its name and that of its physics, frames, true scene and volume."""

    case: str
    physics: str
    scan: Scan
    scene: Object
    truth: Volume

    @classmethod
    def of(cls, case: Case, physics: str = "declared") -> Measured:
        """Simulate the case and voxelise its truth; `InputError` for unknown physics."""
        if physics not in PHYSICS:
            raise InputError(f"physics must be one of {', '.join(PHYSICS)}, but it is {physics!r}.")
        taken = PHYSICS[physics].of(case)
        return cls(case.name, physics, taken.scan(), taken.scene, taken.truth())


def mean_inside(volume: Volume, truth: Volume) -> tuple[float, float]:
    """Means (δ, β) of `volume` inside the matter of `truth`, weighted by the true δ of each voxel."""
    weight = truth.delta.astype(np.float64) / float(np.sum(truth.delta, dtype=np.float64))
    return float(np.sum(weight * volume.delta)), float(np.sum(weight * volume.beta))
