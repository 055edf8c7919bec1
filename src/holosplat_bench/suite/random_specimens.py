"""Specimens at random: a function a kind, within the room that every view sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from holosplat.beamline.declared.specimens import (
    BallStar,
    BodyWithAbsorber,
    Capsules,
    CoatedDroplets,
    CrowdedCells,
    FoamDrop,
    RedCells,
    RoundCell,
    SheppLogan,
    SoftCells,
    Specimen,
    Tissue,
)


@dataclass(frozen=True)
class Room:
    """d: diameter of a body; wide, deep: extents of the field that every view sees, and of its columns and rows [m]."""

    d: float
    wide: float
    high: float
    columns: float

    @property
    def box(self) -> tuple[float, float, float]:
        """[m]."""
        return (self.wide, self.high, self.wide)

    @property
    def least(self) -> float:
        """[m]."""
        return min(self.high, self.columns)


Draw = np.random.Generator
"""What specimens are drawn by."""


def _red_cells(rng: Draw, room: Room) -> Specimen:
    box = (room.columns, room.high, room.columns)
    return RedCells(int(rng.integers(1, 12)), room.d, box, "cylinder", rng.uniform(0, 0.08), 0, rng.uniform(0, 0.3))


def _crowd(rng: Draw, room: Room) -> Specimen:
    x, y = min(room.wide, 3 * room.d), min(room.high, 3 * room.d)
    return CrowdedCells(rng.uniform(0.1, 0.3), room.d, (x, y, x))


def _capsules(rng: Draw, room: Room) -> Specimen:
    diameters = (0.6 * room.d, room.d)
    return Capsules(int(rng.integers(1, 8)), diameters, room.d * rng.uniform(0.08, 0.2), room.box, rng.uniform(0, 0.3))


def _foam(rng: Draw, room: Room) -> Specimen:
    return FoamDrop(room.least, int(rng.integers(5, 25)), rng.uniform(0.3, 0.6) * room.d)


def _star(rng: Draw, room: Room) -> Specimen:
    return BallStar((0.1 * room.d, 0.25 * room.d, 0.6 * room.d), int(rng.integers(4, 9)))


def _soft_cells(rng: Draw, room: Room) -> Specimen:
    return SoftCells(int(rng.integers(2, 9)), (0.7 * room.d, 1.3 * room.d), room.box, room.d * rng.uniform(0.05, 0.2))


def _coated(rng: Draw, room: Room) -> Specimen:
    return CoatedDroplets(int(rng.integers(2, 8)), (0.6 * room.d, room.d), room.d * rng.uniform(0.08, 0.2), room.box)


KINDS: dict[str, tuple[Callable[[Draw, Room], Specimen], Callable[[Room], float]]] = {
    "red-cells": (_red_cells, lambda room: 0.33 * room.d),
    "crowd": (_crowd, lambda room: 0.6 * room.d),
    "capsules": (_capsules, lambda room: 0.3 * room.d),
    "foam": (_foam, lambda room: 0.5 * room.least),
    "star": (_star, lambda room: 0.4 * room.d),
    "soft-cells": (_soft_cells, lambda room: room.d),
    "round": (lambda rng, room: RoundCell(room.least * rng.uniform(0.45, 1)), lambda room: 0.5 * room.least),
    "tissue": (
        lambda rng, room: Tissue(room.box, int(rng.integers(10, 50)), int(rng.integers(50, 400))),
        lambda room: 0.5 * room.least,
    ),
    "head": (lambda rng, room: SheppLogan(room.least * rng.uniform(0.65, 1)), lambda room: 0.5 * room.least),
    "coated": (_coated, lambda room: room.d),
    "absorber": (
        lambda rng, room: BodyWithAbsorber(
            (0.9 * room.wide, 0.7 * room.high, 0.8 * room.wide), 0.09 * room.wide, int(rng.integers(1, 4))
        ),
        lambda room: 0.5 * room.least,
    ),
}
"""How each kind is drawn, and about how thick it is, for its phase."""
