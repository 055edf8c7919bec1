"""What a case can be made of: kinds of specimens, as a case's file declares them, and the bodies they give."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ...checks import InputError, in_range, require
from ...io.vtk import SUFFIXES, read_meshes
from ...matter import DeltaBeta
from ...mesh import TriangleMesh
from ...ranges import Many, ManyOrNone, Metres, Seed, Share, Small, SomeShare, checked_dataclass
from ...specimens.continuous import ContinuousScene
from ...specimens.drawn import SpecimenKind
from ...specimens.matter import FieldMatter
from ...specimens.phantoms import Ball, place_capsules, random_foam, star_of_balls
from ...specimens.red_cells import crowded_cells, random_cells
from ...specimens.repair import closed
from ...specimens.soft_matter import body_with_absorber, coated_droplets, round_cell, shepp_logan, soft_cells, tissue

Extents = tuple[Small, Small, Small]
"""`(x, y, z)` [m]."""


@checked_dataclass
class SoftCells(SpecimenKind):
    """`soft_cells`: `count` of them, the smallest and the largest of `diameters` [m], edges `edge` wide [m]."""

    kind: ClassVar[str] = "soft cells"
    count: Many
    diameters: tuple[Small, Small]
    box: Extents
    edge: Small

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        scene = soft_cells(self.count, self.diameters, self.box, matter[0], seed, self.edge)
        return scene, f"{self.count} soft cells, seed {seed}"


@checked_dataclass
class RoundCell(SpecimenKind):
    """`round_cell` of `diameter` [m]."""

    kind: ClassVar[str] = "round cell"
    diameter: Small

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return round_cell(self.diameter, matter[0], seed), f"a round cell, seed {seed}"


@checked_dataclass
class Tissue(SpecimenKind):
    """`tissue`: a piece in the ellipsoid of extents `box` [m], with so many `cells` and `granules`."""

    kind: ClassVar[str] = "tissue"
    box: Extents
    cells: ManyOrNone = 40
    granules: ManyOrNone = 300

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return tissue(self.box, matter[0], seed, self.cells, self.granules), f"a piece of tissue, seed {seed}"


@checked_dataclass
class SheppLogan(SpecimenKind):
    """`shepp_logan` of `height` [m], edges `edge` wide [m]; the seed changes nothing."""

    kind: ClassVar[str] = "head phantom"
    height: Small
    edge: Metres = 0.0

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The phantom of `matter` against its medium, and what it is in words."""
        return shepp_logan(self.height, matter[0], self.edge), f"the head phantom, for every seed, as for {seed}"


@checked_dataclass
class CoatedDroplets(SpecimenKind):
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
class BodyWithAbsorber(SpecimenKind):
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


Continuous = SoftCells | RoundCell | Tissue | SheppLogan | CoatedDroplets | BodyWithAbsorber
"""Every continuous kind that a case's file may declare."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """Meshes about the rotation axis: `outer` are filled with the case's material, `cores` with its core's instead.

    text: what they are, in words; balls: of a phantom of balls, in the order of `outer`.
    """

    text: str
    outer: Sequence[TriangleMesh]
    cores: Sequence[TriangleMesh] = ()
    balls: tuple[Ball, ...] = ()


@checked_dataclass
class RedCells(SpecimenKind):
    """`random_cells`: `count` cells of `diameter` [m] in the channel `box` [m], of the given `shape`, `deform` and
    `stretch` (without it: as `deform`).

    first_seed: what the case's seed is added to.
    """

    kind: ClassVar[str] = "red cells"
    count: Many
    diameter: Small
    box: Extents
    shape: Literal["cylinder", "box"] = "cylinder"
    deform: Share = 0.03
    first_seed: Seed = 0
    stretch: Share | None = None

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The cells that `seed` gives."""
        seed += self.first_seed
        how = {"shape": self.shape, "stretch": self.stretch}
        cells = random_cells(self.count, self.box, seed, self.diameter, self.deform, **how)
        return Bodies(f"{self.count} generated red cells, seed {seed}", cells)


@checked_dataclass
class CrowdedCells(SpecimenKind):
    """`crowded_cells`: cells of `diameter` [m] that fill the fraction `haematocrit` of a cylinder in `box` [m]."""

    kind: ClassVar[str] = "crowded cells"
    haematocrit: SomeShare
    diameter: Small
    box: Extents
    deform: Share = 0.03

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The cells that `seed` gives."""
        cells = crowded_cells(self.haematocrit, self.box, seed, self.diameter, self.deform)
        text = f"{len(cells)} generated red cells, haematocrit {self.haematocrit:.3g}, seed {seed}"
        return Bodies(text, [cell.mesh(name=f"cell{i:03d}") for i, cell in enumerate(cells)])


@checked_dataclass
class Snapshots(SpecimenKind):
    """One snapshot of simulated cells, `*_000.vtk`, `*_001.vtk` … in a folder (µm), enlarged by `scale`.

    The seed counts through the snapshots, and starts again after the last.
    """

    kind: ClassVar[str] = "snapshots"
    scale: float = 1.0

    def __post_init__(self) -> None:
        in_range("scale", self.scale, 1e-3, 1e3)

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
class Capsules(SpecimenKind):
    """`place_capsules`: `count` of them, the smallest and largest of `diameters` [m], of the thickness `shell` [m]."""

    kind: ClassVar[str] = "capsules"
    has_core: ClassVar[bool] = True
    count: Many
    diameters: tuple[Small, Small]
    shell: Small
    box: Extents
    flattening: Share = 0.2

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The capsules that `seed` gives."""
        capsules = place_capsules(self.diameters, self.count, self.box, self.shell, seed, self.flattening)
        outer = [capsule.outer(name=f"capsule{i:02d}") for i, capsule in enumerate(capsules)]
        cores = [capsule.core(name=f"core{i:02d}") for i, capsule in enumerate(capsules)]
        return Bodies(f"{self.count} capsules, seed {seed}", outer, cores)


@checked_dataclass
class FoamDrop(SpecimenKind):
    """`random_foam`: a drop of diameter `drop` [m], `count` bubbles of log-normal diameters about `median` [m]."""

    kind: ClassVar[str] = "foam"
    has_core: ClassVar[bool] = True
    drop: Small
    count: Many
    median: Small
    spread: float = 0.4

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The foam that `seed` gives; its bubbles are cores."""
        foam = random_foam(self.drop, self.count, self.median, self.spread, seed=seed)
        cores = [bubble.mesh(4, f"bubble{i:03d}") for i, bubble in enumerate(foam.bubbles)]
        return Bodies(f"a drop with {self.count} bubbles, seed {seed}", [foam.drop.mesh(5, "drop")], cores)


@checked_dataclass
class BallStar(SpecimenKind):
    """`star_of_balls`: `2 · spokes` balls of each of the `diameters` [m], on rings that shrink as the balls do."""

    kind: ClassVar[str] = "star of balls"
    diameters: tuple[Small, ...]
    spokes: Many = 8

    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The star that `seed` gives, with its balls."""
        balls = star_of_balls(np.array(self.diameters), seed, self.spokes)
        meshes = [ball.mesh(name=f"ball{i:03d}") for i, ball in enumerate(balls)]
        return Bodies(f"{len(balls)} balls of {len(self.diameters)} diameters, seed {seed}", meshes, balls=tuple(balls))


Meshed = RedCells | CrowdedCells | Snapshots | Capsules | FoamDrop | BallStar
"""Every kind of closed meshes."""
Specimen = Meshed | Continuous | FieldMatter
"""Every kind that a case's file may declare."""
