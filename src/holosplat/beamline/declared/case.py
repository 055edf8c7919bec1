"""A simulated experiment as a case: a true scene, how it is measured, and the information for methods."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...checks import require, shaped, whole_seed
from ...geometry import Grid
from ...matter import MaterialPrior
from ...optics.detector import poisson
from ...scan import Exposures, Scan
from ...specimens.drawn import Scene
from ...specimens.phantoms import Ball
from ...volume import Volume
from ..light import EVEN_LIGHT, UnevenLight
from ..misalignment import AS_PLANNED, Misalignment
from ..simulate import simulate
from .declaration import Declaration


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
    scene: Scene
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
