"""Search for bodies of known rest shape: some are replaced by others, and the best choice of all is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.sparse import csr_array, vstack

from ..fit.run import Run
from ..mesh import TriangleMesh
from .poses import FREER, Explained, Pose
from .shadows import Shadows
from .templates import Hit, Templates, TemplateSearch

LEAST, ALSO = 0.35, 0.8
"""Share of what its shadow is worth by which a body must explain the frames; and share of the best one's from which on
others are taken in the same round."""
TRIED, FIRST_STEPS, STEPS, LAST_STEPS = 4, 8, 5, 15
"""Places that are tried in a round, and steps of the search for better poses: of one, of all, of all in the end."""
SAME_HEIGHT = 1.0
"""Radii within which bodies that two beams might exchange are at one height."""
MOST_PURSUED = 60


def searched(every: Explained, search: TemplateSearch, begun: list[Pose]) -> list[Pose]:
    """`begun` and what is found beside them, without those that explain nothing."""
    found = _add_bodies(every, search, explaining(every, begun))
    return explaining(every, every.improved(found, LAST_STEPS))


def explaining(every: Explained, found: Sequence[Pose]) -> list[Pose]:
    """The bodies that explain enough of the residual of the others."""
    return [pose for pose, share in zip(found, every.shares(found)) if share >= LEAST]


def _add_bodies(every: Explained, search: TemplateSearch, found: list[Pose]) -> list[Pose]:
    """`found`, and those that explain what these leave, one round after the other."""
    left = every.without(found)
    for _ in range(MOST_PURSUED):
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
    left: Explained, search: TemplateSearch, most: int, without: Sequence[np.ndarray] = ()
) -> list[tuple[float, Pose]]:
    """Bodies that explain enough of what is left, with their shares, the best first; none begins near `without`."""
    hits = [_pose_of(hit) for hit in search.tops(left.seen, most, without)]
    poses = [left.improved([pose], FIRST_STEPS)[0] for pose in hits]
    tried = [(left.share(pose), pose) for pose in poses]
    return sorted((one for one in tried if one[0] >= LEAST), key=lambda one: -one[0])


def _pose_of(hit: Hit) -> Pose:
    return Pose(hit.matrix, hit.centre, hit.velocity, np.zeros(3))


def exchanged(every: Explained, search: TemplateSearch, found: list[Pose]) -> list[Pose]:
    """The same bodies, pairs of which have exchanged what two beams show of them, until no exchange is clearly better.

    Two beams see two bodies at one height as they would see two others, each in the shadow of the one in the first
    beam and of the other in the second. Their shapes and motion tell which they are, and small steps do not lead from
    these to those. Pairs are few, so that all are tried; they are compared when all bodies have made room for them.
    """
    least, before = every.value(found), np.inf
    while two_beams(search) and least < (1 - CLEARLY) * before:
        before = least
        for i, j in level_pairs(every, found):
            other = list(found)
            other[i], other[j] = swapped(every, search, found, i, j)
            other = every.improved(other, LAST_STEPS)
            if (value := every.value(other)) < least:
                found, least = other, value
    return found


def two_beams(search: TemplateSearch) -> bool:
    """Whether frames are of two directions."""
    return len(np.unique(search.templates.directions)) == 2


def level_pairs(every: Explained, found: Sequence[Pose]) -> list[tuple[int, int]]:
    """Which bodies two beams see at one height."""
    first, second = (every.seen.rotations[n, 2].numpy() for n in _directions(every))
    height = np.cross(first, second) / np.linalg.norm(np.cross(first, second))
    levels, least = [pose.centre @ height for pose in found], SAME_HEIGHT * every.radius
    return [(i, j) for i in range(len(found)) for j in range(i) if abs(levels[i] - levels[j]) <= least]


def swapped(every: Explained, search: TemplateSearch, found: Sequence[Pose], i: int, j: int) -> list[Pose]:
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


@dataclass
class Pool:
    """Candidates and the shadows they cast.

    What a choice of them leaves of the shadows counts by its square here, so that a table of products says what each
    change of the choice is worth (`best_choice`). Other parts of the field are looked at in other tries; the choice
    puts the best of all together.
    """

    every: Explained
    poses: list[Pose] = field(default_factory=list)
    _rows: list[csr_array] = field(default_factory=list)
    _own: list[float] = field(default_factory=list)

    def add(self, poses: Sequence[Pose]) -> None:
        """Further candidates."""
        for pose in poses:
            self.poses.append(pose)
            self._rows.append(csr_array(self.every.images([pose]).reshape(1, -1).astype(np.float32)))
            self._own.append(self.every.strained([pose]) + float(self.every.hidden([pose])))

    def chosen(self) -> list[Pose]:
        """The choice of bodies that explains most together."""
        if not self.poses:
            return []
        images = csr_array(vstack(self._rows))
        products = (images @ images.T).toarray().astype(np.float64) / self.every.noise**2
        gains = images @ self.every.seen.thickness.ravel() / self.every.noise**2
        return [self.poses[k] for k in np.flatnonzero(best_choice(products, gains - self._own))]


def best_choice(products: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """[C] x, true or false, with the least ½ xᵀ G x - gᵀ x that was found, G the products [C, C], g the gains [C].

    From nothing, and from each candidate alone, the best change is made again and again: one is put in, left out, or
    put in for another, until no such change is better (iterative improvement: Aarts & Lenstra 1997, chapter 1).
    """
    known = set[bytes]()
    ways = [_improved(products, gains, np.arange(len(gains)) == first, known) for first in range(-1, len(gains))]
    return min(ways, key=lambda pair: pair[0])[1]


def _improved(products: np.ndarray, gains: np.ndarray, x: np.ndarray, known: set[bytes]) -> tuple[float, np.ndarray]:
    """The value of the choice that single changes lead to from `x` [C], and that choice; or of the first one from which
    an earlier way went on, for all that were passed are `known`.

    A change by less than rounding is none: equal candidates would be put in for each other for ever.
    """
    own, slope = 0.5 * np.diag(products), products @ x - gains
    largest = max(float(np.abs(products).max(initial=0.0)), float(np.abs(gains).max(initial=0.0)))
    rounding = 4 * len(gains) * np.finfo(float).eps * largest
    while x.tobytes() not in known:
        known.add(x.tobytes())
        flips, inside, outside = np.where(x, own - slope, own + slope), np.flatnonzero(x), np.flatnonzero(~x)
        flip = int(flips.argmin())
        change, gone = float(flips[flip]), [flip]
        if len(inside) and len(outside):
            swaps = flips[inside][:, None] + flips[outside] - products[np.ix_(inside, outside)]
            out, into = np.unravel_index(int(swaps.argmin()), swaps.shape)
            if swaps[out, into] < change:
                change, gone = float(swaps[out, into]), [int(inside[out]), int(outside[into])]
        if change >= -rounding:
            break
        x = x.copy()
        x[gone] = ~x[gone]
        slope = slope + np.where(x[gone], 1, -1) @ products[gone]
    return float(0.5 * x @ (slope - gains)), x


TRIES, MOST_ROUNDS, PATIENCE = 12, 20, 3
"""Tries of a round, of which few bodies need fewer; rounds at most; and those in which nothing clearly better is found,
after which the search ends."""
CLEARLY, WORSE = 3e-3, 0.015
"""Part of the cost by which something is clearly better than the best so far; and by which it may be worse for the
search to go on from it."""
LEAST_DOUBT = 0.05
"""That of a body that explains all of its shadow."""
LOOKED_AT, CHOICE = 6, 0.1
"""Places that are looked at for a body in place of another, and the difference of shares that matters between them."""
MOST_OTHERS = 3
"""Bodies that are taken away beside the first."""
FREE_STEPS = 80
"""Steps to better poses in the end."""

Heard = Callable[[float], None]
"""Takes the share of the search that is done, at most."""


def pursued(
    mesh: TriangleMesh,
    seen: Shadows,
    velocities: np.ndarray,
    begun: Sequence[Pose] = (),
    seed: int = 0,
    on_progress: Heard = lambda share: None,
    run: Run | None = None,
) -> tuple[list[Pose], bool]:
    """Poses of all bodies of the rest shape `mesh` [pixels] that shadows show, on paths near `velocities` [K, 3].

    begun: poses that are known about; bodies are found with and without them, and what explains more is made better.
    The other value: whether that began with them. seed: of the choices of what is taken away. run: keeps the steps.
    """
    run = run or Run()
    search, every = TemplateSearch(Templates.of(mesh, seen), seen, velocities), Explained(mesh, seen, run=run)
    free = Explained(mesh, seen, FREER, run)
    starts = [[], every.improved(begun, LAST_STEPS)] if begun else [[]]
    found = [free.improved(searched(every, search, start), LAST_STEPS) for start in starts]
    found = [exchanged(free, search, poses) for poses in found]
    best = int(np.argmin([free.value(poses) for poses in found]))
    tried = [pose for poses in found for pose in poses]
    better = NeighbourhoodSearch(free, search, seed).better(found[best], tried, on_progress)
    return free.improved(better, FREE_STEPS), best > 0


@dataclass
class NeighbourhoodSearch:
    """Takes some bodies away, looks for others in their place, and keeps what explains more.

    A pursuit takes one body at a time: the first ones may stand for the shadows of several, or for their crossing, and
    those that come later have what is left.
    """

    every: Explained
    search: TemplateSearch
    seed: int = 0

    def __post_init__(self) -> None:
        self._draws, self._pool = np.random.default_rng(self.seed), Pool(self.every)

    def better(
        self, found: list[Pose], tried: Sequence[Pose] = (), on_progress: Heard = lambda share: None
    ) -> list[Pose]:
        """`found`, or what explains more; ends when `PATIENCE` rounds have found nothing clearly better.

        tried: other bodies that may be among the best.

        Slightly worse states are accepted, too (record-to-record travel: Dueck 1993, J. Comput. Phys.
        104, 86): of bodies that stand for each other's shadows all must change before anything is better. Each round
        ends with the best choice among all bodies that were tried so far, and with exchanges (`exchanged`).
        """
        best, least, idle = found, self.every.value(found), 0
        self._pool.add([*found, *tried])
        for turn in range(MOST_ROUNDS if found else 0):
            before, now, tries = least, best, min(TRIES, 2 + len(best))
            for number in range(tries):
                part = number / tries
                on_progress(max((turn + part) / MOST_ROUNDS, (idle + part) / PATIENCE))
                other = self._best_choice() if number == tries - 1 else self._perturb(now)
                value = self.every.value(other)
                now = other if other and value < (1 + WORSE) * least else now
                if value < least:
                    best, least = other, value
            if least < before:
                best = exchanged(self.every, self.search, best)
                least = self.every.value(best)
                self._pool.add(best)
            idle = 0 if least < (1 - CLEARLY) * before else idle + 1
            if idle == PATIENCE:
                break
        return explaining(self.every, best)

    def _perturb(self, found: list[Pose]) -> list[Pose]:
        """Another choice, made better."""
        other = self.every.improved(self._replace(found), LAST_STEPS)
        self._pool.add(other)
        return other

    def _best_choice(self) -> list[Pose]:
        """The best choice among all bodies that were tried, made better."""
        other = explaining(self.every, self.every.improved(self._pool.chosen(), LAST_STEPS))
        other = self.every.improved(other, LAST_STEPS)
        self._pool.add(other)
        return other

    def _replace(self, found: list[Pose]) -> list[Pose]:
        """Replace a body, and some that share its shadows; more likely one with a larger residual about it."""
        gone = self._draw_neighbours(found)
        kept, new = [pose for k, pose in enumerate(found) if k not in gone], list[Pose]()
        beside = left = self.every.without(kept)
        for turn in range(len(gone) + 1):
            tried = candidates(left, self.search, LOOKED_AT, [found[gone[0]].centre] if turn == 0 else ())
            if not tried:
                break
            self._pool.add([pose for _, pose in tried])
            new.append(self._draw_candidate(tried))
            left = left.without(new[-1:])
        return [*kept, *beside.improved(new, LAST_STEPS)]

    def _draw_neighbours(self, found: list[Pose]) -> list[int]:
        """Draw a body and up to `MOST_OTHERS` others, more likely those with a larger common shadow; indices."""
        doubts = self.every.doubts(found) + LEAST_DOUBT
        first = int(self._draws.choice(len(found), p=doubts**2 / (doubts**2).sum()))
        each = self.every.each(found)
        common = np.array([float(torch.minimum(one, each[first]).sum()) for one in each])
        common[first] = 0.0
        count = min(int(self._draws.integers(MOST_OTHERS + 1)), int((common > 0).sum()))
        if count == 0:
            return [first]
        others = self._draws.choice(len(found), count, replace=False, p=common / common.sum())
        return [first, *map(int, others)]

    def _draw_candidate(self, tried: list[tuple[float, Pose]]) -> Pose:
        """Draw one of the bodies that were tried, more likely one that explains more."""
        likely = np.exp([(share - tried[0][0]) / CHOICE for share, _ in tried])
        return tried[int(self._draws.choice(len(tried), p=likely / likely.sum()))][1]
