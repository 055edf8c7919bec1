"""What the kinds of matter of `specimens.fluids` and `specimens.solids` are made of, and what a draw of them gives.

Each kind is a frozen dataclass: its parameters are the fields, with `size` [m] first and all others shares of it unless
they say otherwise, and `drawn(substances, seed)` gives a `Drawn`. Of its class it has

- `kind`: its name;
- `has_core`: whether something else is inside the material;
- `goes_on`: whether its matter, or the medium around it, goes on beyond the field of view;
- `named`: names of the usual material, core and medium (None: no core; vacuum);
- `extent`: the usual size, in units of the shorter side of the field of view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..checks import InputError, require
from ..matter import DeltaBeta
from ..mesh import TriangleMesh
from .continuous import ContinuousScene
from .phantoms import packed_balls
from .rods import RodScene
from .scene import MeshScene

Scene = MeshScene | ContinuousScene | RodScene
"""The truths that a kind may give."""
LONG = 16.0
"""Length of what goes on beyond the field at its top or bottom, in units of the size."""
VACUUM = DeltaBeta(0.0, 0.0)
SHARE = DeltaBeta(1.0, 0.0)
"""The matter of a region, whose δ is then the share of a voxel that it fills."""


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
    `SHARE`, so that they voxelise to the share of each voxel that the part fills."""

    scene: Scene
    text: str
    regions: Mapping[str, Scene] = field(default_factory=dict)


def meshed(parts: Sequence[tuple[Sequence[TriangleMesh], DeltaBeta]]) -> MeshScene:
    """The scene of meshes, each group filled with what it adds to that which is around it."""
    bodies = [(mesh, matter) for meshes, matter in parts for mesh in meshes]
    return MeshScene(tuple(mesh for mesh, _ in bodies), tuple(matter for _, matter in bodies))


def region(*meshes: TriangleMesh, without: Sequence[TriangleMesh] = ()) -> MeshScene:
    """The part of space in `meshes`, and not in those `without`, which lie inside."""
    return meshed([(meshes, SHARE), (without, DeltaBeta(-1.0, 0.0))])


def ball_meshes(
    count: int,
    radii: tuple[float, float],
    size: float,
    box: tuple[float, float, float],
    seed: int | np.random.Generator,
    shape: str,
) -> list[TriangleMesh]:
    """`count` balls in the container `box` [m] of `shape`, none touching, of radii evenly between shares of `size`."""
    low, high = (2 * r * size for r in radii)
    require(low <= high, f"radii must be (smallest, largest), but they are {radii[0]:g} and {radii[1]:g}.")
    if not count:
        return []
    balls = packed_balls(np.linspace(high, low, count), box, seed, margin=0.05 * low, shape=shape)
    return [ball.mesh(4, f"bubble{i:03d}") for i, ball in enumerate(balls)]
