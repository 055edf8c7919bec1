"""Two bodies that one beam each shows, in place of one where both beams cross."""

from __future__ import annotations

import numpy as np

from helpers.motion_shadows import OTHER, TURN, cell, pose, shadows
from holosplat.bodies.poses import FREER, Explained, Pose
from holosplat.bodies.pursuit import merged
from holosplat.bodies.shadows import Shadows
from holosplat.bodies.templates import Search, Templates

STILL = np.zeros((1, 3))


def still(turn: np.ndarray, centre: tuple[float, float, float]) -> Pose:
    return pose(turn, centre, 0.0)


def looked(seen: Shadows, found: list[Pose]) -> list[Pose]:
    return merged(Explained(cell(), seen, FREER), Search(Templates.of(cell(), seen), seen, STILL), found)


def test_two_that_one_beam_each_shows_become_one():
    truth, beside = still(TURN, (9.0, 2.0, -8.0)), still(OTHER, (-6.0, -10.0, 3.0))
    seen = shadows([truth, beside])
    found = looked(seen, [still(TURN, (9.0, 2.0, 30.0)), beside, still(TURN, (30.0, 2.5, -8.0))])
    assert len(found) == 2
    assert min(np.linalg.norm(one.centre - truth.centre) for one in found) < 0.4
    assert min(np.linalg.norm(one.centre - beside.centre) for one in found) < 0.4


def test_two_at_other_heights_stay_two():
    truth = [still(TURN, (9.0, 8.0, 30.0)), still(OTHER, (30.0, -4.0, -8.0))]
    assert len(looked(shadows(truth), truth)) == 2


def test_two_of_unlike_shadows_stay_two():
    """The one is upright in its beam, the other lies flat in its own: no body has both heights."""
    upright, flat = np.eye(3), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    truth = [still(upright, (9.0, 2.0, 30.0)), still(flat, (30.0, 2.0, -8.0))]
    assert len(looked(shadows(truth), truth)) == 2


def test_three_beams_are_left_alone():
    truth = still(TURN, (9.0, 2.0, -8.0))
    ghosts = [still(TURN, (9.0, 2.0, 30.0)), still(TURN, (30.0, 2.5, -8.0))]
    assert looked(shadows([truth], (0.0, 45.0, 90.0)), ghosts) == ghosts
