"""Several materials of known level: surfaces one inside another, how they are cut, and which of them are taken."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.baselines.two_materials import told_apart
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.smooth_volume import ContinuousPrior, KnownLevels
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import METHODS, Gaussians, Task
from holosplat.methods import first_surfaces as levels
from holosplat.methods.surface_fit import SurfaceOptions, cut_surfaces
from holosplat.representations import SurfaceMesh, VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene

pytestmark = pytest.mark.usefixtures("plain_light", "unjudged_runs")

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


BUBBLE = DeltaBeta(-9e-7, -2e-9)


@cache
def both_sides() -> MeshScene:
    """A coated ball in a liquid, and a bubble beside it."""
    coat, ball, bubble = (
        Ball(np.array([x, 0.5, 0.2]) * PIXEL, 2 * radius * PIXEL).mesh(3, "ball")
        for x, radius in ((-4.5, 5.5), (-4.5, 3.4), (5.5, 3.6))
    )
    return MeshScene((coat, ball, bubble), (LIQUID, WALL.against(LIQUID), BUBBLE))


@cache
def cut_on_both_sides() -> SurfaceMesh:
    """The surfaces of all three, of the truth."""
    matter = Matter.several(WALL, BUBBLE, LIQUID)
    found = torch.from_numpy(both_sides().voxelise(GRID).delta / WALL.delta).float()
    return cut_surfaces(found, GRID, PIXEL, matter)


def test_materials_on_either_side_are_told_apart_by_themselves():
    """The volume and its negative beside each other: what is of each, as in the volume alone."""
    delta, levels = volume().values[0], (1.0, LIQUID.delta / WALL.delta)
    alone = told_apart(delta, levels, 1)
    found = told_apart(torch.cat([delta, -delta]), (*levels, *(-level for level in levels)), 1)
    assert alone[1].any()
    assert torch.equal(found, torch.cat([torch.cat([alone, 0 * alone]), torch.cat([0 * alone, alone])], dim=1))


def test_surfaces_on_either_side_of_the_medium_enclose_what_is_stronger_on_theirs():
    """What lies between the wall and the liquid in strength, but on the other side, is in neither."""
    shares, true = cut_on_both_sides().shares(GRID), both_sides().voxelise(GRID)
    sizes = 4 / 3 * np.pi * np.array([3.4**3, 3.6**3, 5.5**3 - 3.4**3])
    np.testing.assert_allclose(shares.sum(dim=(1, 2, 3)).numpy(), sizes, rtol=0.12)
    assert float(shares.min()) > -1e-9
    found = cut_on_both_sides().voxelise(GRID)
    for mine, theirs in ((found.delta, true.delta), (found.beta, true.beta)):
        assert np.linalg.norm(mine - theirs) < 0.15 * np.linalg.norm(theirs)


def test_line_integrals_on_both_sides_are_those_of_each_step_alone():
    lines, jumps = cut_on_both_sides().project(VIEWS), (WALL.against(LIQUID), BUBBLE, LIQUID)
    alone = [
        tuple(SurfaceMesh(cut_on_both_sides().vertices, faces, PIXEL, Matter.one(*jump)).project(VIEWS))
        for faces, jump in zip(cut_on_both_sides().steps, jumps)
    ]
    for mine, *parts in zip(tuple(lines), *alone):
        torch.testing.assert_close(mine, sum(parts), rtol=1e-9, atol=1e-18)


def test_bodies_know_what_is_inside_them():
    """The coated ball is a ball of each, of which that of the liquid holds the other; a wall has its cavity."""
    bodies, fillings = cut_on_both_sides().bodies(), cut_on_both_sides().fillings()
    assert [one.channels for one in fillings] == [(LIQUID,), (BUBBLE,), (WALL,)]
    sizes = np.array([body.volume for body in bodies]) / PIXEL**3
    np.testing.assert_allclose(sizes, 4 / 3 * np.pi * np.array([5.5, 3.6, 3.4]) ** 3, rtol=0.12)
    volumes = {one.channels[0]: body.volume for one, body in zip(cut().fillings(), cut().bodies())}
    assert volumes[LIQUID] - volumes[WALL] == pytest.approx(4 / 3 * np.pi * 5.0**3 * PIXEL**3, rel=0.08)


def test_surfaces_on_both_sides_take_no_turns_with_a_volume(monkeypatch):
    """Rounds of agreement bound matter to one side of its medium."""
    monkeypatch.setattr(levels, "_cut_again", lambda *given: pytest.fail("a volume was made"))
    task = Task(simulate(both_sides(), Exposures.of(VIEWS, 20.0, 0.03)), MaterialPrior.known(WALL, BUBBLE, LIQUID))
    assert levels.in_turns(task, cut_on_both_sides(), Gaussians(), HOW) is cut_on_both_sides()


def test_absorption_on_both_sides_lies_between_each_material_and_the_medium():
    known = KnownLevels((WALL, BUBBLE), DeltaBeta(WALL.delta, 0.0))
    assert known.occupancies == pytest.approx((-0.75, 1.0))
    beside = known.absorbed(torch.tensor([-1.0, -0.75, -0.375, 0.0, 0.5, 1.0]))
    assert beside is not None
    own = [BUBBLE.beta, BUBBLE.beta, 0.5 * BUBBLE.beta, 0.0, 0.5 * WALL.beta, WALL.beta]
    np.testing.assert_allclose(beside.numpy(), own, rtol=1e-5, atol=1e-15)
    drawn = ContinuousPrior(two_sided=True, levels=known.occupancies).distance(torch.tensor([-0.8, -0.3, 0.4]), 1e-6)
    np.testing.assert_allclose(drawn[0].numpy(), [0.05, 0.3, 0.4], atol=1e-5)
    np.testing.assert_allclose(drawn[1].numpy(), [-1, -1, 1], atol=1e-4)


@pytest.mark.parametrize(("name", "most"), [("auto", 0.12), ("gaussians", 0.2), ("volume", 0.25)])
def test_bodies_and_bubbles_of_known_materials_are_found_together(name, most):
    """Noise of 2000 photons a pixel, in frames of an odd rectangle; bodies on one side alone leave half of it."""
    exposed = simulate(both_sides_of_two(), Exposures.of(Views.evenly_spaced(8, (31, 33), PIXEL), 20.0, 0.03))
    noisy = np.random.default_rng(4).poisson(2000 * exposed.frames) / 2000
    scan = replace(exposed, frames=noisy.astype(np.float32))
    found = hs.reconstruct(scan, MaterialPrior.known(WALL, BUBBLE, medium="water"), METHODS[name])
    true = both_sides_of_two().voxelise(Grid.of_views(scan.views))
    delta = found.object.voxelise(true.grid).delta
    assert np.linalg.norm(delta - true.delta) < most * np.linalg.norm(true.delta)
    for mine, theirs in (
        (delta > 0.5 * WALL.delta, true.delta > 0.5 * WALL.delta),
        (delta < -4e-7, true.delta < -4e-7),
    ):
        assert 2 * (mine & theirs).sum() > 0.93 * (mine.sum() + theirs.sum())


def both_sides_of_two() -> MeshScene:
    bodies = (((-6.0, 2.0, 1.0), 5.5), ((6.5, -3.0, -2.0), 4.5), ((3.0, 6.0, 5.0), 4.0), ((-1.0, -7.0, 4.0), 4.0))
    meshes = tuple(Ball(np.array(centre) * PIXEL, 2 * radius * PIXEL).mesh(3, "ball") for centre, radius in bodies)
    return MeshScene(meshes, (WALL, BUBBLE, WALL, BUBBLE))


def quick() -> Gaussians:
    """No turns; surfaces have all their steps: after ten a material that is not there still explains more."""
    own = Gaussians()
    return replace(own, coarse=replace(own.coarse, turns=0))


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
