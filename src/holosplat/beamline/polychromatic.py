"""Frames of light of many energies: each energy sees its own δ, β and wavelength, and intensities add."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..checks import InputError, require_regular
from ..optics.coherence import Spectrum
from ..scan import Exposures
from ..specimens.mesh_series import MeshSeries
from ..specimens.scene import MeshScene
from ..volume import Object
from .scenes import Filling
from .simulate import Simulation, simulated_frames


def polychromatic_frames(
    matter_at: Callable[[float], Object], spectrum: Spectrum, exposures: Exposures, how: Simulation
) -> Iterator[np.ndarray]:
    """Frames [H, W] float32 as `simulate.simulated_frames`, but of light with a `spectrum`.

    `matter_at(energy_kev)` is the object with its δ and β at that energy. A frame is `Σ w_e I_e`, each energy's
    intensity relative to its own flat; light and photon noise come last. All energies are sampled as the exposures'
    own is.
    """
    quiet = how.quiet(exposures)
    parts = [
        simulated_frames(matter_at(energy), replace(exposures, energy_kev=energy, reference_kev=None), quiet)
        for energy in map(float, spectrum.energies_kev)
    ]
    detect = how.detector(exposures)
    for i, of_energies in enumerate(zip(*parts)):
        yield detect(np.tensordot(spectrum.weights, np.stack(of_energies), 1), i)


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


def refilled(matter: MeshScene | MeshSeries, filling: Filling, energy_kev: float) -> MeshScene | MeshSeries:
    """The same bodies, filled with their materials' δ and β at `energy_kev` [keV]."""
    if isinstance(matter, MeshSeries):
        return replace(matter, snapshots=tuple(_refilled(scene, filling, energy_kev) for scene in matter.snapshots))
    return _refilled(matter, filling, energy_kev)


def _refilled(scene: MeshScene, filling: Filling, energy_kev: float) -> MeshScene:
    return replace(scene, materials=tuple(filling.of(mesh.name, energy_kev) for mesh in scene.meshes))


def read_spectrum(path: Path) -> Spectrum:
    """A spectrum from a text file of two columns, energy [keV] and weight; `#` begins a comment."""
    require_regular(path, "a text file of energies and weights (--spectrum)")
    try:
        table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError):
        table = np.empty((0, 0))
    if table.shape[1] != 2 or len(table) == 0:
        raise InputError(
            f"{path} must hold two columns of numbers, energy [keV] and weight, but it does not; correct it."
        )
    return Spectrum(table[:, 0], table[:, 1])
