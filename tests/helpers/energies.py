"""Frames of several energies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.scan import Exposures
from holosplat.volume import Object


def frames_by_energy(
    matter_at: Callable[[float], Object], exposures: Exposures, how: Simulation
) -> Iterator[np.ndarray]:
    """Frames [H, W] float32 as `simulate.simulated_frames`, of exposures of several energies.

    `matter_at(energy_kev)` is the object with its δ and β at that energy; each frame uses its own energy.
    """
    quiet = how.quiet(exposures)
    detect = how.detector(exposures)
    for i, energy in enumerate(exposures.energy_kev.tolist()):
        own = replace(exposures[[i]], reference_kev=None)
        (frame,) = simulated_frames(matter_at(energy), own, quiet)
        yield detect(frame, i)
