"""Runs of `follow` that are cut off and go on, and halves of the frames."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from helpers.kept import Kept
from helpers.moving_ellipsoids import MATERIAL, PIXEL, TIMES, scan, true_paths
from holosplat.fit import run as engine
from holosplat.fit.problem import Schedule
from holosplat.motion import body_tracker
from holosplat.motion import fit as path_fits
from holosplat.motion.fit import PathOptions, motion_fit
from holosplat.motion.measures import ASTRAY, astray, halves_of, standard_errors, tell_shapes
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import TimeBasis

SHORT = {name: replace(getattr(TrackOptions(), name), schedule=Schedule(steps=3)) for name in ("stiff", "soft", "half")}
QUICK = replace(TrackOptions(), rounds=1, paths=PathOptions(degree=1, pieces=1), **SHORT)
STAGES = ("sightings", "first paths", "stiff", "beside", "paths", "soft", "twins", "halves", "done")


@pytest.fixture(autouse=True)
def frequent(monkeypatch):
    """Fits are kept after every step, and each time sees the true bodies at once."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(
        body_tracker, "sightings", lambda frames, material, options, network: seen(float(frames.instants[0]))
    )


def seen(time: float):
    return [body_tracker.Detection(mesh, False) for mesh in true_paths().bodies(time)]


def three_views():
    return scan()[np.flatnonzero(np.arange(len(scan())) % 4 < 3)]


@cache
def whole() -> tuple[Kept, body_tracker.Followed]:
    kept = Kept()
    return kept, follow(scan(), MATERIAL, QUICK, journal=kept)


def test_every_stage_is_kept():
    named = [state["next"] for state in whole()[0].plain]
    assert [name for k, name in enumerate(named) if name not in named[:k]] == list(STAGES)
    assert sum(state["fit"] is not None for state in whole()[0].plain) == 3 * (1 + 1 + 4)


@pytest.mark.parametrize("cut", ["sightings", "first paths", "in stiff", "beside", "in soft", "in halves", "done"])
def test_a_run_that_was_cut_off_goes_on_as_if_nothing_had_happened(cut):
    """From every stage, and from the middle of fits: bodies, halves and records are the same bit for bit."""
    states, result = whole()
    name, within = cut.removeprefix("in "), cut.startswith("in ")
    number = next(k for k, one in enumerate(states.plain) if one["next"] == name and (one["fit"] is not None) == within)
    again = follow(scan(), MATERIAL, QUICK, journal=Kept(states.states[: number + 1]))
    assert torch.equal(again.bodies.coefficients, result.bodies.coefficients)
    assert len(again.halves) == len(result.halves) == 4
    for one, other in zip(again.halves, result.halves):
        assert torch.equal(one.coefficients, other.coefficients)
    without = lambda records: [{k: v for k, v in one.items() if k != "seconds"} for one in records]  # noqa: E731
    assert without(again.records) == without(result.records)
    assert again.found == result.found == (3,) * TIMES


def test_the_fit_after_twins_goes_on_too(monkeypatch):
    """Where twins are taken, all bodies are fitted softly again, from these."""

    def moved(run, bodies):
        return bodies.with_parameters({"coefficients": bodies.coefficients + 0.3})

    monkeypatch.setattr(body_tracker.BodyTracker, "told_from_twins", moved)
    result = follow(scan(), MATERIAL, QUICK, journal=(kept := Kept()))
    named = [state["next"] for state in kept.plain]
    assert named.index("twins") < named.index("soft again") < named.index("halves")
    assert not torch.equal(result.bodies.coefficients, whole()[1].bodies.coefficients)
    number = next(k for k, one in enumerate(kept.plain) if one["next"] == "soft again" and one["fit"] is not None)
    again = follow(scan(), MATERIAL, QUICK, journal=Kept(kept.states[: number + 1]))
    assert torch.equal(again.bodies.coefficients, result.bodies.coefficients)


def test_ctrl_c_in_a_fit_loses_no_step(monkeypatch):
    """It is passed on, after the state is kept."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 1e9)

    def stop(stage, fraction, record):
        if stage == "soft fit" and fraction > 0.5:
            raise KeyboardInterrupt

    kept = Kept()
    with pytest.raises(KeyboardInterrupt):
        follow(scan(), MATERIAL, QUICK, journal=kept, on_progress=stop)
    assert kept.plain[-1]["next"] == "soft"
    assert kept.plain[-1]["fit"]["step"] == 2
    again = follow(scan(), MATERIAL, QUICK, journal=kept)
    assert torch.equal(again.bodies.coefficients, whole()[1].bodies.coefficients)


def test_times_that_were_looked_at_are_not_looked_at_again(monkeypatch):
    """Cut off by Ctrl-C at the third time, of which nothing is kept."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 1e9)
    looked = list[float]()

    def look(frames, *given, network):
        looked.append(float(frames.instants[0]))
        if len(looked) == 3:
            raise KeyboardInterrupt
        return seen(looked[-1])

    monkeypatch.setattr(body_tracker, "sightings", look)
    with pytest.raises(KeyboardInterrupt):
        follow(scan(), MATERIAL, QUICK, journal=(kept := Kept()))
    assert [(one["next"], len(one["stage_steps"])) for one in kept.plain] == [("sightings", 2)]
    again = follow(scan(), MATERIAL, QUICK, journal=kept)
    assert len(looked) == TIMES + 1 + TIMES  # the third twice; and all beside the bodies
    assert torch.equal(again.bodies.coefficients, whole()[1].bodies.coefficients)


def test_fits_of_the_choice_of_paths_are_not_made_again(monkeypatch):
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 1e9)
    free, fits = replace(QUICK, paths=PathOptions(degree=1)), list[int]()
    result = follow(scan(), MATERIAL, free, journal=(every := Kept()))
    at = next(k for k, one in enumerate(every.plain) if one["next"] == "paths")

    def fitted(frames, start, *given, expected):
        fits.append(start.basis.pieces)
        if len(fits) == 2:
            raise KeyboardInterrupt
        return motion_fit(frames, start, *given, expected=expected)

    monkeypatch.setattr(path_fits, "motion_fit", fitted)
    with pytest.raises(KeyboardInterrupt):
        follow(scan(), MATERIAL, free, journal=(kept := Kept(every.states[: at + 1])))
    again = follow(scan(), MATERIAL, free, journal=kept)
    assert torch.equal(again.bodies.coefficients, result.bodies.coefficients)
    assert fits[:4] == [1, 1, 1, 2]  # the first, the second cut off, that again, and the one with finer paths


def test_halves_share_no_frame():
    basis = TimeBasis(0.0, 1.0, 1)
    (early, late), (some, others) = halves_of(scan(), basis)
    times = scan().exposures.time
    assert set(times[early]) & set(times[late]) == set()
    assert sorted([*early, *late]) == sorted([*some, *others]) == list(range(len(scan())))
    for part in (some, others):  # all times, two views of each, and the same views
        assert np.array_equal(np.unique(times[part], return_counts=True)[1], np.full(TIMES, 2))
        assert np.array_equal(scan().views.rotations[part][:2], scan().views.rotations[part][-2:])
    assert len(halves_of(scan(), TimeBasis(0.0, 1.0, 2))) == 1  # two times do not tell parabolas
    three = three_views()
    assert len(halves_of(three, basis)) == 1
    assert halves_of(three, TimeBasis(0.0, 1.0, 2)) == []


def test_halves_of_few_views_begin_apart(monkeypatch):
    """By a tenth of a body's radius to either side, at all times alike; those of four views begin with the result."""
    bodies = true_paths()
    one, other = (astray(bodies, 3, side).coefficients - bodies.coefficients for side in (1, -1))
    torch.testing.assert_close(one, -other)
    torch.testing.assert_close(one, one[:1].expand_as(one))
    own, _ = bodies.body(1)
    shape = bodies.coefficients[:, own].mean(0)
    radius = float((shape - shape.mean(0)).square().sum(1).mean().sqrt())
    assert 0.5 < float(one[0, own].square().sum(1).mean().sqrt()) / (ASTRAY * radius) < 3
    assert tell_shapes(scan())
    assert not tell_shapes(three_views())
    monkeypatch.setattr(body_tracker.BodyTracker, "fitted", lambda run, name, frames, start, *given: start)
    result = follow(three_views(), MATERIAL, QUICK)
    apart = result.halves[0].coefficients - result.halves[1].coefficients
    middle = 0.5 * (result.halves[0].coefficients + result.halves[1].coefficients)
    assert float(apart.square().mean()) > 100 * float((middle - result.bodies.coefficients).square().mean())


def test_halves_that_begin_apart_are_fitted_to_the_end_where_no_shape_is_known(monkeypatch):
    steps: list[tuple[str, int]] = []

    def fitted(run, name, frames, start, how, light, expected=None):
        steps.append((name, how.schedule.steps))
        return start

    monkeypatch.setattr(body_tracker.BodyTracker, "fitted", fitted)
    monkeypatch.setattr(body_tracker.BodyTracker, "on_chosen_paths", lambda run, bodies: bodies)
    long = replace(QUICK, soft=replace(QUICK.soft, schedule=Schedule(steps=7)))
    for frames, wanted in ((three_views(), [7, 7]), (scan(), [3, 3, 3, 3])):
        steps.clear()
        follow(frames, MATERIAL, long)
        assert [count for name, count in steps if name == "intervals"] == wanted


def test_standard_errors_are_half_of_what_halves_disagree_by():
    """All bodies moved by the same, one way in one half and the other way in the other: that is the error; √2 less if
    another pair of halves agrees."""
    bodies, push = true_paths(), torch.tensor([0.2, -0.1, 0.0], dtype=torch.float64)
    one, other = (bodies.with_parameters({"coefficients": bodies.coefficients + s * push}) for s in (1, -1))
    found = standard_errors(bodies, [one, other], scan())
    assert found["x_m"] == pytest.approx(np.full((TIMES, 3), 0.2 * PIXEL), rel=1e-6)
    assert found["y_m"] == pytest.approx(np.full((TIMES, 3), 0.1 * PIXEL), rel=1e-6)
    assert found["z_m"] == pytest.approx(np.zeros((TIMES, 3)), abs=1e-9 * PIXEL)
    assert found["volume_m3"] == pytest.approx(np.zeros((TIMES, 3)), abs=1e-6 * PIXEL**3)
    twice = standard_errors(bodies, [one, other, bodies, bodies], scan())
    assert twice["x_m"] == pytest.approx(found["x_m"] / 2**0.5, rel=1e-6)
    assert standard_errors(bodies, [], scan()) == {}


def test_half_of_an_error_is_the_body_s_own():
    """One of three bodies, which are all in the field, differs: the others have their part of the common error."""
    bodies, moved = true_paths(), true_paths().coefficients.clone()
    moved[:, bodies.body(0)[0], 0] += 0.4
    found = standard_errors(bodies, [bodies.with_parameters({"coefficients": moved}), bodies], scan())["x_m"] / PIXEL
    seen_parts = 2 + np.array([1.0])  # of three, where all are whole
    common = 0.04 / seen_parts[0]
    assert found[0, 0] ** 2 == pytest.approx(0.5 * 0.04 + 0.5 * common, rel=0.2)
    assert found[0, 1] ** 2 == pytest.approx(0.5 * common, rel=0.3)
