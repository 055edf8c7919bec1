"""The options of the source: its size, its distance and its spectrum."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import InputError, require
from ..ranges import Many, Metres, Positive, SomeShare, ranged
from .options import BeamlineOptions

if TYPE_CHECKING:
    import numpy as np

    from ..beamline.simulate import Filling, Simulation
    from ..optics.coherence import Spectrum
    from ..scan import Exposures
    from ..specimens.carried import CarriedScene
    from ..specimens.continuous import ContinuousScene
    from ..specimens.mesh_series import MeshSeries
    from ..specimens.rods import RodScene
    from ..specimens.scene import MeshScene, VoxelScene

    Still = MeshScene | ContinuousScene | VoxelScene | CarriedScene | RodScene


NO_SPECTRUM = (
    "a spectrum needs meshes of files, whose materials are known at every energy; leave --bandwidth and --spectrum out."
)


@dataclass(frozen=True)
@ranged
class SourceOptions:
    """What the light comes from; without any of these, a plane wave of one energy."""

    source_size: Metres | None = None
    """Standard deviation of the Gaussian source [m]; it blurs by this times distance / source distance."""
    source_distance: Positive | None = None
    """Distance from source to sample [m]."""
    cone: bool = False
    """--distance and --pixel-size are the detector's own, in a cone beam from --source-distance."""
    bandwidth: SomeShare | None = None
    """Relative full width at half maximum of a Gaussian spectrum about --energy-kev."""
    energies: Many = 7
    """Energies that stand for such a spectrum; each costs a simulation."""
    spectrum: Path | None = None
    """Or: a text file of two columns, energy [keV] and weight; the scan's energy is then their mean."""

    def light(self, energy_kev: float) -> Spectrum | None:
        """The spectrum about `energy_kev` [keV]; None for one energy."""
        from ..beamline.simulate import read_spectrum
        from ..optics.coherence import Spectrum

        require(self.bandwidth is None or self.spectrum is None, "give --bandwidth or --spectrum, not both.")
        if self.spectrum is not None:
            return read_spectrum(self.spectrum)
        return None if self.bandwidth is None else Spectrum.gaussian(energy_kev, self.bandwidth, self.energies)

    def applied(self, beamline: BeamlineOptions) -> BeamlineOptions:
        """The beamline in effective terms: a parallel beam's pixel and distance, the source's blur, the mean energy."""
        from ..optics.coherence import effective_geometry, joined_blur_px, source_blur

        for name in ("source_size", "cone"):
            told = self.source_distance is not None or not getattr(self, name)
            require(told, f"--{name.replace('_', '-')} needs --source-distance.")
        used = self.source_distance is None or self.cone or self.source_size is not None
        require(used, "--source-distance needs --source-size or --cone, without which it changes nothing.")
        light = self.light(beamline.energy_kev)
        if light is not None and self.spectrum is not None:
            beamline = replace(beamline, energy_kev=light.mean_kev)
        if self.source_distance is not None and self.cone:
            found = effective_geometry(self.source_distance, beamline.distance, beamline.pixel_size)
            beamline = replace(beamline, distance=found.distance, pixel_size=found.pixel_size)
        if self.source_distance is not None and self.source_size is not None:
            blur = source_blur(self.source_size, self.source_distance, beamline.distance)
            beamline = replace(
                beamline, psf_sigma_px=float(joined_blur_px(beamline.psf_sigma_px, blur, beamline.pixel_size))
            )
        return beamline

    def frames(
        self, matter: Still | MeshSeries, filling: Filling, exposures: Exposures, how: Simulation
    ) -> Iterator[np.ndarray]:
        """Frames [H, W] of `matter`, one after another."""
        from ..beamline.simulate import polychromatic_frames, refilled, simulated_frames
        from ..specimens.mesh_series import MeshSeries
        from ..specimens.scene import MeshScene

        light = self.light(exposures.one_energy("a simulation"))
        if light is None:
            return simulated_frames(matter, exposures, how)
        if not isinstance(matter, MeshScene | MeshSeries):
            raise InputError(NO_SPECTRUM)
        return polychromatic_frames(lambda energy: refilled(matter, filling, energy), light, exposures, how)

    def facts(self, beamline: BeamlineOptions) -> dict[str, str]:
        """What the scan file says of the source; `beamline` as it was given."""
        said = {name: str(value) for name, value in vars(self).items() if value is not None and name != "energies"}
        said.pop("cone")
        if self.cone:
            said |= {"cone_distance": str(beamline.distance), "cone_pixel_size": str(beamline.pixel_size)}
        return said
