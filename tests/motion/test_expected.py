"""A forecast as the prior of the next window: the term, what halves tell of it, and bodies that frames correct."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import MATERIAL, PIXEL, TIMES, ellipsoid, scan, true_paths, truth
from holosplat.bodies.rest_shape import KnownBody
from holosplat.checks import InputError
from holosplat.fit.problem import Batch
from holosplat.fit.run import Run
from holosplat.matter import DeltaBeta, Matter
from holosplat.mesh import TriangleMesh, across, normals
from holosplat.motion.body_tracker import BodyTracker, Followed
from holosplat.motion.detections import joined, only
from holosplat.motion.elastic import Rest, RestShapeKept
from holosplat.motion.expected import Expected, NearExpected
from holosplat.motion.fit import MotionFit, fitted_bodies, motion_fit
from holosplat.motion.forecast import Forecast
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import MovingSurfaces

UNUSED = Batch(None, torch.zeros(3), torch.zeros(()), 0)


def forecast(bodies: MovingSurfaces, band: float = 0.3 * PIXEL) -> Forecast:
    """That these bodies go on so, with a band [m] that grows, one of the second body twice as wide."""
    times = truth().times
    growing = band * (1 + np.arange(len(times)))[:, None] * np.arange(1, bodies.count + 1)
    return Forecast(bodies, times, growing)


def expected(bodies: MovingSurfaces) -> Expected:
    return Expected.of(forecast(bodies), truth().times, PIXEL, Matter.one(*MATERIAL))


def moved_along_normals(of: Expected, sizes: np.ndarray) -> list[np.ndarray]:
    """The places of each body, displaced along its normals by `sizes` [T, B] m."""
    found = []
    for k, own in enumerate(of.places):
        faces = of.bodies.body(k)[1].numpy()
        found.append(np.stack([p + s * normals(TriangleMesh(p, faces)) for p, s in zip(own, sizes[:, k])]))
    return found


def test_a_distance_of_one_standard_error_costs_one_a_body():
    """Of bodies of two sizes, at each time another error; what is beside the forecast's bodies costs nothing."""
    of = expected(only(true_paths(), [2, 0]))
    start = of.on(true_paths().basis)
    term = NearExpected(1.0, of, start.basis)
    assert float(term.value(start.coefficients, UNUSED)) == pytest.approx(0, abs=1e-4)  # of paths through all times
    fine = replace(start.basis, pieces=len(of.times) - start.basis.degree)  # paths that pass through any places
    away = replace(of, places=moved_along_normals(of, of.band)).on(fine)
    assert float(NearExpected(1.0, of, fine).value(away.coefficients, UNUSED)) == pytest.approx(2, rel=0.02)
    assert of.deviation(away) == pytest.approx(1, rel=0.02)


def test_other_bodies_and_ways_along_the_surface_cost_nothing():
    of = expected(only(true_paths(), [1]))
    start = of.on(true_paths().basis)
    term = NearExpected(1.0, of, start.basis)
    more = joined(start, only(true_paths(), [0]))
    assert term.value(more.coefficients, UNUSED) == term.value(start.coefficients, UNUSED)
    turned = replace(of, band=1e-3 * of.band)
    spin, faces = [], of.bodies.body(0)[1].numpy()
    for place in of.places[0]:
        normal = normals(TriangleMesh(place, faces))
        along = np.cross(normal, [0.3, 1.0, 0.2])
        spin.append(place + 0.01 * PIXEL * along)
    fine = replace(start.basis, pieces=len(of.times) - start.basis.degree)
    tight = NearExpected(1.0, turned, fine)
    out = replace(of, places=moved_along_normals(of, np.full_like(of.band, 0.01 * PIXEL)))
    straight = float(tight.value(out.on(fine).coefficients, UNUSED))
    assert float(tight.value(replace(of, places=[np.array(spin)]).on(fine).coefficients, UNUSED)) < 0.01 * straight


def test_its_slope_is_that_of_differences():
    of = expected(true_paths())
    term, start = NearExpected(0.7, of, true_paths().basis), of.on(true_paths().basis).coefficients
    random = np.random.default_rng(3)
    at = (start + 0.2 * torch.from_numpy(random.normal(size=start.shape))).requires_grad_()
    (slope,) = torch.autograd.grad(term.value(at, UNUSED), at)
    way = torch.from_numpy(random.normal(size=start.shape))
    with torch.no_grad():
        difference = (term.value(at + 1e-3 * way, UNUSED) - term.value(at - 1e-3 * way, UNUSED)) / 2e-3
    assert float((slope * way).sum()) == pytest.approx(float(difference), rel=1e-6)


def test_halves_are_one_standard_error_to_either_side():
    """So that half their difference is the error of the forecast where frames say nothing."""
    of, found = expected(only(true_paths(), [2, 1])), only(true_paths(), [2, 1, 0])
    (one, begun), (other, beside) = (of.astray(found, 5, side) for side in (1, -1))
    assert one.band == pytest.approx(2**0.5 * of.band)
    for k in range(of.count):
        faces = of.bodies.body(k)[1].numpy()
        for side in (one, other):
            assert across(of.places[k], side.places[k], faces) == pytest.approx(of.band[:, k], rel=1e-6)
        assert 0.5 * (one.places[k] + other.places[k]) == pytest.approx(of.places[k], abs=1e-12)
    middle = 0.5 * (begun.coefficients + beside.coefficients)
    assert middle.numpy() == pytest.approx(found.coefficients.numpy(), abs=1e-6)
    last = [mesh.vertices for of in (begun, beside, found) for mesh in of.bodies(0.0)[2:]]
    assert last[0] == pytest.approx(last[2], abs=1e-12)  # a body that the forecast does not know


def test_a_forecast_reaches_over_the_times_and_says_how_sure_it_is():
    times, matter = truth().times, Matter.one(*MATERIAL)
    said = forecast(true_paths())
    later = times + 0.5 * (times[1] - times[0])
    with pytest.raises(InputError, match=r"the forecast must reach over the times of the frames.*--times"):
        Expected.of(said, later, PIXEL, matter)
    unsure = replace(said, band=np.full_like(said.band, np.nan))
    with pytest.raises(InputError, match=r"must have standard errors.*--half-sets"):
        Expected.of(unsure, times, PIXEL, matter)
    with pytest.raises(InputError, match="leave --body"):
        follow(scan(), MATERIAL, TrackOptions(body=KnownBody()), after=said)


def test_its_pixels_and_material_are_those_of_the_frames():
    of = Expected.of(forecast(true_paths()), truth().times, 2 * PIXEL, Matter.one(3e-7, 1e-9))
    assert of.bodies.unit_length == 2 * PIXEL
    assert of.bodies.matter == Matter.one(3e-7, 1e-9)
    for ours, theirs in zip(of.places, expected(true_paths()).places):
        assert ours == pytest.approx(theirs)


def test_the_shape_at_rest_goes_on_with_a_forecast():
    """In pixels of other frames it is as large; bodies that the forecast lacks have other triangles, and none."""
    mesh = truth().snapshots[2].meshes[0]
    coarse = ellipsoid(0, 0.0, 2)
    ahead = replace(forecast(only(true_paths(), [0])), rest=Rest.of(coarse, 7.0, PIXEL))
    of = Expected.of(ahead, truth().times, 2 * PIXEL, Matter.one(*MATERIAL))
    assert of.rest is not None
    assert of.rest.stiffness == 7.0
    assert 2 * PIXEL * of.rest.elastic.membrane.mesh.vertices == pytest.approx(coarse.vertices)
    start = of.on(true_paths().basis)
    path = np.repeat(mesh.vertices[None], start.basis.count, 0)
    other = MovingSurfaces.of_bodies([path], [mesh.faces], start.basis, 2 * PIXEL, start.matter)
    alone = RestShapeKept(1.0, of.rest.elastic, start)
    both = joined(start, other)
    beside = RestShapeKept(1.0, of.rest.elastic, both, of.count)
    assert float(beside.value(both.coefficients, UNUSED)) == pytest.approx(
        float(alone.value(start.coefficients, UNUSED))
    )
    run = BodyTracker(scan(), MATERIAL, TrackOptions(), 0, None, Run(), lambda *_: None, of)
    run.bodies = start
    assert run.shape_at_rest() is not None
    run.bodies = both
    assert run.shape_at_rest() is None


def off(bodies: MovingSurfaces) -> float:
    """Distance along normals (rms) [pixels] from the true bodies, of those that stay in the field."""
    found = []
    for k in range(2):
        faces = true_paths().body(k)[1].numpy()
        ours = np.stack([bodies.bodies(float(t))[k].vertices for t in truth().times])
        true = np.stack([ellipsoid(k, t - 0.5 * (TIMES - 1), 2).vertices for t in range(TIMES)])
        found.append(across(true, ours, faces) / PIXEL)
    return float(np.square(found).mean() ** 0.5)


def test_frames_correct_a_forecast_and_show_what_it_lacks():
    """Two of three bodies, which move away by a pixel: both are pulled back and keep their numbers, and the third joins
    them, though the forecast has not heard of it."""
    two, away = only(true_paths(), [0, 1]), torch.zeros(1, 1, 3)
    away[0, 0, 1] = 1.0
    ahead = two.with_parameters({"coefficients": two.coefficients + away})
    options = replace(TrackOptions(rounds=1, intervals=False, learned=None).with_effort(0.3))
    found = follow(scan(), MATERIAL, options, after=forecast(ahead))
    assert found.bodies.count == 3
    assert off(found.bodies) < 0.25 * off(joined(ahead, only(true_paths(), [2])))
    assert 0.2 < found.moved < 5
    assert "standard errors of the forecast" in found.begun


def test_a_fit_is_drawn_to_the_forecast():
    """Of frames that show nothing, from a pixel beside it; without the prior, bodies stay there."""
    of = replace(expected(true_paths()), band=np.full((len(truth().times), 3), 0.1 * PIXEL))
    faint, start = Matter.one(1e-6 * MATERIAL.delta, 1e-6 * MATERIAL.beta), of.on(true_paths().basis)
    way = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    beside = MovingSurfaces(start.coefficients + way, start.faces, start.of_body, start.basis, PIXEL, faint)
    how = MotionFit(curvature=0.0)
    before, drawn, left = (
        of.deviation(each)
        for each in (
            beside,
            fitted_bodies(motion_fit(scan(), beside, how, expected=of)),
            fitted_bodies(motion_fit(scan(), beside, how)),
        )
    )
    assert drawn < 0.2 * before
    assert left > 0.8 * before


def test_where_frames_say_nothing_the_forecast_stands():
    """Frames of matter so thin that they show nothing: bodies and their standard errors are those of the forecast."""
    faint = DeltaBeta(1e-6 * MATERIAL.delta, 1e-6 * MATERIAL.beta)
    options = replace(TrackOptions(rounds=0, learned=None).with_effort(0.3))
    said = forecast(true_paths())
    found = follow(scan(), faint, options, after=said)
    assert found.moved < 0.5
    one, other = found.halves[:2]
    for k in range(3):
        faces = true_paths().body(k)[1].numpy()
        halves = [np.stack([of.bodies(float(t))[k].vertices for t in said.times]) for of in (one, other)]
        half = 0.5 * across(*halves, faces)
        assert np.sqrt(np.mean(half**2)) == pytest.approx(np.sqrt(np.mean(said.band[:, k] ** 2)), rel=0.35)


def test_two_beams_give_a_forecast_up_where_they_show_more_without_it(monkeypatch):
    """Bodies two pixels away against the true ones; and the true ones against themselves, where the forecast stays."""
    right, away = true_paths(), torch.zeros(3)
    away[1] = 2.0
    wrong = right.with_parameters({"coefficients": right.coefficients + away})
    views = np.flatnonzero(np.isin(np.arange(len(scan())) % 4, (0, 2)))

    def found(run: BodyTracker) -> Followed:
        return Followed(wrong if run.expected is not None and astray else right, [], 2, {}, (3,), moved=1.0)

    monkeypatch.setattr(BodyTracker, "until", lambda run, stage: None)
    monkeypatch.setattr(BodyTracker, "followed", found)
    options = TrackOptions(cells=False)
    for astray, frames, choice in ((True, views, "none"), (False, views, "a forecast"), (True, None, None)):
        seen = scan() if frames is None else scan()[frames]
        kept = follow(seen, MATERIAL, options, after=forecast(right))
        assert [each.choice for each in kept.decisions] == [choice] * (choice is not None)
        assert kept.bodies is (wrong if astray and frames is None else right)


def test_bodies_of_a_forecast_stay():
    """A small one at the surface of another, which would else count as a piece of that."""
    run = BodyTracker(scan(), MATERIAL, TrackOptions(), 0, None, Run(), lambda *_: None, expected(true_paths()))
    assert run.kept(true_paths(), [1]).count == 3
