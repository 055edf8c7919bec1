"""Which sightings are one body: on numbers alone, for bodies that pass, merge, split, enter, leave, and are missed."""

from __future__ import annotations

from collections.abc import Set

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.motion.track_linking import LinkOptions, Seen, _middle, drift, identified, place_at
from holosplat.representations import TimeBasis

TIMES = 1e-5 * np.arange(10)
RADIUS = 4.0
VOLUME = 4 / 3 * np.pi * RADIUS**3
Bodies = list[tuple[np.ndarray, np.ndarray]]


def sightings(bodies: Bodies, skip: Set[tuple[int, int]] = frozenset(), noise: float = 0.2, seed: int = 0):
    """Of balls [start, step a time], in an order that says nothing; skip: (body, time) that is not seen.

    Returns them, and the body of each.
    """
    random, found = np.random.default_rng(seed), []
    for t in range(len(TIMES)):
        for body, (start, step) in enumerate(bodies):
            if (body, t) not in skip:
                centre = start + t * step + noise * random.normal(size=3)
                found.append((body, Seen(t, centre, VOLUME * (1 + 0.05 * random.normal()), False)))
    order = random.permutation(len(found))
    return [found[k][1] for k in order], [found[k][0] for k in order]


def flowing(count: int = 6, seed: int = 1) -> Bodies:
    """Balls apart, with a flow that differs by a fifth from one to the other, and moves them by 6 radii."""
    random = np.random.default_rng(seed)
    starts = 11.0 * np.stack(np.meshgrid(*[np.arange(3)] * 3), -1).reshape(-1, 3)[:count]
    return [(start, np.array([0.1, 2.5 + 0.5 * random.normal(), -0.2])) for start in starts]


def assert_kept(tracks, bodies, wanted: int) -> None:
    """As many tracks as bodies, each of one body."""
    assert sorted(sorted({bodies[k] for k in track}) for track in tracks) == [[b] for b in range(wanted)]


@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_flow_keep_their_identity(seed):
    seen, bodies = sightings(flowing(seed=seed), seed=seed)
    tracks = identified(seen, TIMES)
    assert_kept(tracks, bodies, 6)
    assert all([seen[k].time for k in track] == list(range(10)) for track in tracks)
    assert drift(tracks, seen, TIMES)[1] == pytest.approx(2.5e5, rel=0.25)


def test_bodies_that_pass_each_other_are_told_by_their_velocity():
    """Their distance is less than a radius at one time, when the nearest sighting is the other's."""
    way = np.array([3.0, 0.0, 0.0])
    pair = [(np.array([-13.5, 0.0, 0.0]), way), (np.array([13.5, 3.0, 0.0]), -way)]
    seen, bodies = sightings(pair, noise=0.1)
    assert_kept(identified(seen, TIMES), bodies, 2)


def test_a_gap_is_closed_and_its_place_known():
    bodies = flowing(3)
    seen, of = sightings(bodies, {(1, 4), (1, 5), (1, 6)}, noise=0.0)
    tracks = identified(seen, TIMES)
    assert_kept(tracks, of, 3)
    (track,) = (track for track in tracks if of[track[0]] == 1)
    assert len(track) == 7
    start, step = bodies[1]
    assert place_at(track, 5, seen, TIMES, np.zeros(3)) == pytest.approx(start + 5 * step)


def test_beyond_a_gap_that_is_too_long_a_body_is_no_other_one():
    seen, _ = sightings(flowing(1), {(0, 4), (0, 5), (0, 6)}, noise=0.0)
    for gap, count in ((2, 4), (3, 7)):
        assert [len(track) for track in identified(seen, TIMES, LinkOptions(gap=gap))] == [count]


def test_a_merger_is_mended():
    """At three times two bodies that touch are seen as one; both go on, and the merged one is no body."""
    pair = [(np.array([0.0, 0.0, 0.0]), np.array([0.0, 2.5, 0.0])), (np.array([7.5, 0, 0]), np.array([0.0, 2.5, 0.1]))]
    seen, of = sightings(pair, {(b, t) for b in (0, 1) for t in (4, 5, 6)}, noise=0.1)
    for t in (4, 5, 6):
        seen.append(Seen(t, np.array([3.75, 2.5 * t, 0.0]), 2.05 * VOLUME, False))
        of.append(2)
    tracks = identified(seen, TIMES)
    assert_kept(tracks, of, 2)
    assert [len(track) for track in tracks] == [7, 7]


def test_a_split_is_mended():
    """At two times a body is seen as two halves: they are no bodies of their own."""
    seen, of = sightings(flowing(2), {(0, 4), (0, 5)}, noise=0.1)
    start, step = flowing(2)[0]
    for t in (4, 5):
        for side in (-1, 1):
            seen.append(Seen(t, start + t * step + np.array([side * 2.0, 0, 0]), 0.5 * VOLUME, False))
            of.append(2)
    assert_kept(identified(seen, TIMES), of, 2)


def test_bodies_enter_and_leave():
    """What the edge cuts has any volume; a body that is seen for a moment there is one, elsewhere it is noise."""
    seen, of = sightings(flowing(2), noise=0.1)
    for t, part in ((0, 0.6), (1, 0.3)):
        seen.append(Seen(t, np.array([40.0, 60.0 + 2.5 * t, 0.0]), part * VOLUME, True))
        of.append(2)
    seen += [Seen(9, np.array([80.0, 0.0, 0.0]), 0.4 * VOLUME, True), Seen(5, np.array([60.0, 0, 30]), VOLUME, False)]
    of += [3, 4]
    assert_kept(identified(seen, TIMES), of, 4)


def test_nothing_seen_is_no_body():
    assert identified([], TIMES) == []


@pytest.mark.parametrize("bad", [{"gate": -1.0}, {"change": 1.0}, {"gap": -1}, {"least": 0}])
def test_options_out_of_range_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        LinkOptions(**bad)


@pytest.mark.parametrize(
    ("count", "own", "bend", "degree"),
    [(2, 5e5, 0.0, 0), (6, 0.0, 0.0, 0), (6, 5e5, 0.0, 1), (10, 5e5, 0.0, 1), (10, 5e5, 1e11, 2)],
    ids=["two detections", "as the flow", "faster", "faster, many", "bent"],
)
def test_a_path_is_as_free_as_predicts_detections(count, own, bend, degree):
    """Beside a flow of 2.5e5 along y: one or two detections, or such as the flow carries, do not tell a velocity."""
    flow, basis = np.array([0.0, 2.5e5, 0.0]), TimeBasis(TIMES[0], TIMES[-1], 2)
    noise = 0.05 * np.random.default_rng(3).normal(size=(count, 3))
    along = flow[1] * TIMES[:count] + own * TIMES[:count] + bend * TIMES[:count] ** 2
    seen = [Seen(t, np.array([0.0, along[t], 0.0]) + noise[t], VOLUME, False) for t in range(count)]
    found = _middle(tuple(range(count)), 0, seen, TIMES, flow, basis)
    slopes = basis.weights(TIMES, 1) @ found
    wanted = flow[1] + (own + 2 * bend * TIMES if degree else 0.0) * np.ones(10)
    np.testing.assert_allclose(slopes[:, 1], wanted, rtol=0.1 if degree else 1e-6)
    assert (np.ptp(slopes[:, 1]) > 1.0) == (degree == 2)
