"""Bodies at single times: volumes cut into closed surfaces, and bodies that the frames show beside known ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from ..baselines import HolographicTV, holographic_tv
from ..bodies.rest_shape import EDGE, LEAST_VOLUME, LEVEL, SMOOTHING, centroid, cut_bodies, is_cut
from ..fit.residuals import Prediction
from ..geometry import Grid, Views
from ..inference import Decision, Score, select
from ..learning.network import Guess
from ..learning.start import Guessed, LearnedStart, guess_matter, missing_thickness
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh, ball_radius
from ..progress import Progress
from ..ranges import Pixels, Weight, Within, ranged
from ..representations import MovingSurfaces, VoxelGrid
from ..scan import Scan


@dataclass(frozen=True)
class Detection:
    """A body at one time. mesh: its surface [m]; cut: whether it goes on beyond the field, so that a part is seen."""

    mesh: TriangleMesh
    cut: bool

    def state(self) -> dict[str, Any]:
        """Tensors and plain values, for a checkpoint; `from_state` reads them."""
        arrays = {name: torch.from_numpy(getattr(self.mesh, name)) for name in ("vertices", "faces")}
        return {**arrays, "name": self.mesh.name, "cut": self.cut}

    @classmethod
    def from_state(cls, saved: Mapping[str, Any]) -> Detection:
        """The detection of a `state`."""
        return cls(TriangleMesh(saved["vertices"].numpy(), saved["faces"].numpy(), saved["name"]), bool(saved["cut"]))

    @property
    def volume(self) -> float:
        """The visible volume [m³]."""
        return self.mesh.volume

    @property
    def centre(self) -> np.ndarray:
        """The middle `(x, y, z)` [m] of what is seen: the centroid of the volume (divergence theorem)."""
        return centroid(self.mesh)

    @property
    def reach(self) -> float:
        """Radius [m] of a ball of its volume."""
        return ball_radius(abs(self.volume))


@dataclass(frozen=True)
@ranged
class SightingOptions:
    """How bodies are found in the frames of one time."""

    volume: HolographicTV = field(default_factory=lambda: HolographicTV(iterations=60, corrections=0))
    """The volume of one time by itself: 160 iterations find no other bodies than 60 do."""
    level: Annotated[float, Within(0.01, 0.99)] = LEVEL
    """Occupancy at the surface."""
    least_volume: Weight = LEAST_VOLUME
    """Bodies of fewer voxels are left out: noise, or too little to be followed."""
    smoothing: int = SMOOTHING
    """Steps that smooth away the voxels' traces."""
    edge: Pixels = EDGE
    """Bodies that come nearer to the field's edge than this are cut by it [pixels]."""


def sightings(
    scan: Scan,
    material: DeltaBeta,
    options: SightingOptions = SightingOptions(),
    on_progress: Progress = lambda stage, part: None,
    network: Guess | None = None,
) -> list[Detection]:
    """The bodies of `material` in the frames of `scan`, of one time, the largest first; none where nothing is seen.

    network: guesses the volume, which is made by total variation without one.
    """
    values, grid = occupancy(scan, material, options, on_progress, network)
    how = options.level, options.least_volume, options.smoothing
    bodies = cut_bodies(values.numpy(), grid, scan.views.finest, *how)
    return [Detection(body, is_cut(body, scan.views, options.edge)) for body in bodies]


def occupancy(
    scan: Scan, material: DeltaBeta, options: SightingOptions, on_progress: Progress, network: Guess | None
) -> tuple[Tensor, Grid]:
    """The volume [Z, Y, X] of one time, and its voxels; by `network`, if there is one."""
    if network is None:
        return holographic_tv(scan, material, options.volume, on_progress)
    found = guess_matter(scan, material, network, on_progress)
    return found.values, found.grid


NAME = "bodies at single times"
TOMOGRAPHY, NETWORK = "tomography", "network's guess"


def network_for(
    scan: Scan, material: DeltaBeta, options: SightingOptions, how: LearnedStart, on_progress: Progress
) -> tuple[Guess | None, Decision]:
    """The network whose guesses show the bodies of `material` in the frames of one time, `scan`, better; or None.

    Both volumes are cut at the bodies' level, for bodies are full, and their shadows compared with retrieved thickness.
    Tomography, the null, was fitted to these frames, and the guess was not.
    """
    trained = how.network
    found = guess_matter(scan, material, trained.network, on_progress)
    values, grid = occupancy(scan, material, options, on_progress, None)
    seen = VoxelGrid(values[None], grid, Matter.one(*material)).resampled(found.grid).values[0]
    scores = {TOMOGRAPHY: missed_by_bodies(seen, found, options.level)}
    scores[NETWORK] = missed_by_bodies(found.values, found, options.level)
    decision = select(NAME, tuple(scores), lambda name, fold: scores[name], by="frames of one time")
    return (trained.network if decision.choice == NETWORK else None), decision


def missed_by_bodies(values: Tensor, found: Guessed, level: float) -> Score:
    """Relative residual of the thickness that the network saw, with full bodies.

    values: [Z, Y, X] on the voxels of `found`, of which what is above `level` is full
    """
    return Score.of(missing_thickness((values > level).to(torch.float32), found.images, found.taps)[0])


CENTRES, PART, NEAR_PX = 0.6, 0.5, 2.0
"""When a body is one of its own: radii between centres, share of the median volume, and distance [pixels]."""
SURE = 0.75
"""Share of the median volume from which on a body is believed before all others are known."""
DARKEST = 0.05
"""Relative intensity of a predicted pixel below which it divides no further."""


def beside(train: Scan, bodies: MovingSurfaces, oversample: int) -> Scan:
    """The frames over those that `bodies` give: nearly what the matter that is left would give by itself.

    Phases of bodies add up in the exit wave, whose product with the waves of others is what is measured; behind the
    sample that is right to first order in the phases, which a first guess of what is left can do with.
    """
    said = predicted(train, bodies, oversample)
    return replace(train, frames=(train.frames / np.maximum(said, DARKEST)).astype(np.float32))


def predicted(train: Scan, bodies: MovingSurfaces, oversample: int) -> np.ndarray:
    """[N, H, W]: the frames that `bodies` give in the exposures of `train`."""
    said = Prediction(bodies, train.exposures, oversample)
    with torch.no_grad():
        return np.stack([said.view(v).frames()[0].numpy() for v in range(len(train))])


def joined(one: MovingSurfaces, other: MovingSurfaces) -> MovingSurfaces:
    """All bodies of two sets, those of `one` first; of the same basis, unit and material."""
    return MovingSurfaces(
        torch.cat([one.coefficients.detach(), other.coefficients.detach()], dim=1),
        torch.cat([one.faces, other.faces + one.coefficients.shape[1]]),
        torch.cat([one.of_body, other.of_body + one.count]),
        one.basis,
        one.unit_length,
        one.matter,
        one.lines,
    )


def only(bodies: MovingSurfaces, numbers: Sequence[int]) -> MovingSurfaces:
    """The bodies `numbers`, in that order; at least one."""
    parts = [bodies.body(k) for k in numbers]
    starts = np.cumsum([0, *(len(used) for used, _ in parts[:-1])])
    return MovingSurfaces(
        torch.cat([bodies.coefficients.detach()[:, used] for used, _ in parts], dim=1),
        torch.cat([faces + int(start) for (_, faces), start in zip(parts, starts)]),
        torch.cat([torch.full((len(faces),), k) for k, (_, faces) in enumerate(parts)]),
        bodies.basis,
        bodies.unit_length,
        bodies.matter,
        bodies.lines,
    )


def apart(new: MovingSurfaces, known: MovingSurfaces, times: np.ndarray) -> list[int]:
    """Numbers of `new` bodies that are bodies of their own beside `known` ones.

    Their centres lie `CENTRES` of the larger radius away from all of these, averaged over times; and they are either
    `PART` of the median volume of these, at least, or touch none: small pieces at the surface of a body correct its
    shape, which the next fit does better.
    """
    distances = np.zeros((new.count, known.count))
    for time in times:
        ours, theirs = (of.bodies(float(time)) for of in (new, known))
        centres, others = ([mesh.vertices.mean(0) for mesh in of] for of in (ours, theirs))
        radii, sizes = ([ball_radius(abs(mesh.volume)) for mesh in of] for of in (ours, theirs))
        distances += cdist(centres, others) / np.maximum.outer(radii, sizes) / len(times)
    middle = float(times[len(times) // 2])
    least = PART * np.median([abs(mesh.volume) for mesh in known.bodies(middle)])
    large = np.array([abs(mesh.volume) >= least for mesh in new.bodies(middle)])
    own = (distances.min(1) >= CENTRES) & (large | (gaps(new, known, times) > NEAR_PX))
    return [int(k) for k in np.flatnonzero(own)]


def sure_ones(bodies: MovingSurfaces, views: Views, times: np.ndarray) -> list[int]:
    """Numbers of the bodies of `SURE` of the median volume at least, and of those that the field cuts in the middle.

    Of the others few views have smeared a part, or made them up where streaks of several cross; one is left at least.
    """
    meshes = bodies.bodies(float(times[len(times) // 2]))
    cut = np.array([is_cut(mesh, views) for mesh in meshes])
    volumes = np.array([abs(mesh.volume) for mesh in meshes])
    middle = np.median(volumes if cut.all() else volumes[~cut])
    return [int(k) for k in np.flatnonzero(cut | (volumes >= SURE * middle))]


def gaps(of: MovingSurfaces, others: MovingSurfaces, times: np.ndarray) -> np.ndarray:
    """[N] how near the vertices of each body `of` come to those of `others`, in the median over times [pixels]."""
    found = np.zeros((len(times), of.count))
    for t, time in enumerate(times):
        tree = KDTree(np.concatenate([mesh.vertices for mesh in others.bodies(float(time))]))
        found[t] = [tree.query(mesh.vertices)[0].min() / of.unit_length for mesh in of.bodies(float(time))]
    return np.asarray(np.median(found, axis=0))


def whole_ones(bodies: MovingSurfaces, times: np.ndarray) -> list[int]:
    """Numbers of the bodies that are no pieces of others: of `PART` of the median volume at least, or touching none.

    What is left out is looked for again, beside the others.
    """
    if bodies.count == 1:
        return [0]
    middle = float(times[len(times) // 2])
    volumes = np.array([abs(mesh.volume) for mesh in bodies.bodies(middle)])
    small = np.flatnonzero(volumes < PART * np.median(volumes))
    large = np.setdiff1d(np.arange(bodies.count), small)
    touching = [] if not len(small) else gaps(only(bodies, small.tolist()), only(bodies, large.tolist()), times)
    pieces = {int(k) for k, gap in zip(small, touching) if gap <= NEAR_PX}
    return [k for k in range(bodies.count) if k not in pieces]


MOST, LEAST = 0.5, 0.1
"""Shares of a body that lie in others: in all of them together, and in each of two at least, of a merger."""
LOOKS = 4
"""Times that are looked at, about."""
VOXELS = 20_000
"""Of the grid on which a body and those in it are compared, at most."""


def without_merger(bodies: MovingSurfaces, times: np.ndarray) -> list[int]:
    """Numbers of the bodies without the one that lies in others most, if that is a merger: most of it is in two others
    or more.

    Few beams show two bodies that touch as one between them. Each is then found beside it, in the shadow that it
    leaves, and none of the three can become what it is as long as the merger takes the middle.
    """
    seen = times[:: max(1, len(times) // LOOKS)]
    shares = np.mean([shared(bodies, float(time)) for time in seen], axis=0)
    shares[shares < LEAST] = 0
    merged = np.where((shares > 0).sum(1) >= 2, shares.sum(1), 0.0)
    worst = int(merged.argmax())
    return [k for k in range(bodies.count) if k != worst or merged[k] < MOST]


def shared(bodies: MovingSurfaces, time: float) -> np.ndarray:
    """[B, B] the share of each body's volume that lies in each other one at `time` [s]."""
    meshes, found = bodies.bodies(time), np.zeros((bodies.count, bodies.count))
    low, high = (np.array([reach(mesh.vertices, axis=0) for mesh in meshes]) for reach in (np.min, np.max))
    meet = np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)
    for i in np.flatnonzero(meet.sum(1) > 1):
        grid = Grid.around(meshes[i].vertices / bodies.unit_length, bodies.unit_length, VOXELS)
        own = _occupied(bodies, int(i), time, grid)
        for j in (int(j) for j in np.flatnonzero(meet[i]) if j != i):
            found[i, j] = (own * _occupied(bodies, j, time, grid)).sum() / own.sum()
    return found


def _occupied(bodies: MovingSurfaces, number: int, time: float, grid: Grid) -> np.ndarray:
    return only(bodies, [number]).at(time).voxelise(grid).delta / bodies.matter.delta
