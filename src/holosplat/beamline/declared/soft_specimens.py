"""Continuous specimens, as a case's file declares them (`specimens.soft_matter`). Lengths are in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from ...matter import DeltaBeta
from ...ranges import Many, ManyOrNone, Metres, Small, ranged
from ...specimens.continuous import ContinuousScene
from ...specimens.soft_matter import body_with_absorber, coated_droplets, round_cell, shepp_logan, soft_cells, tissue

Extents = tuple[Small, Small, Small]
"""`(x, y, z)` [m]."""


@dataclass(frozen=True)
@ranged
class SoftCells:
    """`soft_cells`: `count` of them, the smallest and the largest of `diameters` [m], edges `edge` wide [m]."""

    kind: ClassVar[str] = "soft cells"
    has_core: ClassVar[bool] = False
    count: Many
    diameters: tuple[Small, Small]
    box: Extents
    edge: Small

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        scene = soft_cells(self.count, self.diameters, self.box, matter[0], seed, self.edge)
        return scene, f"{self.count} soft cells, seed {seed}"


@dataclass(frozen=True)
@ranged
class RoundCell:
    """`round_cell` of `diameter` [m]."""

    kind: ClassVar[str] = "round cell"
    has_core: ClassVar[bool] = False
    diameter: Small

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return round_cell(self.diameter, matter[0], seed), f"a round cell, seed {seed}"


@dataclass(frozen=True)
@ranged
class Tissue:
    """`tissue`: a piece in the ellipsoid of extents `box` [m], with so many `cells` and `granules`."""

    kind: ClassVar[str] = "tissue"
    has_core: ClassVar[bool] = False
    box: Extents
    cells: ManyOrNone = 40
    granules: ManyOrNone = 300

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The scene that `seed` gives of `matter` against its medium, and what it is in words."""
        return tissue(self.box, matter[0], seed, self.cells, self.granules), f"a piece of tissue, seed {seed}"


@dataclass(frozen=True)
@ranged
class SheppLogan:
    """`shepp_logan` of `height` [m], edges `edge` wide [m]; the seed changes nothing."""

    kind: ClassVar[str] = "head phantom"
    has_core: ClassVar[bool] = False
    height: Small
    edge: Metres = 0.0

    def continuous(self, seed: int, matter: Sequence[DeltaBeta]) -> tuple[ContinuousScene, str]:
        """The phantom of `matter` against its medium, and what it is in words."""
        return shepp_logan(self.height, matter[0], self.edge), f"the head phantom, for every seed, as for {seed}"


@dataclass(frozen=True)
@ranged
class CoatedDroplets:
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


@dataclass(frozen=True)
@ranged
class BodyWithAbsorber:
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
