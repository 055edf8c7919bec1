"""The options of the commands, in groups that belong together. Field names are the flags, docstrings their help."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..backends import resolve
from ..checks import require
from ..experiments.settings import MaterialPrior, Settings, preset, read_settings
from ..experiments.simulate import Filling, poses
from ..materials import parse_material, read_material_table
from ..scan import Exposures, interleaved_split


@dataclass(frozen=True)
class MeshOptions:
    """How mesh files are read."""

    length_unit: str = "um"
    """Unit of the mesh files' coordinates."""
    origin: tuple[float, float, float] | None = None
    """Point on the rotation axis at the field's centre, in the files' coordinates (default: the meshes' centre)."""


@dataclass(frozen=True)
class MaterialOptions:
    """What fills the meshes."""

    material: str | None = None
    """Formula, or a preset (haemoglobin, red cell, water, plasma); without --materials, haemoglobin."""
    density: float | None = None
    """Its density [g/cm³]; a preset has its own."""
    medium: str | None = None
    """Formula or preset of what surrounds the meshes; none means vacuum."""
    medium_density: float | None = None
    """The medium's density [g/cm³]."""
    materials: Path | None = None
    """JSON or TOML table of materials by mesh file name, for scenes of several."""

    def filling(self) -> Filling:
        """The materials that the options name."""
        require(self.medium is not None or self.medium_density is None, "--medium-density needs --medium.")
        table = read_material_table(self.materials) if self.materials else {}
        named = self.material or (None if table else "haemoglobin")
        require(named is not None or self.density is None, "--density needs --material.")
        return Filling(
            parse_material(named, self.density) if named else None,
            parse_material(self.medium, self.medium_density) if self.medium is not None else None,
            table,
        )


@dataclass(frozen=True)
class BeamlineOptions:
    """Beam, detector and views."""

    detector: tuple[int, int]
    """Rows and columns of the detector [pixels]."""
    energy_kev: float = 20.0
    """Photon energy [keV]."""
    distance: float = 0.1
    """Effective propagation distance [m]."""
    pixel_size: float = 3.2e-6
    """Effective pixel size [m]."""
    psf_sigma_px: float = 0.0
    """Standard deviation of the Gaussian point-spread function [pixels]."""
    views: int | None = None
    """Number of views, evenly spaced over 180°."""
    angles_deg: tuple[float, ...] = ()
    """Or: the views' angles [degrees]."""
    rotations: Path | None = None
    """Or: a .npy file of rotation matrices [V, 3, 3], x_lab = R x_obj."""
    test_every: int = 4
    """One view in so many is held out of the fit (0: none)."""

    def exposures(self) -> Exposures:
        """How each frame is taken."""
        views = poses(self.views, self.angles_deg, self.rotations, self.detector, self.pixel_size)
        return Exposures.of(views, self.energy_kev, self.distance, self.psf_sigma_px)

    def split(self, count: int) -> np.ndarray:
        """[count] bool: the frames that are held out."""
        every = self.test_every
        require(every == 0 or every > 1, f"--test-every must be 0 (hold out none) or at least 2, but it is {every}.")
        return interleaved_split(count, self.test_every)


@dataclass(frozen=True)
class NoiseOptions:
    """Photon noise."""

    photons_per_pixel: float | None = None
    """Mean photons a pixel for Poisson noise; none means noise-free."""
    seed: int = 0
    """Seed of the noise."""


@dataclass(frozen=True)
class SettingsOptions:
    """How the reconstruction proceeds."""

    preset: str | None = None
    """Named settings: default (what you get without), fast, random, thesis."""
    config: Path | None = None
    """Or: a JSON file of settings, such as the config.json of another run."""
    backend: Literal["auto", "cpu", "cuda", "reference"] | None = None
    """What computes the fit (default: as the settings say, auto); `holosplat backends` lists what there is."""

    def settings(self) -> Settings:
        """The settings that the options name; `InputError` if their backend cannot be used here."""
        require(self.config is None or self.preset is None, "give --config or --preset, not both.")
        chosen = read_settings(self.config) if self.config else preset(self.preset or "default")
        if self.backend:
            start = replace(chosen.volume, backend="reference" if self.backend == "reference" else "cpu")
            chosen = replace(chosen, fit=replace(chosen.fit, backend=self.backend), volume=start)
        resolve(chosen.fit.backend)  # before the start, which takes its time
        return chosen


@dataclass(frozen=True)
class PriorOptions:
    """What is known of the matter; without any of these, δ is free and δ/β is estimated."""

    material: str | None = None
    """Formula or preset of the one material, if known (then δ and β are)."""
    density: float | None = None
    """Its density [g/cm³]; a preset has its own."""
    medium: str | None = None
    """Formula or preset of what surrounds it; none means vacuum."""
    medium_density: float | None = None
    """The medium's density [g/cm³]."""
    delta_beta: float | None = None
    """Or: only the ratio δ/β of the one material is known."""

    def prior(self, energy_kev: float) -> MaterialPrior:
        """The prior at `energy_kev` [keV]."""
        require(self.material is None or self.delta_beta is None, "give --material or --delta-beta, not both.")
        if self.delta_beta is not None:
            alone = self.density is None and self.medium is None and self.medium_density is None
            require(alone, "--density and --medium go with --material, not with --delta-beta.")
            return MaterialPrior.of_ratio(self.delta_beta)
        if self.material is None:
            stray = self.density is not None or self.medium is not None or self.medium_density is not None
            require(not stray, "--density, --medium and --medium-density need --material.")
            return MaterialPrior()
        chosen = MaterialOptions(self.material, self.density, self.medium, self.medium_density)
        return MaterialPrior.known(chosen.filling().of("", energy_kev))
