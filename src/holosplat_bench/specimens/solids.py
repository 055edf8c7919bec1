"""Solids that may fill the field: a crack, a keyhole, a lattice, fibres, a channel and a star, each drawn from a seed.

Lengths named `size` are in metres; all others are shares of it. Matter is said against the medium.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from holosplat.checks import require
from holosplat.ranges import Many, ManyOrNone, Share, Small, SomeShare, checked_dataclass
from holosplat.specimens.drawn import Drawn, FieldKind, Named, Substances
from holosplat.specimens.red_cells import random_cells

from .rods import Rod, RodScene
from .shapes import LONG, SHARE, ball_meshes, box_mesh, column, lathe, meshed, prism, region, rough_lens

HURST = 0.8
"""Exponent of the roughness of fracture surfaces (Bouchaud 1997, J. Phys. Condens. Matter 9, 4319)."""
MODES = 60
"""Waves whose sum is a rough surface."""


@checked_dataclass
class Crack(FieldKind):
    """A penny-shaped crack with rough faces in a block that is larger than the field."""

    kind: ClassVar[str] = "crack"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("air", None, "PMMA")
    extent: ClassVar[float] = 0.8
    size: Small
    """Diameter of the crack [m]."""
    opening: SomeShare = 0.035
    """Opening in its middle."""
    roughness: Share = 0.02
    """Standard deviation of the height of its middle surface."""
    tilt: Share = 0.3
    """Largest angle between its normal and the plane across the rotation axis, in units of a right angle."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The orientation and the faces that `seed` gives."""
        rng = np.random.default_rng(seed)
        turn, lean = rng.uniform(0, 2 * np.pi), 0.5 * np.pi * self.tilt * rng.uniform(-1, 1)
        normal = np.array([np.cos(lean) * np.cos(turn), np.sin(lean), np.cos(lean) * np.sin(turn)])
        first = np.array([-np.sin(turn), 0.0, np.cos(turn)])
        frame = np.stack([first, np.cross(normal, first), normal])
        crack = rough_lens(0.5 * self.size, self.opening * self.size, self._modes(rng), frame, "crack")
        return Drawn(meshed([([crack], substances.contrast)]), f"a crack, seed {seed}", {"crack": region(crack)})

    def _modes(self, rng: np.random.Generator) -> np.ndarray:
        """Waves [M, 4] of a self-affine surface, from the size down to a twentieth of it (see `rough_lens`)."""
        number = 2 * np.pi / self.size * np.exp(rng.uniform(0, np.log(20), MODES))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, MODES))
        height = number**-HURST  # of waves drawn evenly in the logarithm of their number
        height *= self.roughness * self.size / np.sqrt(0.5 * (height**2).sum())
        return np.column_stack([number * np.cos(angle), number * np.sin(angle), phase, height])


@checked_dataclass
class Keyhole(FieldKind):
    """The vapour cavity of a laser weld in a square bar, which goes on below, with pores behind it.

    The beam comes from above (-y). Cavity and pores hold what is around the bar.
    """

    kind: ClassVar[str] = "keyhole"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("titanium", None, None)
    extent: ClassVar[float] = 0.6
    size: Small
    """Width of the bar [m]."""
    count: ManyOrNone = 3
    """Number of pores."""
    depth: SomeShare = 0.75
    """Depth of the cavity."""
    width: SomeShare = 0.18
    """Mean width of the cavity."""
    lean: Share = 0.15
    """How far its tip lies behind its mouth, along x."""
    radii: tuple[SomeShare, SomeShare] = (0.04, 0.08)
    """Radii of the smallest and of the largest pore."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The mouth's place and the pores that `seed` gives."""
        high = self.radii[1]
        room = 0.5 - 0.7 * self.width - 2 * high
        require(self.lean <= room, f"lean must be at most {room:.3g} beside these pores, but it is {self.lean:g}.")
        rng, size = np.random.default_rng(seed), self.size
        top, u = -0.5 * size, np.sin(0.5 * np.pi * np.linspace(0, 1, 65))
        mouth = size * (np.array([-0.1, 0.0]) + 0.02 * rng.uniform(-1, 1, 2))
        path = mouth + self.lean * size * u[:, None] ** 2 * np.array([1.0, 0.0])
        wide = np.sqrt(np.maximum(1 - u**6, 0)) * (1.2 - 1.1 * u + 0.9 * u**2)
        cavity = lathe(top + self.depth * size * u, 0.5 * self.width * size * wide, "keyhole", path)
        bar = box_mesh((-0.5 * size, top, -0.5 * size), (0.5 * size, top + LONG * size, 0.5 * size), "bar")
        behind = path[-1, 0] / size + 0.8 * self.width
        box = ((0.48 - behind) * size, 0.45 * size, 0.6 * size)
        centre = np.array([0.5 * (0.48 + behind) * size, top + self.depth * size, 0.0])
        pores = [
            pore.transformed(np.eye(3), centre) for pore in ball_meshes(self.count, self.radii, size, box, rng, "box")
        ]
        holes = [cavity, *pores]
        scene = meshed([([bar], substances.contrast), (holes, substances.medium.against(substances.material))])
        parts = {"keyhole": region(cavity)} | ({"pores": region(*pores)} if pores else {})
        return Drawn(scene, f"a keyhole with {self.count} pores, seed {seed}", parts)


@checked_dataclass
class Lattice(FieldKind):
    """A cube of body-centred cubic unit cells, whose struts lead from the corners to the middle of each."""

    kind: ClassVar[str] = "lattice"
    named: ClassVar[Named] = ("PMMA", None, None)
    extent: ClassVar[float] = 0.6
    size: Small
    """Edge of the cube [m]."""
    count: Many = 2
    """Unit cells along an edge."""
    strut: SomeShare = 0.14
    """Diameter of a strut, in edges of a unit cell."""
    missing: Share = 0.05
    """Share of half struts that are not there."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The lattice without the struts that `seed` takes."""
        require(self.count <= 8, f"count must be at most 8 unit cells an edge, but it is {self.count}.")
        rng, n = np.random.default_rng(seed), self.count
        edge = self.size / (n + self.strut)  # struts end in balls about the outer corners
        cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 1, 3) - 0.5 * (n - 1)
        corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
        ends = edge * np.stack(np.broadcast_arrays(cells + 0 * corners, cells + corners), axis=-2).reshape(-1, 2, 3)
        there = rng.random(len(ends)) >= self.missing
        radius = 0.5 * self.strut * edge
        rods = tuple(Rod(start, end, radius) for start, end in ends[there])
        scene = RodScene(rods, substances.contrast)
        text = f"a lattice of {n**3} cells, {len(rods)} of {len(ends)} half struts, seed {seed}"
        return Drawn(scene, text, {"struts": RodScene(rods, SHARE)})


@checked_dataclass
class Fibres(FieldKind):
    """Thin straight fibres about the direction of the rotation axis, which go on above and below."""

    kind: ClassVar[str] = "fibres"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("nylon", None, None)
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter of the cylinder through whose middle plane they go [m]."""
    count: Many = 6
    """Their number."""
    diameter: SomeShare = 0.02
    """Diameter of a fibre."""
    lean: Share = 0.25
    """Largest slope against the axis, along x and along z."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The fibres that `seed` gives."""
        rng = np.random.default_rng(seed)
        far, angle = 0.5 * self.size * np.sqrt(rng.uniform(0, 0.6, self.count)), rng.uniform(0, 2 * np.pi, self.count)
        slopes, half = rng.uniform(-self.lean, self.lean, (self.count, 2)), 0.5 * LONG * self.size
        rods = []
        for r, at, (a, b) in zip(far, angle, slopes):
            middle, way = np.array([r * np.cos(at), 0.0, r * np.sin(at)]), np.array([a, 1.0, b])
            rods.append(Rod(middle - half * way, middle + half * way, 0.5 * self.diameter * self.size))
        scene = RodScene(tuple(rods), substances.contrast)
        return Drawn(scene, f"{self.count} fibres, seed {seed}", {"fibres": RodScene(scene.rods, SHARE)})


@checked_dataclass
class Channel(FieldKind):
    """A channel along the rotation axis in a block that is larger than the field: three materials.

    The medium is the block's, the material is the liquid in the channel, and the core that of the red cells in it.
    """

    kind: ClassVar[str] = "channel"
    has_core: ClassVar[bool] = True
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("plasma", "red cell", "glass")
    extent: ClassVar[float] = 0.65
    size: Small
    """Width of the channel along x [m]."""
    count: Many = 10
    """Number of red cells."""
    depth: SomeShare = 0.7
    """Width along z."""
    diameter: SomeShare = 0.28
    """Diameter of a red cell."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The cells that `seed` gives."""
        size, deep = self.size, self.depth * self.size
        cells = random_cells(self.count, (size, 1.3 * size, deep), seed, self.diameter * size, shape="box")
        channel = column(size, deep, LONG * size, "channel")
        inside = substances.within(self.kind).against(substances.material)
        scene = meshed([([channel], substances.contrast), (cells, inside)])
        parts = {"liquid": region(channel, without=cells), "cells": region(*cells)}
        return Drawn(scene, f"a channel with {self.count} red cells, seed {seed}", parts)


@checked_dataclass
class Star(FieldKind):
    """A Siemens star in a plane that holds the rotation axis: wedges with gaps as wide, which shows the resolution.

    Along the axis and across it the period at the radius r is 2π r / `spokes`.
    """

    kind: ClassVar[str] = "star"
    named: ClassVar[Named] = ("PMMA", None, None)
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter [m]."""
    spokes: Many = 16
    """Number of wedges."""
    thickness: SomeShare = 0.12
    """Extent across the plane."""
    hole: SomeShare = 0.1
    """Diameter of the empty middle."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The star, turned in its plane by what `seed` gives."""
        require(self.spokes >= 3, f"spokes must be at least 3, but it is {self.spokes}.")
        require(self.hole < 0.9, f"hole must be below 0.9 of the size, but it is {self.hole:g}.")
        turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        radii, half = 0.5 * self.size * np.array([self.hole, 1.0]), 0.5 * self.thickness * self.size
        wedges = []
        for n in range(self.spokes):
            edges = turn + 2 * np.pi * (n + np.array([0, 0.5])) / self.spokes
            rim = np.linspace(edges[0], edges[1], 9)
            angles = np.concatenate([[edges[0]], rim, [edges[1]]])
            at = np.concatenate([radii[:1], np.full(len(rim), radii[1]), radii[:1]])
            outline = np.column_stack([at * np.cos(angles), at * np.sin(angles)])
            wedges.append(prism(outline, (-half, half), f"spoke{n:02d}"))
        scene = meshed([(wedges, substances.contrast)])
        return Drawn(scene, f"a star of {self.spokes} spokes, seed {seed}", {"spokes": region(*wedges)})
