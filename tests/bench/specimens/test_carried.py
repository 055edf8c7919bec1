"""Matter that a motion carries: maps and their inverses, volumes that are kept, masses, and sums along rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.matter import DeltaBeta
from holosplat.specimens.continuous import ContinuousScene, Soft, ellipsoid
from holosplat_bench.specimens.carried import CarriedScene, Chain, Sink, Sinks, Twist, collapsing_foam, stirred_blob

MATTER = DeltaBeta(2e-7, 2e-10)
TWIST = Twist((1e-6, 0.0, -2e-6), (0.2, 1.0, 0.1), 3.0, 6e-6)
STIR = Chain((TWIST, Twist((0.0, 0.0, 0.0), (1.0, 0.0, 0.3), -2.0, 8e-6)))
SINK = Sink((2e-6, -1e-6, 0.0), 4e-6, 2e-16)
SINKS = Sinks((SINK, Sink((-7e-6, 0.0, 3e-6), 3e-6, 1e-16)))


def points(count: int = 40, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-12e-6, 12e-6, (3, count))


def determinant(motion, at: np.ndarray, time: float) -> np.ndarray:
    """Of the map's derivative [P], by central differences."""
    step = 1e-9
    columns = [
        (motion.forth(at + d, time) - motion.forth(at - d, time)) / (2 * step) for d in step * np.eye(3)[..., None]
    ]
    return np.linalg.det(np.stack(columns, 1).transpose(2, 0, 1))


@pytest.mark.parametrize("motion", [TWIST, STIR, SINK, SINKS], ids=lambda m: type(m).__name__)
def test_motions_begin_with_the_identity_and_have_their_inverse(motion):
    at = points()
    assert motion.forth(at, 0.0) == pytest.approx(at, abs=1e-18)
    moved = motion.forth(at, 0.7)
    assert np.abs(moved - at).max() > 1e-7
    assert motion.back(moved, 0.7) == pytest.approx(at, abs=1e-15)


def test_stirring_keeps_every_volume():
    assert determinant(STIR, points(), 0.7) == pytest.approx(np.ones(40), abs=1e-6)


def test_a_sink_keeps_volumes_beyond_its_core_and_shrinks_it():
    at, time = points(200), 0.6
    far = np.linalg.norm(at - np.array(SINK.centre)[:, None], axis=0) > SINK.core
    found = determinant(SINK, at, time)
    assert found[far] == pytest.approx(np.ones(far.sum()), abs=1e-6)
    left = 1 - SINK.loss * time / (4 / 3 * np.pi * SINK.core**3)
    assert found[~far] == pytest.approx(np.full((~far).sum(), left), rel=1e-6)
    assert determinant(SINK, at, 1e9)[~far] == pytest.approx(np.full((~far).sum(), SINK.least), rel=1e-6)


def test_a_later_sink_follows_its_bubble():
    assert SINKS.placed(0.5)[0] == SINK
    moved = np.array(SINKS.placed(0.5)[1].centre)
    wanted = SINK.forth(np.array([SINKS.sinks[1].centre]).T, 0.5)[:, 0]
    assert moved == pytest.approx(wanted, abs=1e-18)


def test_what_a_twist_turns_is_where_the_turned_matter_is():
    ball = ContinuousScene((ellipsoid((6e-6, 0, 0), (2e-6, 3e-6, 2e-6), Soft(0.5), MATTER),))
    rigid = Twist((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), math.pi / 2, 1.0)  # so wide that all turns alike
    at = points(500)
    turned = CarriedScene(ball, rigid, 15e-6, 2e-7).at(1.0).shares(at)
    x, y, z = at
    assert turned == pytest.approx(CarriedScene(ball, rigid, 15e-6, 2e-7).shares(np.stack([-z, y, x])), abs=1e-16)
    assert turned.max() > 0.5 * MATTER.delta


def test_line_integrals_and_voxels_are_those_of_the_scene_at_time_0():
    blob = stirred_blob(24e-6, MATTER, 3)
    views = Views(rotation_tilted([0.0, 37.0], [0.0, 20.0]), np.array([[0, 0], [2e-6, -1e-6]]), (29, 35), 1e-6)
    exact, found = blob.scene.project(views.refined(2)).channels, blob.project(views.refined(4)).channels
    means = found.reshape(*exact.shape[:2], 58, 2, 70, 2).mean((3, 5))
    assert float((means - exact).norm() / exact.norm()) < 2e-3
    grid = Grid.centred((21, 19, 23), 1.2e-6)
    assert blob.voxelise(grid).delta == pytest.approx(blob.scene.voxelise(grid).delta, abs=0.03 * MATTER.delta)


@pytest.mark.parametrize("make", [stirred_blob, collapsing_foam])
def test_mass_is_kept_within_the_ball_and_matter_moves(make):
    scene = make(30e-6, MATTER, seed=1)
    grid = Grid.centred((25, 23, 27), 1.3e-6)
    before, after = (scene.at(time).voxelise(grid) for time in (0.0, 1.0))
    assert after.delta.sum() == pytest.approx(before.delta.sum(), rel=0.02)
    assert after.beta.sum() == pytest.approx(before.beta.sum(), rel=0.02)
    assert np.linalg.norm(after.delta - before.delta) > 0.2 * np.linalg.norm(before.delta)
    views = Views.from_angles([0.0, 60.0], (27, 31), 1.3e-6)
    assert scene.missing_field(views) == pytest.approx(15e-6 - 0.5 * 27 * 1.3e-6, rel=1e-9)


def test_specimens_are_those_of_their_seed():
    a, b, c = (collapsing_foam(30e-6, MATTER, seed) for seed in (1, 1, 2))
    assert a.motion == b.motion
    assert a.motion != c.motion
    fast = stirred_blob(30e-6, MATTER, 1, turn=1.0, duration=2.0).motion
    assert isinstance(fast, Chain)
    assert isinstance(fast.motions[0], Twist)
    assert fast.motions[0].rate == 0.5


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: stirred_blob(0.0, MATTER), "diameter"),
        (lambda: stirred_blob(1e-5, MATTER, turn=20.0), "turn must be at most"),
        (lambda: stirred_blob(1e-5, MATTER, duration=0.0), "duration"),
        (lambda: collapsing_foam(1e-5, MATTER, loss=0.9), "loss"),
        (lambda: collapsing_foam(1e-5, MATTER, edge=1e-6), "edge must be at most"),
    ],
)
def test_what_cannot_be_is_refused(make, said):
    with pytest.raises(InputError, match=said):
        make()
