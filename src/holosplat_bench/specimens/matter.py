"""Kinds of specimens: of matter that may fill the field, or be missing in it, by name; of soft bodies and of meshes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.ranges import Many, Seed, Share, Small, SomeShare, checked_dataclass
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.drawn import SpecimenKind
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.red_cells import crowded_cells, random_cells
from holosplat.specimens.soft_matter import soft_cells

from .changing import Collapse, CrushedLattice, MergingDrops, PinchingJet
from .fluids import BreakUp, Bubbles, Cuvette, Flotation, Jet, Shock
from .gas_waves import ExpandingShock
from .phantoms import place_capsules, random_foam
from .solids import Channel, Crack, Fibres, Keyhole, Lattice, Star

FieldMatter = (
    Bubbles | Flotation | Cuvette | Jet | BreakUp | Crack | Shock | Keyhole | Lattice | Fibres | Channel | Star
)
"""Every kind that stands still (see `drawn` for what each has)."""
Changing = MergingDrops | Collapse | PinchingJet | ExpandingShock | CrushedLattice
"""Every kind that changes with time."""
MATTER: Mapping[str, type[FieldMatter]] = {one.kind: one for one in get_args(FieldMatter)}
"""Name → kind, of those that stand still."""
CHANGING: Mapping[str, type[Changing]] = {one.kind: one for one in get_args(Changing)}
"""Name → kind, of those that change."""

Extents = tuple[Small, Small, Small]
"""`(x, y, z)` [m]."""


class ContinuousKind(SpecimenKind, ABC):
    """A kind of continuous matter."""

    @abstractmethod
    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        ...


@checked_dataclass
class SoftCells(ContinuousKind):
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


@dataclass(frozen=True, eq=False)
class Bodies:
    """Meshes about the rotation axis: `outer` are filled with the case's material, `cores` with its core's instead.

    text: what they are, in words; balls: of a phantom of balls, in the order of `outer`.
    """

    text: str
    outer: Sequence[TriangleMesh]
    cores: Sequence[TriangleMesh] = ()
    balls: tuple[Ball, ...] = ()


class MeshedKind(SpecimenKind, ABC):
    """A kind of closed meshes."""

    @abstractmethod
    def bodies(self, seed: int, snapshots: Path | None) -> Bodies:
        """The bodies that `seed` gives; snapshots: folder of simulated cells, for kinds that need one."""
        ...


@checked_dataclass
class RedCells(MeshedKind):
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
class CrowdedCells(MeshedKind):
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
class Capsules(MeshedKind):
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
class FoamDrop(MeshedKind):
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


Declarable = ContinuousKind | MeshedKind | FieldMatter
"""The kinds that a `Declaration` may be of."""
