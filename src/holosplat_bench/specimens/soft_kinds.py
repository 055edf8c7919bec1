"""Soft matter as kinds of `simulate --specimen`: cells, tissue, a head phantom, coated droplets, an absorber."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from holosplat.matter import DeltaBeta
from holosplat.ranges import Many, SomeShare, checked_dataclass
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.drawn import Drawn, FieldKind, Named, Substances
from holosplat.specimens.soft_matter import Box, soft_cells

from .soft_matter import body_with_absorber, coated_droplets, round_cell, shepp_logan, tissue


@dataclass(frozen=True)
class SoftKind(FieldKind):
    """A kind of continuous matter, which has no usual material."""

    named: ClassVar[Named] = (None, None, None)
    extent: ClassVar[float] = 0.85

    @property
    def box(self) -> Box:
        """The extents of a cube [m]."""
        return self.size, self.size, self.size

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The scene that `seed` gives."""
        core = substances.within(self.kind).against(substances.medium) if self.has_core else None
        return Drawn(self.scene(substances.contrast, core, seed), f"{self.kind}, seed {seed}")

    @abstractmethod
    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The scene of matter, and of what is inside it, against the medium."""
        ...


@checked_dataclass
class GradedCells(SoftKind):
    """`soft_cells`: diameters of 0.2 to 0.35 of the size."""

    kind: ClassVar[str] = "soft-cells"
    count: Many = 9
    """Cells."""
    edge: SomeShare = 0.04
    """Width of the edges."""

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The cells."""
        diameters = (0.2 * self.size, 0.35 * self.size)
        return soft_cells(self.count, diameters, self.box, matter, seed, self.edge * self.size)


@checked_dataclass
class GradedCell(SoftKind):
    """`round_cell`."""

    kind: ClassVar[str] = "round-cell"

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The cell."""
        return round_cell(self.size, matter, seed)


@checked_dataclass
class TissuePiece(SoftKind):
    """`tissue`."""

    kind: ClassVar[str] = "tissue"

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The tissue."""
        return tissue(self.box, matter, seed)


@checked_dataclass
class HeadPhantom(SoftKind):
    """`shepp_logan`; the seed changes nothing."""

    kind: ClassVar[str] = "head-phantom"
    edge: SomeShare = 0.04
    """Width of the edges."""

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The phantom."""
        return shepp_logan(self.size, matter, self.edge * self.size)


@checked_dataclass
class Droplets(SoftKind):
    """`coated_droplets`: diameters of 0.18 to 0.36 of the size, a coating of 0.04."""

    kind: ClassVar[str] = "coated-droplets"
    has_core: ClassVar[bool] = True
    count: Many = 9
    """Droplets."""

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The droplets."""
        assert core is not None
        diameters = (0.18 * self.size, 0.36 * self.size)
        return coated_droplets(self.count, diameters, 0.04 * self.size, self.box, (core, matter), seed)


@checked_dataclass
class AbsorberInBody(SoftKind):
    """`body_with_absorber`: a bead of 0.16 of the size."""

    kind: ClassVar[str] = "body-with-absorber"
    has_core: ClassVar[bool] = True

    def scene(self, matter: DeltaBeta, core: DeltaBeta | None, seed: int) -> ContinuousScene:
        """The body and its bead."""
        assert core is not None
        return body_with_absorber((self.size, 0.75 * self.size, 0.9 * self.size), matter, core, 0.16 * self.size, seed)
