"""Balls, capsules, foam and crowded cells: volumes against closed forms, nothing overlaps, a seed is a scene."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import DeltaBeta
from holosplat.specimens import red_cells
from holosplat.specimens.phantoms import Ball, packed_balls, unit_ball
from holosplat.specimens.red_cells import crowded_cells, evans_fung_cell, icosphere, place_cells
from holosplat.specimens.repair import closed
from holosplat.specimens.scene import MeshScene
from holosplat_bench.specimens.phantoms import Capsule, place_capsules, random_foam, star_of_balls

UM = 1e-6
BOX = (60 * UM, 50 * UM, 70 * UM)


def near(value, rel=1e-6, abs=0.0):
    """pytest.approx without its absolute tolerance of 1e-12, which is more than most numbers here."""
    return pytest.approx(value, rel=rel, abs=abs)


def centres(balls) -> np.ndarray:
    return np.array([ball.centre for ball in balls])


def gaps(balls) -> np.ndarray:
    """Clear distance [N, N] [m] between balls, infinite on the diagonal."""
    radii = np.array([ball.diameter for ball in balls]) / 2
    distance = np.linalg.norm(centres(balls)[:, None] - centres(balls), axis=-1)
    np.fill_diagonal(distance, np.inf)
    return distance - radii[:, None] - radii


def matter(scene: MeshScene, half: float) -> tuple[float, float, np.ndarray]:
    """∫δ dV and ∫β dV [m³] over a grid of odd counts and uneven voxels that holds the scene, and δ itself."""
    shape = (31, 27, 35)
    size = tuple(2 * half / n for n in shape[::-1])
    volume = scene.voxelise(Grid(shape, size, tuple(-half + 0.5 * s for s in size)))
    cell = float(np.prod(size))
    return volume.delta.sum(dtype=float) * cell, volume.beta.sum(dtype=float) * cell, volume.delta


# --- balls --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("subdivisions", [1, 3, 5])
def test_a_ball_has_its_volume_on_every_mesh(subdivisions):
    ball = Ball(np.array([3, -2, 5]) * UM, 7 * UM)
    mesh = ball.mesh(subdivisions)
    assert mesh.volume == near(ball.volume)
    assert ball.volume == near(4 / 3 * np.pi * (3.5 * UM) ** 3)
    assert np.array_equal(closed(mesh).faces, mesh.faces)
    assert mesh.vertices.mean(0) == near(ball.centre, abs=1e-12)


def test_a_ball_reaches_beyond_its_radius_with_order_two():
    beyond = np.array([np.linalg.norm(unit_ball(s)[0], axis=1).max() - 1 for s in (2, 3, 4, 5)])
    assert beyond[1] == near(0.0029, rel=0.01)
    assert np.log2(beyond[:-1] / beyond[1:]) == near(np.full(3, 2.0), abs=0.02)


def test_a_ball_casts_the_chords_of_a_ball():
    """2 √(r² - ρ²) off the rim, on an odd rectangular detector under a tilted view."""
    ball = Ball(np.array([1.0, 2.0, -3.0]) * UM, 12 * UM)
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    views = Views.from_rotations(turn[None], (19, 23), 1 * UM)
    thickness = MeshScene.of_one_material([ball.mesh(5)], DeltaBeta(1.0, 0.5)).project(views)[1][0].numpy()
    x, y = np.meshgrid((np.arange(23) + 0.5 - 11.5) * UM, (np.arange(19) + 0.5 - 9.5) * UM)
    rho = np.hypot(x - turn[0] @ ball.centre, y - turn[1] @ ball.centre) / (6 * UM)
    inner = rho < 0.8
    assert thickness[inner] == near(12 * UM * np.sqrt(1 - rho[inner] ** 2), rel=0.02)
    assert thickness[rho > 1.2].max() == 0


@pytest.mark.parametrize("shape", ["box", "cylinder", "ball"])
def test_packed_balls_keep_apart_and_inside(shape):
    diameters = np.linspace(4, 13, 40) * UM
    balls = packed_balls(diameters, BOX, seed=2, margin=0.3 * UM, shape=shape)
    assert np.array_equal([ball.diameter for ball in balls], diameters)
    assert gaps(balls).min() >= 0.3 * UM
    assert gaps(balls).min() < 1 * UM  # crowded enough to mean something
    half = np.array(BOX) / 2 - 0.3 * UM
    points, radii = centres(balls), diameters / 2
    if shape == "ball":
        assert np.all(np.linalg.norm(points, axis=1) + radii <= half.min())
        return
    assert np.all(np.abs(points) + radii[:, None] <= half)
    if shape == "cylinder":
        assert np.all(np.hypot(points[:, 0], points[:, 2]) + radii <= half[0])
    else:
        assert np.any(np.hypot(points[:, 0], points[:, 2]) + radii > half[0])  # corners are used


def test_packed_balls_follow_their_seed():
    first, again, other = (centres(packed_balls(np.full(9, 5 * UM), BOX, seed)) for seed in (4, 4, 5))
    assert np.array_equal(first, again)
    assert not np.isclose(first, other).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.full(200, 9 * UM), BOX), "200 balls must fit into the cylinder of 60 x 50 x 70 µm, but only"),
        ((np.full(2, 61 * UM), BOX), "only 0 found a place"),
        ((np.empty(0), BOX), "at least one"),
        ((np.array([-1.0]), BOX), "ball diameter must be a positive number"),
        ((np.full(2, UM), BOX[:2]), "three extents"),
        ((np.full(2, UM), BOX, 0, -1.0), "margin must not be negative"),
        ((np.full(2, UM), BOX, 0, 0.0, "cone"), "one of box, cylinder, ball"),
    ],
)
def test_balls_that_cannot_be_packed(arguments, message):
    with pytest.raises(InputError, match=message):
        packed_balls(*arguments)


DIAMETERS = 12 * UM * 2 ** (-np.arange(7) / 2)


def test_star_has_gaps_as_wide_as_its_balls():
    balls = star_of_balls(DIAMETERS, seed=3)
    assert [ball.diameter for ball in balls] == near(np.repeat(DIAMETERS, 16))
    clear = gaps(balls)
    for i, diameter in enumerate(DIAMETERS):
        of_size = clear[16 * i : 16 * (i + 1), 16 * i : 16 * (i + 1)]
        assert np.sort(of_size, axis=1)[:, :2] == near(np.full((16, 2), diameter), rel=1e-6)  # both neighbours
    assert clear.min() > 0
    assert centres(balls).reshape(-1, 8, 3).sum(1)[:, [0, 2]] == near(np.zeros((14, 2)), abs=1e-15)
    assert np.sort(centres(balls)[:, 1]) == near(-np.sort(centres(balls)[:, 1])[::-1], abs=1e-15)


def test_star_turns_with_its_seed_and_refuses_rings_that_touch():
    first, again, other = (centres(star_of_balls(DIAMETERS, seed)) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert np.array_equal(first[:, 1], other[:, 1])
    assert not np.isclose(first[:, 0], other[:, 0], rtol=1e-3).all()
    with pytest.raises(InputError, match=r"rings not to touch, but 9 and 10 µm do"):
        star_of_balls(np.array([10.0, 4.0, 9.0]) * UM)
    with pytest.raises(InputError, match="spokes must be a whole number"):
        star_of_balls(DIAMETERS, spokes=2)


def test_balls_are_checked():
    with pytest.raises(InputError, match="ball centre must hold finite numbers"):
        Ball(np.array([0, np.nan, 0]), UM)
    with pytest.raises(InputError, match="check its unit"):
        Ball(np.zeros(3), 12.0)


# --- capsules -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def capsules() -> list[Capsule]:
    return place_capsules((14 * UM, 20 * UM), 8, BOX, 2 * UM, seed=1, flattening=0.4)


def level(capsule: Capsule, points: np.ndarray) -> np.ndarray:
    """Below 1 inside the smooth outer surface."""
    return np.linalg.norm((points - capsule.centre) @ capsule.rotation / capsule.half_axes, axis=-1)


def test_capsules_have_the_volumes_of_their_ellipsoids(capsules):
    for capsule in capsules:
        a, b, c = capsule.half_axes
        assert capsule.outer(2).volume == near(4 / 3 * np.pi * a * b * c)
        assert capsule.core().volume == near(4 / 3 * np.pi * (a - 2 * UM) * (b - 2 * UM) * (c - 2 * UM))
        assert capsule.outer(2).volume == near(capsule.volume)
        assert a >= max(b, c) >= min(b, c) >= 0.6 * a
        assert 7 * UM <= a <= 10 * UM


def test_capsules_touch_neither_each_other_nor_the_walls_and_hold_their_cores(capsules):
    for capsule in capsules:
        assert level(capsule, capsule.core().vertices).max() < 0.95
        points = capsule.outer().vertices
        assert all(level(other, points).min() > 1 for other in capsules if other is not capsule)
        assert np.hypot(points[:, 0], points[:, 2]).max() <= BOX[0] / 2
        assert np.abs(points[:, 1]).max() <= BOX[1] / 2


def test_a_scene_of_capsules_holds_its_shells_and_its_cores(capsules):
    shell, core = DeltaBeta(1e-6, 4e-9), DeltaBeta(4e-7, 1e-10)
    meshes = [c.outer() for c in capsules] + [c.core() for c in capsules]
    scene = MeshScene(tuple(meshes), (shell,) * 8 + (core.against(shell),) * 8)
    delta, beta, values = matter(scene, 36 * UM)
    whole, cores = sum(c.volume for c in capsules), sum(c.core().volume for c in capsules)
    assert delta == near(shell.delta * (whole - cores) + core.delta * cores, rel=2e-3)
    assert beta == near(shell.beta * (whole - cores) + core.beta * cores, rel=4e-3)
    assert values.min() >= 0
    assert values.max() <= shell.delta * (1 + 1e-6)


def test_capsules_follow_their_seed_and_are_checked():
    first, again, other = (place_capsules((9 * UM, 12 * UM), 4, BOX, UM, seed) for seed in (7, 7, 8))
    for name in ("centre", "half_axes", "rotation"):
        assert all(np.array_equal(getattr(a, name), getattr(b, name)) for a, b in zip(first, again))
        assert not any(np.array_equal(getattr(a, name), getattr(b, name)) for a, b in zip(first, other))
    assert all(np.ptp(c.half_axes) == 0 for c in place_capsules((9 * UM, 12 * UM), 4, BOX, UM, flattening=0.0))
    with pytest.raises(InputError, match="shell's thickness must lie between 0 and the shortest half axis"):
        place_capsules((9 * UM, 12 * UM), 4, BOX, 5 * UM)
    with pytest.raises(InputError, match="exchange them"):
        place_capsules((12 * UM, 9 * UM), 4, BOX, UM)
    with pytest.raises(InputError, match=r"flattening must lie between 0 and 0\.5"):
        place_capsules((9 * UM, 12 * UM), 4, BOX, UM, flattening=0.7)


# --- foam ---------------------------------------------------------------------------------------------------


def test_foam_is_water_less_its_bubbles():
    foam = random_foam(60 * UM, 30, 9 * UM, seed=2)
    meshes = [foam.drop.mesh(4), *(bubble.mesh(4) for bubble in foam.bubbles)]
    liquid = foam.drop.volume - sum(bubble.volume for bubble in foam.bubbles)
    assert sum(m.volume for m in meshes[:1]) - sum(m.volume for m in meshes[1:]) == near(liquid)
    assert liquid < 0.87 * foam.drop.volume
    scene = MeshScene(tuple(meshes), (DeltaBeta(5e-7, 2e-10),) + (DeltaBeta(-5e-7, -2e-10),) * 30)
    delta, beta, values = matter(scene, 32 * UM)
    assert delta == near(5e-7 * liquid, rel=2e-3)
    assert beta == near(2e-10 * liquid, rel=2e-3)
    assert values.min() >= -1e-9 * 5e-7  # no bubble was taken out twice
    assert values.max() <= 5e-7 * (1 + 1e-6)


def test_bubbles_keep_apart_and_inside_the_drop():
    foam = random_foam(60 * UM, 30, 9 * UM, margin=0.4 * UM, seed=2)
    assert gaps(foam.bubbles).min() >= 0.4 * UM
    reach = [np.linalg.norm(b.centre) + b.diameter / 2 for b in foam.bubbles]
    assert max(reach) <= 29.6 * UM


def test_bubbles_are_log_normal_within_two_deviations():
    bubbles = random_foam(300 * UM, 2000, 5 * UM, spread=0.3, seed=0).bubbles
    logs = np.log(np.array([b.diameter for b in bubbles]) / (5 * UM)) / 0.3
    assert np.abs(logs).max() < 2
    assert logs.mean() == near(0.0, abs=0.06)
    assert logs.std() == near(0.880, abs=0.04)  # of a normal distribution cut at two deviations


def test_foam_follows_its_seed_and_is_checked():
    first, again, other = (random_foam(60 * UM, 12, 9 * UM, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(centres(first.bubbles), centres(again.bubbles))
    assert not np.isclose(centres(first.bubbles), centres(other.bubbles)).any()
    with pytest.raises(InputError, match="40 balls must fit into the ball"):
        random_foam(30 * UM, 40, 12 * UM)
    with pytest.raises(InputError, match="spread must lie between 0 and 1"):
        random_foam(30 * UM, 4, 4 * UM, spread=2.0)
    with pytest.raises(InputError, match="number of bubbles"):
        random_foam(30 * UM, 0, 4 * UM)


# --- crowded cells ------------------------------------------------------------------------------------------


def test_cells_move_over_for_the_next():
    """A channel that is full for cells put down one after the other."""
    box = (15 * UM, 15 * UM, 15 * UM)
    with pytest.raises(InputError, match="only 4 found a place"):
        place_cells(5, box, seed=1)
    cells = place_cells(5, box, seed=1, shuffles=20)
    _hold_apart(cells, box)


def test_a_channel_in_which_cells_jam_is_given_up(monkeypatch):
    """Between what can be placed and what bodies fill at random: as many places are tried as all cells may have."""
    monkeypatch.setattr(red_cells, "MOST_TRIES", 900)
    tried, turned = [], red_cells._random_rotation
    monkeypatch.setattr(red_cells, "_random_rotation", lambda rng: tried.append(1) or turned(rng))
    with pytest.raises(InputError, match=r"9 red cells .* but only \d found a place"):
        place_cells(9, (14 * UM, 13 * UM, 15 * UM), seed=1, shape="box", shuffles=1000)
    assert 900 < len(tried) <= 900 + 9 * red_cells.TRIES_A_CELL


def _hold_apart(cells, box) -> None:
    sphere, _ = icosphere(3)
    surfaces = [cell.surface(sphere) for cell in cells]
    for i, cell in enumerate(cells):
        others = np.concatenate([points for j, points in enumerate(surfaces) if j != i])
        assert not cell.contains(others).any()
    points = np.concatenate(surfaces)
    assert np.hypot(points[:, 0], points[:, 2]).max() <= box[0] / 2
    assert np.abs(points[:, 1]).max() <= box[1] / 2


def test_crowded_cells_have_their_haematocrit():
    box = (28 * UM, 30 * UM, 28 * UM)
    cells, again, other = (crowded_cells(0.15, box, seed) for seed in (0, 0, 1))
    _hold_apart(cells, box)
    volume = sum(cell.mesh().volume for cell in cells)
    half_a_cell = 0.5 * evans_fung_cell().volume
    assert abs(volume - 0.15 * np.pi / 4 * box[0] ** 2 * box[1]) <= half_a_cell * 1.001
    assert all(np.array_equal(a.centre, b.centre) for a, b in zip(cells, again))
    assert not any(np.array_equal(a.centre, b.centre) for a, b in zip(cells, other))
    with pytest.raises(InputError, match="haematocrit must lie between"):
        crowded_cells(20, box)
    with pytest.raises(InputError, match="box must be three extents"):
        crowded_cells(0.1, box[:2])
