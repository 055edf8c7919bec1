"""A case of the benchmark: a true scene, how it is measured, and what the methods are told."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from ..beamline.light import EVEN_LIGHT, UnevenLight
from ..beamline.misalignment import AS_PLANNED, Misalignment
from ..beamline.simulate import simulate
from ..checks import InputError, require, shaped, whole_seed
from ..geometry import Grid
from ..matter import MaterialPrior
from ..optics.detector import poisson
from ..scan import Exposures, Scan
from ..specimens.continuous import ContinuousScene
from ..specimens.phantoms import Ball
from ..specimens.scene import MeshScene
from ..volume import Volume
from .declaration import Declaration, declared_names, read_declaration

FOLDER = Path(__file__).with_name("cases")
"""The suite: a TOML file for each case, or for several that differ little."""
ORDER = ("main", "thesis", "cells", "xmpi", "plasma8", "noise12", "crowded12", "sharp_light")
ORDER += ("misaligned", "two_materials8", "shells8", "foam12")
ORDER += ("soft12", "tissue16", "coated", "absorber12", "contact91")
"""How tables list the files of the suite; others follow by name."""


@dataclass(frozen=True)
class Case:
    """name: of the case; seed: of its scene and its noise; scene: the truth; exposures: N frames; is_test: [N] bool,
    those held out; prior: what every method is told of the matter; photons: a pixel, None without noise; summary: one
    line about the case; specimen: what the scene is, in words; balls: those of a resolution phantom, mesh by mesh;
    light: how it differs from the flat field on the frames for training; misalignment: errors of the exposures, drawn
    with `seed` added to their own. Methods are told the planned `exposures`; frames are taken in the true ones."""

    name: str
    seed: int
    scene: MeshScene | ContinuousScene
    exposures: Exposures
    is_test: np.ndarray
    prior: MaterialPrior
    photons: float | None = None
    summary: str = ""
    specimen: str = ""
    balls: tuple[Ball, ...] = ()
    light: UnevenLight = EVEN_LIGHT
    misalignment: Misalignment = AS_PLANNED

    def __post_init__(self) -> None:
        whole_seed("seed", self.seed)
        is_test = shaped("is_test", np.asarray(self.is_test, dtype=bool), (len(self.exposures),))
        object.__setattr__(self, "is_test", is_test)
        both = bool(is_test.any() and not is_test.all())
        require(both, f"case {self.name} must have frames for training and held-out ones; it has one kind only.")
        missing = self.scene.missing_field(self.exposures.views)
        require(
            missing <= 0,
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


def case_names() -> list[str]:
    """The names of the suite's cases, in the order in which tables list them."""
    return list(_suite())


def load_case(name: str | Path, seed: int = 0, snapshots: Path | None = None) -> Case:
    """The case called `name` with the scene and the noise of `seed`.

    name: of the suite (`case_names`), or a TOML file like those in `bench/cases`, with `:variant` behind
    it where it declares several; snapshots: folder of simulated red cells, `*_000.vtk` … (µm), which cases that have
    `[with_snapshots]` then show; the others are what they are without. `InputError` says what is wrong with a file, and
    where the scene is larger than the field of view.
    """
    whole_seed("seed", seed)
    path, called = _found(str(name))
    declared = read_declaration(path, called, snapshots is not None)
    try:
        return case_of(declared, called, seed, snapshots)
    except InputError as error:
        raise InputError(f"{path}, case {called}: {error}") from None


def planned_frames(name: str | Path, snapshots: Path | None = None) -> tuple[Exposures, np.ndarray]:
    """The exposures of a case, without its scene, and which of them are held out; arguments and errors as those of
    `load_case`."""
    path, called = _found(str(name))
    return read_declaration(path, called, snapshots is not None).exposures()


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
    )


def _found(name: str) -> tuple[Path, str]:
    """The file that declares a case, and what the case is called there."""
    if file := re.fullmatch(r"(.*\.toml)(?::([^/\\]+))?", name):
        path = Path(file[1])
        names = declared_names(path)
        choice = ", ".join(f"{path}:{n}" for n in names)
        require(bool(file[2]) or len(names) == 1, f"{path} declares several cases; choose one of {choice}.")
        return path, file[2] or names[0]
    suite = _suite()
    if name not in suite:
        raise InputError(f"case must be one of {', '.join(suite)}, or a TOML file, but it is {name!r}.")
    return suite[name], name


@cache
def _suite() -> dict[str, Path]:
    """The file of every case."""
    files = sorted(
        FOLDER.glob("*.toml"), key=lambda f: (ORDER.index(f.stem) if f.stem in ORDER else len(ORDER), f.stem)
    )
    return {name: path for path in files for name in declared_names(path)}
