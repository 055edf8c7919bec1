"""Forecasts of bodies whose motion is known, and the band about them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import holosplat as hs
from helpers.kept import Kept
from holosplat.bodies.rest_shape import centroid
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.run import Run
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh, across, normals
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.fit import MotionFit
from holosplat.motion.forecast import History, PathForecast, early_count, extrapolate, places_of
from holosplat.motion.measures import early_part, half_sets
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere

TIMES = 1e-5 * np.arange(12)
AHEAD = TIMES[-1] + 1e-5 * np.array([1.0, 5.0, 10.0])
SPHERE, FACES = icosphere(2)


def truth(body: int, time: float) -> TriangleMesh:
    """An ellipsoid that moves and turns evenly, by 0.06 rad in 1e-5 s."""
    turn = Rotation.from_rotvec(time / 1e-5 * np.array([0.02, 0.05, 0.02 * body])).as_matrix()
    middle = 1e-6 * np.array([9.0 * body, 2e5 * time, 0])
    return TriangleMesh((SPHERE * [3e-6, 2.2e-6, 1.4e-6]) @ turn.T + middle, FACES)


def fitted(noise: float = 0.0, seed: int = 0, first: int = len(TIMES)) -> MovingSurfaces:
    """Paths of degree 3 through the true places at the first times, whose middle is off by `noise` [m] each time."""
    times, random = TIMES[:first], np.random.default_rng(seed)
    basis = TimeBasis(times[0], times[-1], 3)
    off = noise * random.normal(size=(2, len(times), 1, 3))
    places = [np.array([truth(b, t).vertices for t in times]) + off[b] for b in range(2)]
    paths = [basis.fitted(times, one) for one in places]
    return MovingSurfaces.of_bodies(paths, [FACES, FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))


def missed(found: MovingSurfaces, body: int = 0) -> list[float]:
    return [normal_distance(found.bodies(t)[body], truth(body, t)) for t in AHEAD]


def test_what_turns_goes_on_turning():
    """A turn is no polynomial of places: paths that are carried on straight swell, parts that turn do not."""
    found = extrapolate(History(fitted(), TIMES), AHEAD)
    straight = [normal_distance(fitted().bodies(t)[0], truth(0, t)) for t in AHEAD]
    assert missed(found.bodies)[-1] < 0.1 * straight[-1]
    assert missed(found.bodies)[-1] < 0.02e-6
    volumes = [mesh.volume for t in AHEAD for mesh in found.bodies.bodies(t)]
    assert volumes == pytest.approx(len(volumes) * [truth(0, 0.0).volume], rel=2e-3, abs=0)
    assert found.bodies.bodies(TIMES[-1])[1].vertices == pytest.approx(truth(1, TIMES[-1]).vertices, abs=0.01e-6)


def test_the_band_is_the_error_of_noise():
    """Over noise of many seeds: what half-sets differ by is what forecasts are off by, at each time ahead."""
    ratios = []
    for seed in range(0, 60, 5):
        early = fitted(0.1e-6, seed + 1, 8), fitted(0.1e-6, seed + 2, 8)
        halves = fitted(0.1e-6, seed + 3), fitted(0.1e-6, seed + 4)
        mean = halves[0].with_parameters({"coefficients": 0.5 * (halves[0].coefficients + halves[1].coefficients)})
        found = extrapolate(History(mean, TIMES, halves, early), AHEAD)
        ratios += [[np.square(missed(found.bodies, k)), np.square(found.band[:, k])] for k in range(2)]
    error, band = np.sqrt(np.array(ratios)).transpose(1, 0, 2)
    assert (np.diff(np.median(band, axis=0)) > 0).all()
    assert np.median(band, axis=0) / np.sqrt(np.mean(error**2, axis=0)) == pytest.approx(1, abs=0.5)
    assert ((error < 1.645 * band).mean(0) > 0.75).all()


def risen(times: np.ndarray) -> list[np.ndarray]:
    """Two balls whose middles rise as the cube of time, by 2 µm at the last of `TIMES`."""
    rise = 2e-6 * (times / TIMES[-1])[:, None, None] ** 3 * [0.0, 0.0, 1.0]
    return [2e-6 * SPHERE + [9e-6 * body, 0, 0] + rise for body in range(2)]


def on_paths_of(times: np.ndarray, degree: int = 2) -> MovingSurfaces:
    """What a fit to frames of these times alone finds."""
    basis = TimeBasis(times[0], times[-1], degree)
    paths = [basis.fitted(times, one) for one in risen(times)]
    return MovingSurfaces.of_bodies(paths, [FACES, FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))


def test_a_forecast_is_tested_by_times_that_it_never_saw():
    """A parabola through all times goes on from its first two thirds without a miss, and says nothing of the error."""
    whole, early, halves = on_paths_of(TIMES), on_paths_of(TIMES[: early_count(len(TIMES))]), on_paths_of(TIMES)
    fooled, told = History(whole, TIMES, (halves, halves)), History(whole, TIMES, (halves, halves), (early, early))
    off = np.abs(risen(AHEAD)[0] - places_of(extrapolate(told, AHEAD).bodies, AHEAD)[0]).max((1, 2))[-1]
    bands = [extrapolate(one, AHEAD).band[-1, 0] for one in (fooled, told)]
    assert bands[0] < 0.01 * off
    assert 0.1 * off < bands[1] < off
    near = extrapolate(History(on_paths_of(TIMES, 3), TIMES), TIMES[-1:] + 1e-6)  # what parabolas leave of cubes
    off = np.abs(risen(near.times)[0] - places_of(near.bodies, near.times)[0]).max()
    assert 0.5 * off < near.band[0, 0] < off
    truth_of = risen(TIMES[-1:])[0] - places_of(extrapolate(told.before, TIMES[-1:]).bodies, TIMES[-1:])[0]
    assert np.abs(truth_of).max() > 0.3e-6
    assert told.before.halves == (early, early)


def test_frames_of_the_first_two_thirds_tell_what_was_known_before():
    """Paths end with them, have no more coefficients than half of them tell, and pass where the bodies were."""
    bodies = MovingSurfaces.of_bodies(
        [np.stack([2e-6 * SPHERE] * 5)], [FACES], TimeBasis(0.0, TIMES[-1], 3, 2), 1e-6, Matter.one(1e-7, 0.0)
    )
    views = hs.Views.from_angles(np.array([0.0, 90.0]), (15, 22), 1e-6)
    exposures = hs.Exposures.of(views, 20.0, 0.05).repeated(TIMES)
    scan = hs.Scan(np.ones((24, 15, 22), dtype=np.float32), exposures, np.zeros(24, dtype=bool))
    kept, start = early_part(scan, bodies, TIMES)
    assert kept.tolist() == list(range(16))
    assert start.basis == TimeBasis(0.0, TIMES[7], 3, 1)
    assert start.bodies(TIMES[3])[0].vertices == pytest.approx(2e-6 * SPHERE, abs=1e-12)


def test_a_window_and_a_stiff_body_are_told():
    """Bodies that turned otherwise before the window; and ones whose shape was about to change."""
    bodies = fitted()
    late = extrapolate(History(bodies, TIMES), AHEAD, PathForecast(window=6))
    assert missed(late.bodies)[-1] < 0.05e-6
    grown = bodies.coefficients.clone()
    grown[-1] = grown[-1] + 0.3 * (grown[-1] - grown[-1].mean(0))
    swelling = bodies.with_parameters({"coefficients": grown})
    free = extrapolate(History(swelling, TIMES), AHEAD, PathForecast(keep_volume=False)).bodies
    stiff = extrapolate(History(swelling, TIMES), AHEAD, PathForecast(rigid=True, keep_volume=False)).bodies
    first, last = (np.array([abs(of.bodies(t)[0].volume) for of in (free, stiff)]) for t in (AHEAD[0], AHEAD[-1]))
    assert last[1] == pytest.approx(first[1], rel=0.01)
    assert last[0] > 1.2 * first[0]


def test_one_time_ahead_and_too_few_times_behind():
    """A single step is enough; three times tell no error."""
    found = extrapolate(History(fitted(), TIMES), AHEAD[:1])
    assert missed(found.bodies)[0] < 0.02e-6
    assert np.isnan(extrapolate(History(fitted(), TIMES[-3:]), AHEAD).band).all()


def test_distance_along_normals():
    """Of a sphere that is moved, √(1/3) of the way; turned in itself, nothing."""
    sphere = 2e-6 * SPHERE
    moved = np.stack([sphere, sphere + [0, 1e-8, 0]])
    assert across(np.stack([sphere, sphere]), moved, FACES) == pytest.approx([0, 1e-8 / 3**0.5], rel=0.01, abs=1e-12)
    assert normals(TriangleMesh(sphere, FACES)) == pytest.approx(SPHERE, abs=0.03)


def test_half_sets_are_fits_to_half_of_the_times():
    """Each half moves the bodies towards its own frames: those of odd times are of bodies elsewhere."""
    times = 1e-5 * np.arange(8)
    views = hs.Views.from_angles(np.array([0.0, 90.0]), (15, 22), 1e-6)
    exposures = hs.Exposures.of(views, 20.0, 0.05).repeated(times)
    ball = 4.0 * SPHERE
    basis = TimeBasis(0.0, times[-1], 1)
    still = MovingSurfaces.of_bodies([np.stack([1e-6 * ball] * 2)], [FACES], basis, 1e-6, Matter.one(4e-7, 4e-10))
    away = still.with_parameters({"coefficients": still.coefficients + torch.tensor([0.0, 1.0, 0.0])})
    frames = np.concatenate(
        [hs.simulate((away if t % 2 else still).at(0.0), exposures[[2 * t, 2 * t + 1]]).frames for t in range(8)]
    )
    scan = hs.Scan(frames, exposures, np.zeros(16, dtype=bool))
    how = MotionFit(stiffness=100.0, schedule=Schedule(steps=25, views_per_step=0))
    halves = half_sets(scan, still, how)
    even, odd = (1e6 * centroid(one.bodies(0.0)[0])[1] for one in halves)
    assert even == pytest.approx(0, abs=0.1)
    assert odd == pytest.approx(1, abs=0.2)
    with pytest.raises(InputError, match="frames of 4 times or more"):
        half_sets(scan[:6], still, replace(how))
    journal, taken = Kept(), list[float]()

    def cut_off(record: dict[str, float]) -> None:
        taken.append(record["step"])
        if len(taken) == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half_sets(scan, still, how, run=Run(journal), on_record=cut_off)
    again = half_sets(scan, still, how, run=Run(journal), on_record=lambda record: taken.append(record["step"]))
    assert len(taken) <= 2 * 25 + 1
    for one, other in zip(again, halves):
        np.testing.assert_array_equal(one.coefficients, other.coefficients)


@pytest.mark.parametrize(("angles", "apart"), [((0.0, 90.0), True), ((0.0, 45.0, 90.0, 135.0), False)])
def test_halves_of_few_views_begin_with_other_shapes_at_the_same_middle(angles, apart):
    """What two beams leave open of a shape is no agreement of halves that begin alike."""
    times, views = 1e-5 * np.arange(8), hs.Views.from_angles(np.array(angles), (15, 22), 1e-6)
    exposures = hs.Exposures.of(views, 20.0, 0.05).repeated(times)
    paths = [np.stack([4e-6 * SPHERE] * 2)]
    still = MovingSurfaces.of_bodies(paths, [FACES], TimeBasis(0.0, times[-1], 1), 1e-6, Matter.one(4e-7, 4e-10))
    frames = np.concatenate([hs.simulate(still.at(0.0), exposures[: len(angles)]).frames] * 8)
    scan = hs.Scan(frames, exposures, np.zeros(len(frames), dtype=bool))
    how = MotionFit(rate=1e-6, schedule=Schedule(steps=1, views_per_step=0))
    moves = [(half.coefficients - still.coefficients)[0] for half in half_sets(scan, still, how)]
    extent = [float(move.square().mean().sqrt()) for move in moves]
    assert [one > 0.1 for one in extent] == [apart] * 2
    np.testing.assert_allclose(moves[0], -moves[1], atol=1e-4)
    np.testing.assert_allclose(moves[0].mean(0), 0, atol=1e-4)
