"""Kinds of generated matter: what each says of itself, and the truth that it gives of substances and a seed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

from torch import Tensor

from ..checks import InputError
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..plugins import Extended
from ..volume import LineIntegrals, Object, Volume


class Truth(Object, Protocol):
    """An Object that a simulation starts from."""

    def missing_field(self, views: Views) -> float:
        """How far [m] it reaches beyond the detector in the worst view."""
        ...


class SpecimenKind:
    """What a kind of specimen says of itself. kind: its name; has_core: whether something else is inside the material;
    goes_on: whether its matter, or the medium around it, goes on beyond the field of view."""

    kind: ClassVar[str]
    has_core: ClassVar[bool] = False
    goes_on: ClassVar[bool] = False


@dataclass(frozen=True, eq=False)
class ChangingScene:
    """A truth that is drawn anew at every time. drawn: the scene at a share of the course, 0 at the first time and 1 at
    the last, which are `duration` [s] apart."""

    drawn: Callable[[float], Truth]
    duration: float = 1.0

    def at(self, time: float) -> Truth:
        """The scene at `time` [s]."""
        return self.drawn(time / self.duration)

    def project(self, views: Views) -> LineIntegrals | tuple[Tensor, Tensor]:
        """Line integrals at the first time."""
        return self.drawn(0.0).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β at the first time."""
        return self.drawn(0.0).voxelise(grid)

    def missing_field(self, views: Views) -> float:
        """How far [m] the scene reaches beyond the detector in the worst view of the first, middle and last time."""
        return max(self.drawn(share).missing_field(views) for share in (0.0, 0.5, 1.0))


VACUUM = DeltaBeta(0.0, 0.0)


@dataclass(frozen=True)
class Substances:
    """δ and β of the material, of what is inside it (None: of the kinds without), and of the medium around."""

    material: DeltaBeta
    core: DeltaBeta | None = None
    medium: DeltaBeta = VACUUM

    @property
    def contrast(self) -> DeltaBeta:
        """The material against the medium."""
        return self.material.against(self.medium)

    def within(self, kind: str) -> DeltaBeta:
        """What is inside; `InputError` where `kind` has none."""
        if self.core is None:
            raise InputError(f"the specimen, {kind}, needs the material that is inside; give it as its core.")
        return self.core


@dataclass(frozen=True)
class Drawn:
    """scene: the truth, against the medium; text: what it is in words; regions: scenes of named parts, filled with
    δ = 1, so that they voxelise to the share of each voxel that the part fills."""

    scene: Truth
    text: str
    regions: Mapping[str, Truth] = field(default_factory=dict)

    def over(self, duration: float) -> Drawn:
        """The same, with the course of what changes spread over `duration` [s]."""

        def spread(scene: Truth) -> Truth:
            return replace(scene, duration=duration) if isinstance(scene, ChangingScene) else scene

        return replace(self, scene=spread(self.scene), regions={k: spread(one) for k, one in self.regions.items()})


Named = tuple[str | None, str | None, str | None]
"""Names of a material (None: it must be given), a core (None: there is none) and a medium (None: vacuum)."""


@dataclass(frozen=True)
class FieldKind(SpecimenKind, ABC):
    """A kind that may fill the field: a frozen dataclass whose fields are its parameters, all but `size` shares of it
    unless they say otherwise. named: names of the usual material, core and medium; extent: the
    usual size, in units of the shorter side of the field of view; changes: whether it changes with time."""

    named: ClassVar[Named]
    extent: ClassVar[float]
    changes: ClassVar[bool] = False
    size: float
    """Its extent [m]."""

    @abstractmethod
    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The truth of `substances` that `seed` gives."""
        ...


KINDS: Extended[type[FieldKind]] = Extended({}, "holosplat.specimens")
"""Name → kind; packages beside this one have them (docs/adding.md)."""
