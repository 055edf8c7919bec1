"""Bodies of known rest shape on first paths, found in the frames of several times together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..bodies.neighbourhood_search import Heard
from ..bodies.poses import Pose
from ..bodies.rest_shape import KnownBody, moments, stretched_like
from ..bodies.search import BodySearch, sized
from ..bodies.shadows import Shadows
from ..checks import require
from ..fit.run import Run
from ..geometry import Views
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Scan
from .elastic import Elastic, Rest

SPREAD = (0.85, 1.0, 1.15)
"""Velocities of the search over that of all matter together: a channel's flow is slower at its walls."""


class KnownBodies:
    """The search for bodies of `body`'s rest shape in the training frames of a scan, of views of one pixel size."""

    def __init__(self, train: Scan, material: DeltaBeta, body: KnownBody, size: float = 1.0) -> None:
        """size: of all bodies, relative to the given one."""
        times, self.pixel = train.instants, train.views.pixel_size
        self.material, self.body, self.size = material, body, size
        self.first, self.last = float(times[0]), float(times[-1])
        chosen = times[np.unique(np.rint(np.linspace(0, len(times) - 1, body.instants)).astype(int))]
        frames = train[np.flatnonzero(np.isin(train.exposures.time, chosen))]
        self.fine = body.mesh(self.pixel)
        self.search = BodySearch.of(frames, material, body, (self.first, self.last))
        self.seen, self.bin = self.search.seen, self.search.bin
        self.velocities = drift(self.seen) * np.array(SPREAD)[:, None]
        self.of_begun = False

    def bodies(
        self,
        basis: TimeBasis,
        known: MovingSurfaces | None = None,
        begun: MovingSurfaces | None = None,
        seed: int = 0,
        on_progress: Heard = lambda share: None,
        run: Run | None = None,
    ) -> MovingSurfaces | None:
        """Bodies on paths of `basis` that explain what `known` ones leave of the frames; None where there are none.

        begun: bodies of any shape with which the search may begin; `of_begun` says whether it did. The first search
        finds the size of all bodies. run: keeps the steps.
        """
        search, mesh = self.search, sized(self.search.mesh, self.size)
        if known is not None:
            search = replace(search, seen=self.seen.without(self._shadows(known)))
        like = [] if begun is None else poses_like(begun, mesh, (self.first, self.last), self.pixel * self.bin)
        found, self.of_begun = search.poses(self.velocities, like, self.size, seed, on_progress, run)
        if not found:
            return None
        if known is None and self.body.uncertain > 0:
            self.size, found = search.of_best_size(found, self.size, run)
        return self._paths([pose.scaled(self.bin) for pose in found], basis)

    def _shadows(self, bodies: MovingSurfaces) -> np.ndarray:
        """[N, H, W] thickness of bodies in the frames of the search."""
        middle, half = 0.5 * (self.last + self.first), 0.5 * (self.last - self.first)
        nodes = [bodies.at(middle + half * float(t)).vertices.detach() / self.bin for t in self.seen.times]
        return self.seen.project(nodes, bodies.faces).numpy()

    def _paths(self, poses: Sequence[Pose], basis: TimeBasis) -> MovingSurfaces:
        rest = sized(self.fine, self.size)
        middle, half = 0.5 * (self.last + self.first), 0.5 * (self.last - self.first)
        when = np.linspace(-1, 1, 4 * basis.count)
        nodes = [np.array([pose.nodes(rest.vertices, t) for t in when]) for pose in poses]
        paths = [self.pixel * basis.fitted(middle + half * when, one) for one in nodes]
        matter = Matter.one(*self.material)
        return MovingSurfaces.of_bodies(paths, [rest.faces] * len(paths), basis, self.pixel, matter)


def poses_like(bodies: MovingSurfaces, rest: TriangleMesh, ends: tuple[float, float], unit: float) -> list[Pose]:
    """Poses of `rest` like `bodies` between the times `ends` [s], lengths in `unit` [m]: as long along the same axes as
    these are in the middle of the time, on the straight paths of their centres."""
    first, middle, last = (bodies.bodies(time) for time in (ends[0], 0.5 * sum(ends), ends[1]))
    centres = [np.array([moments(one)[1] / unit for one in meshes]) for meshes in (first, middle, last)]
    return [
        Pose(stretched_like(mesh, rest), centre, 0.5 * (end - start), np.zeros(3))
        for mesh, start, centre, end in zip(middle, *centres)
    ]


def at_rest(body: KnownBody, pixel: float, size: float) -> Rest:
    """The known shape of bodies that are `size` times as large as `body`, on paths in `pixel` [m]."""
    return Rest(Elastic(sized(body.mesh(pixel), size)), body.stiffness)


def beam_directions(views: Views) -> np.ndarray:
    """[U, 3] different directions of the beams, in the object frame."""
    return np.unique(views.rotations[:, 2].round(6), axis=0)


def drift(seen: Shadows) -> np.ndarray:
    """Velocity [3] of all matter together [pixels per unit of time].

    By it shadows of one time correlate best with those of the next one, in each direction that was seen at both.
    """
    rows, moves, instants = [], [], np.unique(seen.times)
    require(len(instants) > 1, "bodies are followed through frames of two times or more.")
    directions = seen.rotations.numpy().reshape(len(seen), -1).round(9)
    for direction in np.unique(directions, axis=0):
        own = np.flatnonzero((directions == direction).all(1))
        own = own[np.argsort(seen.times[own])]
        if len(own) < 2:
            continue
        pause = float(np.median(np.diff(seen.times[own])))
        pairs = [(i, j) for i, j in pairwise(own) if abs(seen.times[j] - seen.times[i] - pause) < 0.2 * pause]
        rows.append(seen.rotations[own[0], :2].numpy())
        moves.append(_displacements(seen, pairs) / pause)
    if not rows:
        return np.zeros(3)
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(moves), rcond=1e-6)[0]


def _displacements(seen: Shadows, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Displacement (x, y) [pixels] from the first to the second frame of each pair."""
    size = tuple(2 * n for n in seen.shape)
    total = np.zeros(size)
    for i, j in pairs:
        first, second = (np.fft.rfft2(seen.thickness[k], s=size) for k in (i, j))
        total += np.fft.irfft2(second * first.conj(), s=size)
    row, column = np.unravel_index(int(total.argmax()), size)
    return np.array(
        [(column + seen.shape[1]) % size[1] - seen.shape[1], (row + seen.shape[0]) % size[0] - seen.shape[0]]
    )
