"""Several materials of known level: surfaces one inside another, how they are cut, and which of them are taken."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.smooth_volume import KnownLevels
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import Gaussians, Task
from holosplat.methods import first_surfaces as levels
from holosplat.methods.surface_fit import SurfaceOptions, cut_surfaces
from holosplat.representations import SurfaceMesh, VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene

PIXEL, SHAPE = 1e-6, (21, 23)
WALL, LIQUID, GEL = DeltaBeta(1.2e-6, 3e-9), DeltaBeta(6e-7, 3e-10), DeltaBeta(8e-7, 1e-9)
VIEWS = Views.evenly_spaced(6, SHAPE, PIXEL)
GRID = Grid.of_views(VIEWS)
HOW = SurfaceOptions()


@cache
def scene() -> MeshScene:
    """A ball of liquid in a thick wall."""
    outer, inner = (Ball(np.zeros(3), 2 * radius * PIXEL).mesh(3, "ball") for radius in (8.0, 5.0))
    return MeshScene((outer, inner), (WALL, LIQUID.against(WALL)))


@cache
def scan() -> Scan:
    return simulate(scene(), Exposures.of(VIEWS, 20.0, 0.03))


def volume() -> VoxelGrid:
    """The truth on voxels of a pixel, in units of the wall's δ."""
    found = torch.from_numpy(scene().voxelise(GRID).delta / WALL.delta).float()
    return VoxelGrid(found[None], GRID, Matter.one(*WALL))


@cache
def cut() -> SurfaceMesh:
    """Surfaces of the wall and the liquid."""
    return cut_surfaces(volume().values[0], GRID, PIXEL, Matter.several(WALL, LIQUID))


def test_surfaces_of_several_materials_are_one_inside_another():
    """The liquid's surface encloses the wall, too, and the wall's has the liquid for its cavity."""
    shares, true = cut().shares(GRID), scene().voxelise(GRID)
    assert len(cut().parts) == 2
    sizes = 4 / 3 * np.pi * np.array([8.0**3 - 5.0**3, 5.0**3])
    np.testing.assert_allclose(shares.sum(dim=(1, 2, 3)).numpy(), sizes, rtol=0.08)
    found = cut().voxelise(GRID)
    for mine, theirs in ((found.delta, true.delta), (found.beta, true.beta)):
        assert np.linalg.norm(mine - theirs) < 0.12 * np.linalg.norm(theirs)


def test_their_line_integrals_are_those_of_each_step_alone():
    lines = cut().project(VIEWS)
    jumps = (WALL.against(LIQUID), LIQUID)
    alone = [
        tuple(SurfaceMesh(cut().vertices, faces, PIXEL, Matter.one(*jump)).project(VIEWS))
        for faces, jump in zip(cut().steps, jumps)
    ]
    for mine, *parts in zip(tuple(lines), *alone):
        torch.testing.assert_close(mine, sum(parts), rtol=1e-9, atol=1e-18)


def test_they_are_the_same_after_a_file():
    again = SurfaceMesh.from_state(cut().state())
    assert (again.parts, again.matter) == (cut().parts, cut().matter)
    with pytest.raises(InputError, match="parts must say how many of"):
        SurfaceMesh(cut().vertices, cut().faces, PIXEL, cut().matter, parts=[1, 2])


def test_what_known_materials_absorb_lies_between_them():
    """In units of the wall: nothing in the medium, and each material its own, without the unit's β."""
    known = KnownLevels((WALL, LIQUID), DeltaBeta(WALL.delta, 2e-9))
    assert known.occupancies == pytest.approx((0.5, 1.0))
    beside = known.absorbed(torch.tensor([0.0, 0.25, 0.5, 1.0, 1.2]))
    assert beside is not None
    own = [0.0, 0.5 * (LIQUID.beta - 1e-9), LIQUID.beta - 1e-9, 1e-9, 1e-9]
    np.testing.assert_allclose(beside.numpy(), own, rtol=1e-5, atol=1e-15)
    assert KnownLevels((WALL,), WALL).absorbed(torch.ones(3)) is None


def quick() -> Gaussians:
    """Two steps of surfaces, and no turns."""
    own = Gaussians()
    return replace(own, coarse=replace(own.coarse, coarse_steps=2, turns=0))


@pytest.mark.parametrize(
    ("told", "taken"), [((WALL, LIQUID), 2), ((WALL, GEL, LIQUID), 2), ((WALL,), 1)], ids=["both", "one more", "one"]
)
def test_told_materials_are_taken_as_far_as_frames_show_them(monkeypatch, told, taken):
    """A third material that is not there explains no more, and is left."""
    monkeypatch.setattr(levels, "_likeliest", lambda task, options: volume())
    said = []
    task = Task(scan(), MaterialPrior.known(*told), on_start=lambda decision, guess: said.append(decision))
    found = levels.surfaces_of_levels(task, quick(), HOW)
    assert len(found.matter) == taken
    assert said[0].name == "materials"
    if taken == 2:
        assert found.matter.channels == (WALL, LIQUID)
