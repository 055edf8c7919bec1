"""One body where both beams cross, in place of two that one beam each shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.motion_shadows import OTHER, TURN, cell, pose, shadows
from holosplat.bodies import neighbourhood_search
from holosplat.bodies.neighbourhood_search import Pool, pursued
from holosplat.bodies.poses import FREER, HIDDEN, Explained, Pose
from holosplat.bodies.shadows import Shadows

TRUTH = (9.0, 2.0, -8.0)
GHOSTS = ((9.0, 2.0, 30.0), (30.0, 2.0, -8.0))
"""The one is beyond the second beam's field, the other beyond the first one's."""


def still(turn: np.ndarray, centre: tuple[float, float, float]) -> Pose:
    return pose(turn, centre, 0.0)


def at_one_time(poses: list[Pose]) -> Shadows:
    """Of bodies at rest at time 0: at any other, frames tell no centre from a velocity."""
    return replace(shadows(poses).at([0, 1]), times=np.zeros(2))


def explained(seen: Shadows) -> Explained:
    return Explained(cell(), seen, FREER)


def test_what_one_beam_shows_alone_costs_a_part_of_the_shadow_in_the_other():
    found = [still(TURN, TRUTH), *(still(TURN, ghost) for ghost in GHOSTS)]
    every = explained(at_one_time(found[:1]))
    whole, hidden = HIDDEN * every.shadow, every.hidden(found)
    assert not explained(shadows(found[:1])).hidden(found).any()  # three times
    assert hidden.tolist() == pytest.approx([0.0, whole, whole], rel=0.03, abs=0.01 * whole)


def test_one_body_is_worth_more_than_two_that_hide():
    every = explained(at_one_time([still(TURN, TRUTH)]))
    one, ghosts = [still(TURN, TRUTH)], [still(TURN, ghost) for ghost in GHOSTS]
    of_one, of_ghosts = (float(every.cost(every.seen.thickness - every.images(found))) for found in (one, ghosts))
    assert of_ghosts == pytest.approx(of_one, abs=1e-3 * float(every.cost(every.target)))
    assert every.value(one) < every.value(ghosts)


def test_the_search_leaves_bodies_that_hide(monkeypatch):
    monkeypatch.setattr(neighbourhood_search, "PATIENCE", 1)
    truth, beside = still(TURN, TRUTH), still(OTHER, (-6.0, -10.0, 3.0))
    begun = [beside, *(still(TURN, ghost) for ghost in GHOSTS)]
    found, _ = pursued(cell(), at_one_time([truth, beside]), np.zeros((1, 3)), begun)
    assert len(found) == 2
    for one in (truth, beside):
        assert min(np.linalg.norm(other.centre - one.centre) for other in found) < 0.5


def test_a_body_that_one_beam_alone_shows_is_kept():
    truth = still(TURN, (9.0, 8.0, 30.0))
    found, _ = pursued(cell(), at_one_time([truth]), np.zeros((1, 3)), [truth])
    assert len(found) == 1
    assert np.abs(found[0].centre[:2] - truth.centre[:2]).max() < 0.5


def test_a_choice_of_candidates_prefers_what_does_not_hide():
    every = explained(at_one_time([still(TURN, TRUTH)]))
    pool = Pool(every)
    pool.add([*(still(TURN, ghost) for ghost in GHOSTS), still(TURN, TRUTH)])
    assert [tuple(one.centre) for one in pool.chosen()] == [TRUTH]
