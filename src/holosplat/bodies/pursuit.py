"""Bodies of known rest shape that explain shadows, found one after the other (matching pursuit: Mallat & Zhang 1993,
IEEE Trans. Signal Process. 41, 3397)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .poses import Explained, Pose
from .templates import Hit, Search

LEAST, ALSO = 0.35, 0.8
"""Share of what its shadow is worth by which a body must explain the frames; and share of the best one's from which on
others are taken in the same round."""
TRIED, FIRST_STEPS, STEPS, LAST_STEPS = 4, 8, 5, 15
"""Places that are tried in a round, and steps of the search for better poses: of one, of all, of all in the end."""
SURE = 0.8
"""Share from which on a body is hardly one that stands for others."""
SAME_HEIGHT = 1.0
"""Radii within which bodies that two beams might exchange are at one height."""
MOST_ROUNDS = 60


def searched(every: Explained, search: Search, begun: list[Pose]) -> list[Pose]:
    """`begun` and what is found beside them, without those that explain nothing."""
    found = _add_bodies(every, search, explaining(every, begun))
    return explaining(every, exchanged(every, search, every.improved(found, LAST_STEPS)))


def explaining(every: Explained, found: Sequence[Pose]) -> list[Pose]:
    """The bodies that explain enough of the residual of the others."""
    return [pose for pose, share in zip(found, every.shares(found)) if share >= LEAST]


def _add_bodies(every: Explained, search: Search, found: list[Pose]) -> list[Pose]:
    """`found`, and those that explain what these leave, one round after the other."""
    left = every.without(found)
    for _ in range(MOST_ROUNDS):
        tried = candidates(left, search, TRIED)
        if not tried:
            break
        least = max(LEAST, ALSO * tried[0][0])
        for _, pose in tried:
            if left.share(pose) >= least:
                found = [*found, pose]
                left = left.without([pose])
        found = every.improved(found, STEPS)
        left = every.without(found)
    return found


def candidates(
    left: Explained, search: Search, most: int, without: Sequence[np.ndarray] = ()
) -> list[tuple[float, Pose]]:
    """Bodies that explain enough of what is left, with their shares, the best first; none begins near `without`."""
    hits = [_pose_of(hit) for hit in search.tops(left.seen, most, without)]
    poses = [left.improved([pose], FIRST_STEPS)[0] for pose in hits]
    tried = [(left.share(pose), pose) for pose in poses]
    return sorted((one for one in tried if one[0] >= LEAST), key=lambda one: -one[0])


def _pose_of(hit: Hit) -> Pose:
    return Pose(hit.matrix, hit.centre, hit.velocity, np.zeros(3))


def exchanged(every: Explained, search: Search, found: list[Pose]) -> list[Pose]:
    """The same bodies, pairs of which have exchanged what two beams show of them where that explains more.

    Two beams see two bodies at one height as they would see two others, each in the shadow of the one in the first
    beam and of the other in the second. Their shapes and motion tell which they are; pairs that explain enough (`SURE`)
    are left as they are.
    """
    if not two_beams(search):
        return found
    found, sure = list(found), every.shares(found) >= SURE
    for i, j in level_pairs(every, found):
        if sure[i] and sure[j]:
            continue
        left = every.without([pose for k, pose in enumerate(found) if k not in (i, j)])
        others = swapped(every, search, found, i, j)
        if left.value(others) < left.value([found[i], found[j]]):
            found[i], found[j] = others
    return every.improved(found, STEPS)


def two_beams(search: Search) -> bool:
    """Whether frames are of two directions."""
    return len(np.unique(search.templates.directions)) == 2


def level_pairs(every: Explained, found: Sequence[Pose]) -> list[tuple[int, int]]:
    """Which bodies two beams see at one height."""
    first, second = (every.seen.rotations[n, 2].numpy() for n in _directions(every))
    height = np.cross(first, second) / np.linalg.norm(np.cross(first, second))
    levels, least = [pose.centre @ height for pose in found], SAME_HEIGHT * every.radius
    return [(i, j) for i in range(len(found)) for j in range(i) if abs(levels[i] - levels[j]) <= least]


def swapped(every: Explained, search: Search, found: Sequence[Pose], i: int, j: int) -> list[Pose]:
    """Exchange the shadows of bodies `i` and `j` in the second of two beams."""
    first, second = (every.seen.rotations[n, :2].numpy() for n in _directions(every))
    left = every.without([pose for k, pose in enumerate(found) if k not in (i, j)])
    both, others = np.concatenate([first, second]), list[Pose]()
    for one, other in ((found[i], found[j]), (found[j], found[i])):
        moved = [
            np.linalg.lstsq(both, np.concatenate([first @ a, second @ b]), rcond=1e-9)[0]
            for a, b in ((one.centre, other.centre), (one.velocity, other.velocity))
        ]
        others.append(_pose_of(search.here(left.seen, moved[0], moved[1])))
    return left.improved(others, 2 * FIRST_STEPS)


def _directions(every: Explained) -> np.ndarray:
    """A frame of each direction of the beams."""
    rows = every.seen.rotations.numpy().reshape(len(every.seen), -1).round(9)
    return np.unique(rows, axis=0, return_index=True)[1]
