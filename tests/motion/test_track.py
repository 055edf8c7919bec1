"""Bodies through time, from frames to paths: on ellipsoids that move, turn, deform and leave the field."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import BODIES, MATERIAL, PIXEL, STEP, TIMES, scan, true_paths, truth
from holosplat.bodies.rest_shape import centroid
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.metrics import volume_scores
from holosplat.motion import body_tracker
from holosplat.motion.detections import (
    apart,
    beside,
    joined,
    only,
    shared,
    sightings,
    sure_ones,
    whole_ones,
    without_merger,
)
from holosplat.motion.fit import MotionFit, PathOptions, chosen_paths, motion_fit, refined
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere

QUICK = TrackOptions().with_effort(0.5)


@cache
def followed():
    """What the frames give in half of the steps. The first look at each time sees the largest body alone: the others
    are found beside it."""
    looks = list[int]()

    def blind(frames, material, options, network):
        assert network is None  # the one that knows red cells does not know these bodies
        found = sightings(frames, material, options)
        looks.append(len(found))
        return found[:1] if len(looks) <= TIMES else found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(body_tracker, "sightings", blind)
        return follow(scan(), MATERIAL, QUICK)


def dice(found: MovingSurfaces, time: float) -> float:
    grid = Grid.of_views(scan().views)
    return volume_scores(found.at(time).voxelise(grid), truth().at(time).voxelise(grid)).dice


def test_bodies_are_found_and_followed():
    found = followed().bodies
    assert found.count == len(BODIES)
    assert min(dice(found, time) for time in truth().times) > 0.95


def test_identities_centres_and_volumes_are_kept():
    found = followed().bodies
    meshes = [found.bodies(float(time)) for time in truth().times]
    for k in range(2):  # those that are whole at all times
        way = np.array([centroid(scene.meshes[k]) for scene in truth().snapshots])
        away = np.array([[np.linalg.norm(centroid(m) - w) for m in at] for at, w in zip(meshes, way)]) / PIXEL
        own = int(away.mean(0).argmin())
        assert np.median(away[:, own]) < 0.1
        volumes = np.array([at[own].volume for at in meshes])
        assert volumes / truth().snapshots[0].meshes[k].volume == pytest.approx(1, abs=0.04)
        assert volumes.std() < 0.01 * volumes.mean()


def test_paths_are_right_between_frames():
    """Half a step after a frame, where no frame was."""
    assert dice(followed().bodies, 1.5 * STEP) > 0.95


def test_a_fit_pulls_bodies_that_are_moved_back():
    """All of them by a pixel at the last time, from the true paths; few frames in memory at a time."""
    start = true_paths()
    away = torch.zeros_like(start.coefficients)
    away[-1] = 1.0
    moved = start.with_parameters({"coefficients": start.coefficients + away})
    options = MotionFit(rate=0.3, stiffness=100.0, schedule=Schedule(steps=40, views_per_step=6))
    fit = motion_fit(scan(), moved, options)
    fit.run(lambda record: None)
    found, last = fit.result().object, float(truth().times[-1])
    assert isinstance(found, MovingSurfaces)
    for k in range(2):  # the third one is hardly in the field then
        ends = [centroid(of.bodies(last)[k]) / PIXEL for of in (moved, found, start)]
        assert np.linalg.norm(ends[0] - ends[2]) == pytest.approx(3**0.5, abs=0.02)
        assert np.linalg.norm(ends[1] - ends[2]) < 0.15


def test_frames_beside_bodies_show_what_is_left():
    """Beside the second and third body the first one alone is seen, where it is."""
    two = only(true_paths(), [1, 2])
    left = beside(scan(), two, 2)
    (body,) = sightings(left.at_instant(2), MATERIAL)
    assert np.linalg.norm(body.centre - centroid(truth().snapshots[2].meshes[0])) < 0.5 * PIXEL
    assert np.abs(beside(scan(), true_paths(), 2).frames - 1).mean() < 0.02


def test_bodies_are_joined_and_taken_apart():
    every = true_paths()
    again = joined(only(every, [2]), only(every, [0, 1]))
    for one, other in zip(again.bodies(STEP), [every.bodies(STEP)[k] for k in (2, 0, 1)]):
        assert np.array_equal(one.vertices, other.vertices)
        assert np.array_equal(one.faces, other.faces)
    assert apart(every, only(every, [1]), truth().times) == [0, 2]


def test_pieces_of_bodies_are_none():
    """A small ball at the surface of a body is a piece of it; far away, it is a body."""
    every, (sphere, faces) = true_paths(), icosphere(1)
    middle = every.bodies(2 * STEP)[0].vertices[0] / PIXEL
    for away, wanted in ((0.0, [0, 1, 2]), (12.0, [0, 1, 2, 3])):
        at = middle + np.array([-away, 0, -away]) + 1.0 * sphere
        still = MovingSurfaces.of_bodies(
            [np.repeat(PIXEL * at[None], 3, 0)], [faces], every.basis, PIXEL, Matter.one(*MATERIAL)
        )
        times = truth().times[2:3]
        assert whole_ones(joined(every, still), times) == wanted
        assert apart(still, every, times) == [0][: len(wanted) - 3]


def test_a_merger_of_two_is_left_out_once_both_are_found():
    """Balls of 4 pixels, and one of 5 between two of them; overlaps by the volume of a lens."""
    sphere, faces = icosphere(3)
    still, times = TimeBasis(0.0, 1.0, 0), np.linspace(0, 1, 5)

    def balls(*placed: tuple[float, float]) -> MovingSurfaces:
        paths = [PIXEL * (radius * sphere + np.array([column, 0, 0]))[None] for radius, column in placed]
        return MovingSurfaces.of_bodies(paths, [faces] * len(placed), still, PIXEL, Matter.one(*MATERIAL))

    r, big, d = 4.0, 5.0, 4.0
    lens = np.pi * (r + big - d) ** 2 * (d * d + 2 * d * (r + big) - 3 * (r - big) ** 2) / (12 * d)
    shares = shared(balls((r, -d), (big, 0.0), (r, 30.0)), 0.5)
    assert shares[1, 0] == pytest.approx(lens / (4 / 3 * np.pi * big**3), abs=0.015)
    assert shares[0, 1] == pytest.approx(lens / (4 / 3 * np.pi * r**3), abs=0.015)
    assert not shares[2].any()
    three = balls((r, -d), (big, 0.0), (r, d), (r, 30.0))
    assert without_merger(three, times) == [0, 2, 3]
    for others in (balls((r, -d), (big, 0.0), (r, 30.0)), balls((r, -8.5), (big, 0.0), (r, 8.5))):
        assert without_merger(others, times) == [0, 1, 2]  # half a merger stays, and so do bodies that touch


def test_small_bodies_wait_for_the_others_but_not_at_the_edge():
    """Balls of half the others' volume: one in the middle of the field, one at the end of the rows."""
    sphere, faces = icosphere(2)
    still, views = TimeBasis(0.0, 0.0, 0), scan().views
    balls = ((4.0, -8), (4.0, 8), (3.2, 0), (3.2, 17))
    paths = [PIXEL * (radius * sphere + np.array([0, row, 0]))[None] for radius, row in balls]
    bodies = MovingSurfaces.of_bodies(paths, [faces] * 4, still, PIXEL, Matter.one(*MATERIAL))
    assert sure_ones(bodies, views, truth().times) == [0, 1, 3]


def test_more_pieces_hold_the_same_paths():
    fine = refined(true_paths(), 4)
    assert fine.basis.count == 6
    for time in np.linspace(0, STEP * (TIMES - 1), 7):
        assert fine.at(time).vertices.numpy() == pytest.approx(true_paths().at(time).vertices.numpy(), abs=1e-9)


def test_pieces_are_chosen_by_frames_that_are_held_out():
    """Of frames that run back to the first one no straight path is right; of still ones any is."""
    line, how = true_paths(degree=1), PathOptions(degree=1, held_out=3)
    short = MotionFit(rate=0.4, stiffness=100.0, schedule=Schedule(steps=30, views_per_step=10))
    for order, mean, bent in (([0, 0, 0, 0, 0], 0.0, False), ([0, 2, 4, 2, 0], 0.4, True)):
        ends = (1 - mean) * line.coefficients[0] + mean * line.coefficients[1]
        start = line.with_parameters({"coefficients": torch.stack([ends, ends])})
        chosen = 4 * np.repeat(order, 4) + np.tile(np.arange(4), 5)
        noise = 0.02 * np.random.default_rng(0).normal(size=scan().frames.shape)
        frames = replace(scan(), frames=scan().frames[chosen] + noise)
        found, decision = chosen_paths(frames, start, how, short)
        assert (found.basis.pieces > 1) == bent
        assert decision is not None
        assert decision.choice == str(found.basis.pieces)
        assert decision.by == "frames set aside"


def test_one_time_is_no_motion():
    with pytest.raises(InputError, match="two times or more"):
        follow(scan().at_instant(0), MATERIAL, QUICK)


def test_frames_without_bodies_are_refused():
    empty = replace(scan(), frames=1 + 0.01 * np.random.default_rng(0).normal(size=scan().frames.shape))
    with pytest.raises(InputError, match="no body was found"):
        follow(empty, MATERIAL, QUICK)
