"""The cases of the benchmark: the files of the suite, cases by name or from a file of one's own, and the kinds of
specimens and of views that these files alone have.

A file is one case, or, with tables `[variants.NAME]`, as many cases that say what differs. `[with_snapshots]` says what
differs where a folder of simulated cells is given.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from holosplat.checks import InputError, require, whole_seed
from holosplat.geometry import rotation_y
from holosplat.io.vtk import SUFFIXES, read_meshes
from holosplat.matter import DeltaBeta
from holosplat.ranges import Many, ManyOrNone, Metres, Small, Within, checked_dataclass
from holosplat.scan import Exposures, interleaved_split
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.repair import closed
from holosplat.tables import from_table, merged, read_table

from ..declaration import Case, Declaration, Listed, case_of
from ..specimens.matter import (
    Bodies,
    Capsules,
    ContinuousKind,
    CrowdedCells,
    Extents,
    FieldMatter,
    FoamDrop,
    MeshedKind,
    RedCells,
    SoftCells,
)
from ..specimens.phantoms import star_of_balls
from ..specimens.soft_matter import body_with_absorber, coated_droplets, round_cell, shepp_logan, tissue


@checked_dataclass
class Interleaved:
    """`count` views evenly over 180° about the y axis, the last of every `hold_out_every` held out."""

    kind: ClassVar[str] = "interleaved"
    count: Many
    hold_out_every: Many = 4

    def __post_init__(self) -> None:
        enough = 2 <= self.hold_out_every <= self.count
        require(enough, f"hold_out_every must lie between 2 and count, {self.count}, but it is {self.hold_out_every}.")

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [V, 3, 3], and which of them are held out [V] bool."""
        angles = np.arange(self.count) * (180 / self.count)
        return rotation_y(angles), interleaved_split(self.count, self.hold_out_every)


@checked_dataclass
class Between:
    """`train` views evenly over 180° about the y axis, and `test` held-out ones, each in the middle of a gap."""

    kind: ClassVar[str] = "between"
    train: Many
    test: ManyOrNone

    def __post_init__(self) -> None:
        require(
            1 <= self.test <= self.train, f"test must lie between 1 and train, {self.train}, but it is {self.test}."
        )

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [V, 3, 3], those for training first, and which of them are held out [V] bool."""
        gaps = np.floor((np.arange(self.test) + 0.5) * self.train / self.test)
        angles = np.concatenate([np.arange(self.train), gaps + 0.5]) * (180 / self.train)
        return rotation_y(angles), np.arange(len(angles)) >= self.train


@checked_dataclass
class RoundCell(ContinuousKind):
    """`round_cell` of `diameter` [m]."""

    kind: ClassVar[str] = "round cell"
    diameter: Small

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return round_cell(self.diameter, matter[0], seed), f"a round cell, seed {seed}"


@checked_dataclass
class Tissue(ContinuousKind):
    """`tissue`: a piece in the ellipsoid of extents `box` [m], with so many `cells` and `granules`."""

    kind: ClassVar[str] = "tissue"
    box: Extents
    cells: ManyOrNone = 40
    granules: ManyOrNone = 300

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return tissue(self.box, matter[0], seed, self.cells, self.granules), f"a piece of tissue, seed {seed}"


@checked_dataclass
class SheppLogan(ContinuousKind):
    """`shepp_logan` of `height` [m], edges `edge` wide [m]; the seed changes nothing."""

    kind: ClassVar[str] = "head phantom"
    height: Small
    edge: Metres = 0.0

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The phantom of `matter` against its medium, and what it is in words."""
        return shepp_logan(self.height, matter[0], self.edge), f"the head phantom, for every seed, as for {seed}"


@checked_dataclass
class CoatedDroplets(ContinuousKind):
    """`coated_droplets`: `count` of them, the smallest and largest of `diameters` [m], `coating` thick [m]; their
    coating is the case's material, and what is in them is its core."""

    kind: ClassVar[str] = "coated droplets"
    has_core: ClassVar[bool] = True
    count: Many
    diameters: tuple[Small, Small]
    coating: Small
    box: Extents

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        shell, core = matter
        scene = coated_droplets(self.count, self.diameters, self.coating, self.box, (core, shell), seed)
        return scene, f"{self.count} coated droplets, seed {seed}"


@checked_dataclass
class BodyWithAbsorber(ContinuousKind):
    """`body_with_absorber`: a body of extents `size` [m], and in it `beads` of the case's core, of diameter `bead`."""

    kind: ClassVar[str] = "body with absorber"
    has_core: ClassVar[bool] = True
    size: Extents
    bead: Small
    beads: Many = 1

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        soft, absorber = matter
        scene = body_with_absorber(self.size, soft, absorber, self.bead, seed, self.beads)
        return scene, f"a soft body with {self.beads} beads, seed {seed}"


@checked_dataclass
class Snapshots(MeshedKind):
    """One snapshot of simulated cells, `*_000.vtk`, `*_001.vtk` … in a folder (µm), enlarged by `scale`.

    The seed counts through the snapshots, and starts again after the last.
    """

    kind: ClassVar[str] = "snapshots"
    scale: Annotated[float, Within(1e-3, 1e3)] = 1.0

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The cells of the snapshot that `seed` gives, closed, about the middle of their bounding box."""
        if snapshots is None:
            raise InputError("this specimen is read from VTK files, but no folder of snapshots is given; give one.")
        require(snapshots.is_dir(), f"the folder of snapshots must exist, but {snapshots} does not.")
        found = [(path, re.search(r"_(\d{3})$", path.stem)) for path in sorted(snapshots.iterdir())]
        numbered = [(path, match[1]) for path, match in found if match and path.suffix.lower() in SUFFIXES]
        numbers = sorted({number for _, number in numbered})
        require(len(numbers) > 0, f"{snapshots} must hold snapshots named *_000.vtk, *_001.vtk …, but it holds none.")
        number = numbers[seed % len(numbers)]
        meshes = [closed(mesh) for mesh in read_meshes([p for p, of in numbered if of == number], "um")]
        low, high = zip(*(mesh.bounds for mesh in meshes))
        middle = 0.5 * (np.min(low, axis=0) + np.max(high, axis=0))
        scaled = [m.transformed(self.scale * np.eye(3), -self.scale * middle) for m in meshes]
        return Bodies(f"{len(meshes)} red cells, snapshot {number}", scaled)


@checked_dataclass
class BallStar(MeshedKind):
    """`star_of_balls`: `2 · spokes` balls of each of the `diameters` [m], on rings that shrink as the balls do."""

    kind: ClassVar[str] = "star of balls"
    diameters: tuple[Small, ...]
    spokes: Many = 8

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The star that `seed` gives, with its balls."""
        balls = star_of_balls(np.array(self.diameters), seed, self.spokes)
        meshes = [ball.mesh(name=f"ball{i:03d}") for i, ball in enumerate(balls)]
        return Bodies(f"{len(balls)} balls of {len(self.diameters)} diameters, seed {seed}", meshes, balls=tuple(balls))


Specimen = (
    RedCells
    | CrowdedCells
    | Snapshots
    | Capsules
    | FoamDrop
    | BallStar
    | SoftCells
    | RoundCell
    | Tissue
    | SheppLogan
    | CoatedDroplets
    | BodyWithAbsorber
    | FieldMatter
)
"""Every kind that a case's file may declare."""


@checked_dataclass
class FileOfCase(Declaration):
    """A `Declaration` of one of the kinds that files may name."""

    specimen: Specimen
    views: Interleaved | Between | Listed


def declared_names(path: Path) -> list[str]:
    """The cases of a file: its variants, or, without any, one by the file's own name."""
    return list(_variants(path, read_table(path))) or [path.stem]


def read_declaration(path: Path, name: str, with_snapshots: bool = False) -> FileOfCase:
    """The case `name` of a file, checked; `InputError` names the file and the entry at fault.

    with_snapshots: whether simulated cells are at hand, such that the file's `[with_snapshots]` applies.
    """
    tables = read_table(path)
    variants = _variants(path, tables)
    known = ", ".join(variants) or path.stem
    require(
        name in variants or (not variants and name == path.stem),
        f"the case must be one of those in {path}, {known}, but it is {name!r}.",
    )
    plain = {key: value for key, value in tables.items() if key not in ("variants", "with_snapshots")}
    where_given = tables.get("with_snapshots", {})
    require(isinstance(where_given, dict), f"{path}: with_snapshots must be a table, but it is {where_given!r}.")
    if with_snapshots:
        plain = merged(plain, where_given)
    try:
        return from_table(FileOfCase, merged(plain, variants.get(name, {})))
    except InputError as error:
        raise InputError(f"{path}, case {name}: {error}") from None


def _variants(path: Path, tables: dict[str, Any]) -> dict[str, Any]:
    variants = tables.get("variants", {})
    good = isinstance(variants, dict) and all(isinstance(changes, dict) for changes in variants.values())
    require(good, f"{path}: variants must be tables [variants.NAME], but it is {variants!r}.")
    return variants


FOLDER = Path(__file__).with_name("cases")
"""The suite: a TOML file for each case, or for several that differ little."""
ORDER = ("main", "thesis", "cells", "xmpi", "plasma8", "noise12", "crowded12", "sharp_light")
ORDER += ("misaligned", "two_materials8", "shells8", "foam12")
ORDER += ("soft12", "tissue16", "coated", "absorber12", "contact91", "matter")
"""How tables list the files of the suite; others follow by name."""


def case_names() -> list[str]:
    """The names of the suite's cases, in the order in which tables list them."""
    return list(_suite())


def load_case(name: str | Path, seed: int = 0, snapshots: Path | None = None) -> Case:
    """The case called `name` with the scene and the noise of `seed`.

    name: of the suite (`case_names`), or a TOML file like those in `suite/cases`, with `:variant` behind
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
