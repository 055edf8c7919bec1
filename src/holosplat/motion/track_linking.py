"""Links of detections into tracks, bodies on first paths along them, and the options of `track`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..bodies.rest_shape import KnownBody
from ..checks import require
from ..fit.problem import Schedule
from ..inference import Score, select
from ..learning.start import LearnedStart
from ..matter import DeltaBeta, Matter
from ..mesh import ball_radius
from ..ranges import Natural, Share, Within, ranged
from ..representations import MovingSurfaces, TimeBasis
from .detections import Detection, SightingOptions
from .fit import SHORT, MotionFit, PathOptions

FAR = 1e9
"""Cost of a pair that cannot be."""
SAME, TOUCHING, OTHER = 0.7, 1.2, 0.75
"""Radii within which centres are of one body; radii within which a body is part of a larger one (half the distance of
two flat ones side by side); and the share of the volume above which it is no part."""


@dataclass(frozen=True)
class Seen:
    """A sighting in numbers. time: its index; centre: `(x, y, z)` [m]; volume [m³]; cut: by the edge of the field."""

    time: int
    centre: np.ndarray
    volume: float
    cut: bool

    @property
    def reach(self) -> float:
        """Radius [m] of a ball of its volume."""
        return ball_radius(self.volume)


@dataclass(frozen=True)
@ranged
class LinkOptions:
    """Options for linking detections into tracks."""

    gate: float = 0.8
    """A body is looked for within so many radii of where its velocity leads."""
    change: Annotated[float, Within(0.01, 0.99)] = 0.3
    """By which part a body that is seen whole may change its volume: less than a merger with half a body does."""
    gap: int = 6
    """Times that a track may miss."""
    least: Natural = 2
    """Sightings that make a track, unless it is near the field's edge, where bodies enter and leave."""


Track = tuple[int, ...]
"""Numbers of the sightings of one body, in the order of time."""


def identified(seen: Sequence[Seen], times: np.ndarray, options: LinkOptions = LinkOptions()) -> list[Track]:
    """The tracks of all bodies among the sightings `seen` at `times` [T] s, the longest first."""
    tracks = _join_gaps(_chains(seen, times, options), seen, times, options)
    tracks = sorted(tracks, key=lambda track: (-len(track), track))
    return [track for track in _drop_duplicates(tracks, seen, times) if _is_accepted(track, seen, options)]


def velocity(track: Track, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray, late: bool) -> np.ndarray:
    """[3] m/s at the end of a track (late) or its start, by the two sightings there; of a single one it is the `flow`.

    What the field cuts says nothing of velocity.
    """
    whole = [k for k in track if not seen[k].cut]
    if len(whole) < 2:
        return flow
    first, second = (whole[-2], whole[-1]) if late else (whole[0], whole[1])
    return (seen[second].centre - seen[first].centre) / (times[seen[second].time] - times[seen[first].time])


def drift(tracks: Sequence[Track], seen: Sequence[Seen], times: np.ndarray) -> np.ndarray:
    """Median velocity [3] [m/s] of the tracks; zero without any of two sightings."""
    still = np.full(3, np.nan)
    found = np.array([velocity(track, seen, times, still, True) for track in tracks] or [still])
    found = found[np.isfinite(found).all(1)]
    return np.median(found, axis=0) if len(found) else np.zeros(3)


def _alike(one: Seen, other: Seen, options: LinkOptions) -> bool:
    """Whether volumes may be of one body: those that are cut can have any."""
    if one.cut or other.cut:
        return True
    low, high = sorted((one.volume, other.volume))
    return low >= (1 - options.change) * high


def _chains(seen: Sequence[Seen], times: np.ndarray, options: LinkOptions) -> list[Track]:
    """Links from each time to the next, twice: the first round finds the flow that single sightings go with."""
    flow, found = np.zeros(3), list[Track]()
    for _ in range(2):
        found = []
        open_ones: list[Track] = []
        for t in range(len(times)):
            new = [k for k, one in enumerate(seen) if one.time == t]
            pairs = _match(open_ones, new, seen, times, flow, options)
            linked = {new[j]: open_ones[i] for i, j in pairs}
            found += [track for i, track in enumerate(open_ones) if i not in {i for i, _ in pairs}]
            open_ones = [(*linked.get(k, ()), k) for k in new]
        found += open_ones
        flow = drift(found, seen, times)
    return found


def _match(
    tracks: Sequence[Track],
    new: Sequence[int],
    seen: Sequence[Seen],
    times: np.ndarray,
    flow: np.ndarray,
    options: LinkOptions,
) -> list[tuple[int, int]]:
    """Pairs (track, new sighting) whose distances from where velocities lead are least in sum, within the gate."""
    cost = np.full((len(tracks), len(new)), FAR)
    for i, track in enumerate(tracks):
        last = seen[track[-1]]
        speed = velocity(track, seen, times, flow, True)
        for j, k in enumerate(new):
            one = seen[k]
            away = np.linalg.norm(last.centre + speed * (times[one.time] - times[last.time]) - one.centre)
            if away <= options.gate * max(last.reach, one.reach) and _alike(last, one, options):
                cost[i, j] = away
    return _assign(cost)


def _assign(cost: np.ndarray) -> list[tuple[int, int]]:
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns) if cost[i, j] < FAR]


def _join_gaps(tracks: list[Track], seen: Sequence[Seen], times: np.ndarray, options: LinkOptions) -> list[Track]:
    """Tracks joined over gaps of at most `gap` times, where the one's velocity leads to the other and back."""
    flow = drift(tracks, seen, times)
    while True:
        cost = np.full((len(tracks), len(tracks)), FAR)
        for i, before in enumerate(tracks):
            for j, after in enumerate(tracks):
                cost[i, j] = _gap_cost(before, after, seen, times, flow, options)
        pairs = _assign(cost)
        if not pairs:
            return tracks
        i, j = min(pairs, key=lambda pair: cost[pair])
        joined = (*tracks[i], *tracks[j])
        tracks = [track for k, track in enumerate(tracks) if k not in (i, j)] + [joined]


def _gap_cost(
    before: Track, after: Track, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray, options: LinkOptions
) -> float:
    last, first = seen[before[-1]], seen[after[0]]
    missed = first.time - last.time - 1
    if before is after or not 0 <= missed <= options.gap or not _alike(last, first, options):
        return FAR
    pause = times[first.time] - times[last.time]
    forth = last.centre + pause * velocity(before, seen, times, flow, True) - first.centre
    back = first.centre - pause * velocity(after, seen, times, flow, False) - last.centre
    away = 0.5 * float(np.linalg.norm(forth - back))
    return away if away <= options.gate * max(last.reach, first.reach) else FAR


def _drop_duplicates(tracks: Sequence[Track], seen: Sequence[Seen], times: np.ndarray) -> list[Track]:
    """Tracks without those that are where longer ones already are: mergers and fragments of these."""
    kept, flow = list[Track](), drift(tracks, seen, times)
    for track in tracks:
        inside = [any(_holds(other, k, seen, times, flow) for other in kept) for k in track]
        if np.mean(inside) < 0.5:
            kept.append(track)
    return kept


def _holds(track: Track, number: int, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray) -> bool:
    """Whether a sighting is the body of `track`, a merger with it, or a piece of it."""
    one, own = seen[number], max((seen[k] for k in track), key=lambda other: (not other.cut, other.volume))
    low, high = sorted((one.volume, own.volume))
    near = SAME if low > OTHER * high else TOUCHING
    away = np.linalg.norm(place_at(track, one.time, seen, times, flow) - one.centre)
    return bool(away < near * max(one.reach, own.reach))


def place_at(track: Track, time: int, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Place [3] [m] of a track at a time: between its detections on straight lines, beyond by its last velocity."""
    own = [seen[k] for k in track]
    if time > own[-1].time:
        return own[-1].centre + velocity(track, seen, times, flow, True) * (times[time] - times[own[-1].time])
    if time < own[0].time:
        return own[0].centre - velocity(track, seen, times, flow, False) * (times[own[0].time] - times[time])
    when = times[[one.time for one in own]]
    return np.array([np.interp(times[time], when, [one.centre[axis] for one in own]) for axis in range(3)])


def _is_accepted(track: Track, seen: Sequence[Seen], options: LinkOptions) -> bool:
    return len(track) >= options.least or any(seen[k].cut for k in track)


USUAL = LinkOptions()
"""The usual options of linking detections."""


def first_paths(
    found: Sequence[Sequence[Detection]],
    times: np.ndarray,
    basis: TimeBasis,
    pixel: float,
    material: DeltaBeta,
    options: LinkOptions = USUAL,
) -> MovingSurfaces:
    """Bodies on first paths, from the sightings at each of `times` [T] s, those with the most sightings first.

    A body has the surface of its best time, and is moved without turning; pixel: [m], the unit of lengths. Errors:
    `InputError` if there is no body at all.
    """
    flat = [(t, one) for t, bodies in enumerate(found) for one in bodies]
    seen = [Seen(t, one.centre, one.volume, one.cut) for t, one in flat]
    tracks = identified(seen, times, options)
    require(
        len(tracks) > 0,
        "no body was found that can be followed from one time to the next; check the material, or look at single times "
        "with reconstruct --time-frame.",
    )
    flow = drift(tracks, seen, times)
    paths, faces = [], []
    for track in tracks:
        best = best_sighting(track, seen)
        mesh = flat[best][1].mesh
        middle = _middle(track, best, seen, times, flow, basis)
        paths.append(mesh.vertices[None] - seen[best].centre + middle[:, None])
        faces.append(mesh.faces)
    return MovingSurfaces.of_bodies(paths, faces, basis, pixel, Matter.one(*material))


def best_sighting(track: Track, seen: Sequence[Seen]) -> int:
    """The best detection of a track: of the whole ones that of median volume; else the largest."""
    whole = [k for k in track if not seen[k].cut]
    if not whole:
        return max(track, key=lambda k: seen[k].volume)
    middle = float(np.median([seen[k].volume for k in whole]))
    return min(whole, key=lambda k: (abs(seen[k].volume - middle), k))


def _middle(
    track: Track, best: int, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray, basis: TimeBasis
) -> np.ndarray:
    """Coefficients [K, 3] [m] of the path of the middle: with the velocity of the flow, the null, or a polynomial of
    degree one or two, whichever predicts detections that it was not fitted to (`inference.select`).

    Beside the flow, it passes the middle of the best detection, whose surface it carries.
    """
    whole = [k for k in track if not seen[k].cut]
    when, centres = times[[seen[k].time for k in whole]], np.reshape([seen[k].centre for k in whole], (-1, 3))
    dense, velocity = np.linspace(basis.first, basis.last, 4 * basis.count), flow * (basis.degree > 0)

    scale = (basis.last - basis.first) or 1.0
    away = centres - (when - basis.first)[:, None] * velocity
    chosen = path_degree((when - basis.first) / scale, away, min(2, basis.degree))
    if chosen > 0:
        powers = np.polynomial.polynomial.polyfit((when - basis.first) / scale, away, chosen)
        path = np.polynomial.polynomial.polyval((dense - basis.first) / scale, powers).T
        return basis.fitted(dense, path + (dense - basis.first)[:, None] * velocity)
    return basis.fitted(dense, seen[best].centre + (dense - times[seen[best].time])[:, None] * velocity)


def path_degree(when: np.ndarray, centres: np.ndarray, most: int, errors: np.ndarray | None = None) -> int:
    """The degree, up to `most`, of the polynomial through `centres` [N, K] at times `when` [N], of order one, that
    predicts those left out; the least is the null, and 0 stands for too few.

    errors: [N] standard errors of the centres (None: all are alike)
    """
    weights = np.ones(len(when)) if errors is None else 1 / errors

    def left_out(name: str, fold: int) -> Score:
        missed = []
        for k in range(len(when)):
            kept = np.arange(len(when)) != k
            powers = np.polynomial.polynomial.polyfit(when[kept], centres[kept], int(name), w=weights[kept])
            missed.append(weights[k] * (centres[k] - np.polynomial.polynomial.polyval(when[k], powers)))
        return Score(np.square(missed).sum(axis=1)[:, None])

    degrees = [str(n) for n in range(most + 1) if len(when) > n + 1]
    return int(select("degree of a path", degrees, left_out, by="detections left out").choice) if degrees else 0


@dataclass(frozen=True)
@ranged
class TrackOptions:
    """How bodies are followed through time."""

    kind: ClassVar[str] = "track"

    body: KnownBody | None = None
    """The known shape of bodies at rest, with which two beams are enough; None: unknown."""
    sightings: SightingOptions = field(default_factory=SightingOptions)
    """How bodies are found at single times."""
    learned: LearnedStart | None = field(default_factory=LearnedStart)
    """The network that may guess their volumes, where frames do not contradict it and its bodies explain clearly more;
    None: none."""
    cells: bool = True
    """Whether, in two beams, bodies that a network of red cells guesses are followed as red cells, too, by their shape
    at rest; these are kept unless bodies of any shape leave clearly less of the frames."""
    links: LinkOptions = field(default_factory=LinkOptions)
    """Which of them are one body."""
    paths: PathOptions = field(default_factory=PathOptions)
    """How the vertices move."""
    rounds: int = 4
    """How often bodies are looked for beside those that are known, at most."""
    fainter: Share = 0.6
    """Factor of the level there: few views smear a body, and beside what is known there is little to take it for."""
    stiff: MotionFit = field(
        default_factory=lambda: MotionFit(rate=0.4, stiffness=100.0, schedule=Schedule(steps=20, views_per_step=16))
    )
    """The first fit, in which bodies move and turn nearly as a whole."""
    soft: MotionFit = field(default_factory=MotionFit)
    """The second one, in which they deform."""

    twins: bool = True
    """Whether to compare bodies of known shape with others that have the same shadows in two beams."""
    intervals: bool = True
    """Whether halves of the frames are fitted, too, for standard errors: up to four short fits."""
    half: MotionFit = SHORT
    """The fit to a half, from the result: errors are hundredths of a pixel. Halves that are fitted to the end agree on
    what both have from a known shape (two beams at 24°: volumes off by five standard errors). Where few beams see
    bodies of unknown shape, halves begin apart and are fitted as all frames are, softly: short fits leave them so
    (three beams: a tenth of the error that they say)."""

    def with_effort(self, effort: float) -> TrackOptions:
        """The same with `effort` times the steps, at least one."""
        parts = {name: getattr(self, name) for name in ("stiff", "soft", "half")}
        changed = {name: replace(part, schedule=part.schedule.with_effort(effort)) for name, part in parts.items()}
        return replace(self, **changed)
