"""A simulated experiment as it is declared: what is measured, of what, how, and the information for methods.

Lengths are in metres, angles in degrees, densities in g/cm³. Training draws what is declared here; the benchmark has
files of it, and further kinds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Protocol

import numpy as np

from holosplat.beamline.light import EVEN_LIGHT, UnevenLight
from holosplat.beamline.misalignment import AS_PLANNED, Misalignment
from holosplat.beamline.simulate import simulate
from holosplat.checks import in_range, require, shaped, whole_seed
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.materials import DeltaBeta, parse_material
from holosplat.matter import MaterialPrior
from holosplat.optics.noise import PHOTON_RANGE
from holosplat.optics.propagation import poisson
from holosplat.ranges import (
    Grams,
    Metres,
    Photons,
    Pixels,
    Positive,
    Signed,
    Small,
    Within,
    checked_dataclass,
)
from holosplat.scan import Exposures, Scan
from holosplat.specimens.drawn import FieldKind, Substances, Truth
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene
from holosplat.volume import Volume

from .specimens.matter import ContinuousKind, Declarable

MOST_PIXELS = 4096


@checked_dataclass
class Substance:
    """A preset's name ("plasma"), "vacuum", a formula with its density [g/cm³], or `delta` and `beta` themselves."""

    shorthand: ClassVar[str] = "formula"
    formula: str | None = None
    density: Grams | None = None
    delta: Signed | None = None
    beta: Signed | None = None

    def __post_init__(self) -> None:
        numbers = self.delta is not None and self.beta is not None
        neither = self.delta is None and self.beta is None
        require(
            (numbers and self.formula is None) or (neither and self.formula is not None),
            "a substance must be given by its formula, or by both delta and beta; give one of the two.",
        )
        empty = self.formula in ("vacuum", None)
        require(not empty or self.density is None, "vacuum, or delta and beta, have no density; remove it.")
        if not empty:
            parse_material(self.formula or "", self.density)

    def delta_beta(self, energy_kev: float) -> DeltaBeta:
        """δ and β at `energy_kev` [keV]; those that are given are taken as they are."""
        if self.delta is not None and self.beta is not None:
            return DeltaBeta(self.delta, self.beta)
        if self.formula is None or self.formula == "vacuum":
            return DeltaBeta(0.0, 0.0)
        return parse_material(self.formula, self.density).delta_beta(energy_kev)


@dataclass(frozen=True)
class Matter:
    """material: of the bodies; core: of what is inside them (cores of capsules, bubbles); medium: around them."""

    material: Substance
    core: Substance | None = None
    medium: Substance = Substance("vacuum")


@checked_dataclass
class Beam:
    """energy_kev: photon energy [keV]; distance: effective propagation distance [m]."""

    energy_kev: Positive
    distance: Metres


@checked_dataclass
class Detector:
    """rows, columns: pixels; pixel_size: effective pitch [m]; psf_sigma_px: of its point-spread function [pixels]."""

    rows: Annotated[int, Within(1, MOST_PIXELS)]
    columns: Annotated[int, Within(1, MOST_PIXELS)]
    pixel_size: Small
    psf_sigma_px: Pixels = 0.0


class Directions(Protocol):
    """Views of an experiment."""

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [V, 3, 3], and which of them are held out [V] bool."""
        ...


@checked_dataclass
class Listed:
    """Directions `[angle, tilt]` [degrees] (`geometry.rotation_tilted`) for training, and held out."""

    kind: ClassVar[str] = "listed"
    train: tuple[tuple[Signed, Signed], ...]
    test: tuple[tuple[Signed, Signed], ...]

    def __post_init__(self) -> None:
        for name in ("train", "test"):
            require(len(getattr(self, name)) > 0, f"{name} must list at least one direction.")

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [V, 3, 3], those for training first, and which of them are held out [V] bool."""
        angles, tilts = np.array(self.train + self.test).T
        rotations = rotation_tilted(angles, tilts)
        return rotations, np.arange(len(rotations)) >= len(self.train)


@checked_dataclass
class Declaration:
    """A case without its seed. summary: one line about it; photons: mean counts a pixel of a frame for training, or
    none for frames without noise; prior: for methods, of `matter.material` against the medium; light: how it
    differs from the flat field on frames for training; misalignment: errors of the geometry for methods."""

    summary: str
    specimen: Declarable
    matter: Matter
    beam: Beam
    detector: Detector
    views: Directions
    prior: Literal["known", "ratio", "free"]
    photons: Photons | None = None
    light: UnevenLight = EVEN_LIGHT
    misalignment: Misalignment = AS_PLANNED

    def __post_init__(self) -> None:
        core, wanted = self.matter.core is not None, self.specimen.has_core
        require(
            core or not wanted,
            f"matter.core is missing, which fills the cores of the specimen, {self.specimen.kind}; add it.",
        )
        require(
            wanted or not core,
            f"matter.core must be absent, as the specimen, {self.specimen.kind}, has no cores; remove it.",
        )
        if self.photons is not None:
            in_range("photons", self.photons, *PHOTON_RANGE)
        self.exposures()
        self.material_prior()

    def exposures(self) -> tuple[Exposures, np.ndarray]:
        """How the frames are taken, and which are held out [N] bool."""
        rotations, is_test = self.views.poses()
        raster = (self.detector.rows, self.detector.columns)
        views = Views.from_rotations(rotations, raster, self.detector.pixel_size)
        return Exposures.of(views, self.beam.energy_kev, self.beam.distance, self.detector.psf_sigma_px), is_test

    def material_prior(self) -> MaterialPrior:
        """The information that methods get."""
        contrast = self._delta_beta(self.matter.material).against(self._delta_beta(self.matter.medium))
        if self.prior == "known":
            return MaterialPrior.known(contrast)
        return MaterialPrior.of_ratio(contrast.ratio) if self.prior == "ratio" else MaterialPrior.unknown()

    def scene(self, seed: int, snapshots: Path | None) -> tuple[Truth, str, tuple[Ball, ...]]:
        """The matter that `seed` gives, what it is in words, and the balls of a phantom of balls.

        The core of a mesh adds what it is filled with, less the material around it.
        """
        material, medium = self._delta_beta(self.matter.material), self._delta_beta(self.matter.medium)
        core = None if self.matter.core is None else self._delta_beta(self.matter.core)
        if isinstance(self.specimen, FieldKind):
            found = self.specimen.drawn(Substances(material, core, medium), seed)
            return found.scene, found.text, ()
        if isinstance(self.specimen, ContinuousKind):
            cores = [] if core is None else [core.against(medium)]
            return *self.specimen.continuous(seed, [material.against(medium), *cores]), ()
        bodies = self.specimen.bodies(seed, snapshots)
        filling = [material.against(medium)] * len(bodies.outer)
        if core is not None:
            filling += [core.against(material)] * len(bodies.cores)
        return MeshScene((*bodies.outer, *bodies.cores), tuple(filling)), bodies.text, bodies.balls

    @property
    def goes_on(self) -> bool:
        """Whether the matter, or its medium, goes on beyond the field of view, and is meant to."""
        return self.specimen.goes_on

    def _delta_beta(self, substance: Substance) -> DeltaBeta:
        return substance.delta_beta(self.beam.energy_kev)


@dataclass(frozen=True)
class Case:
    """name: of the case; seed: of its scene and its noise; scene: the truth; exposures: N frames; is_test: [N] bool,
    those held out; prior: of the matter, for every method; photons: a pixel, None without noise; summary: one
    line about the case; specimen: what the scene is, in words; balls: those of a resolution phantom, mesh by mesh;
    light: how it differs from the flat field on the frames for training; misalignment: errors of the exposures, drawn
    with `seed` added to their own.
    Methods get the planned `exposures`; frames are taken in the true ones. goes_on: whether the scene may reach beyond
    the detector."""

    name: str
    seed: int
    scene: Truth
    exposures: Exposures
    is_test: np.ndarray
    prior: MaterialPrior
    photons: float | None = None
    summary: str = ""
    specimen: str = ""
    balls: tuple[Ball, ...] = ()
    light: UnevenLight = EVEN_LIGHT
    misalignment: Misalignment = AS_PLANNED
    goes_on: bool = False

    def __post_init__(self) -> None:
        whole_seed("seed", self.seed)
        is_test = shaped("is_test", np.asarray(self.is_test, dtype=bool), (len(self.exposures),))
        object.__setattr__(self, "is_test", is_test)
        both = bool(is_test.any() and not is_test.all())
        require(both, f"case {self.name} must have frames for training and held-out ones; it has one kind only.")
        missing = self.scene.missing_field(self.exposures.views)
        require(
            missing <= 0 or self.goes_on,
            f"the scene of case {self.name} (seed {self.seed}) must lie within the detector in every view, but it "
            f"reaches {1e6 * missing:.4g} µm beyond; use more pixels, larger ones or a smaller scene.",
        )

    def scan(self) -> Scan:
        """The measured frames: those for training in the case's light and as noisy as `photons` makes them.

        Held-out ones have even light and no noise.
        """
        clean = simulate(self.scene, self.true_exposures(), seed=self.seed, is_test=self.is_test)
        clean = replace(clean, exposures=self.exposures)
        said = {"case": self.name, "specimen": self.specimen}
        if self.photons is None and self.light.is_even:
            return replace(clean, provenance=clean.provenance | said)
        frames = clean.frames.copy()
        if self.photons is not None and self.light.is_even:
            frames[~self.is_test] = poisson(frames[~self.is_test], self.photons, self.seed)
        else:
            lamp = replace(self.light, light_seed=self.light.light_seed + self.seed).on(
                len(frames), self.exposures.views.shape
            )
            noise = np.random.default_rng(self.seed)
            for n in np.flatnonzero(~self.is_test):
                frames[n] = lamp.recorded(frames[n], int(n), self.photons, noise)
        photons = {} if self.photons is None else {"photons_per_pixel": f"{self.photons:g}"}
        said |= photons | self.light.facts() | {"held_out_frames": "noise-free"}
        return replace(clean, frames=frames, provenance=clean.provenance | said)

    def true_exposures(self) -> Exposures:
        """Where the frames are taken."""
        if not self.misalignment:
            return self.exposures
        return replace(self.misalignment, seed=self.misalignment.seed + self.seed).true_exposures(self.exposures)

    def truth(self) -> Volume:
        """The true δ and β on the field of view, at the detector's pitch."""
        return self.scene.voxelise(Grid.of_views(self.exposures.views))


def case_of(declared: Declaration, name: str, seed: int, snapshots: Path | None = None) -> Case:
    """The case that is `declared`, with the scene and the noise of `seed`; errors as those of `load_case`."""
    scene, text, balls = declared.scene(seed, snapshots)
    exposures, is_test = declared.exposures()
    return Case(
        name=name,
        seed=seed,
        scene=scene,
        exposures=exposures,
        is_test=is_test,
        prior=declared.material_prior(),
        photons=declared.photons,
        summary=declared.summary,
        specimen=text,
        balls=balls,
        light=declared.light,
        misalignment=declared.misalignment,
        goes_on=declared.goes_on,
    )
