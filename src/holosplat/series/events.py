"""What happens between times: bodies and holes merge, split, appear and vanish, with tracks as a tree."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import ndimage

from ..bodies.rest_shape import LEAST_VOLUME, LEVEL
from ..checks import as_written, require
from ..geometry import Grid
from ..io.atomic import atomic_path
from ..representations import Stored

PARTS = "parts.npz"
"""The connected parts of a time, in its run folder."""
MOST_VOXELS = 160
"""Voxels along the longest edge of their volume, at most: larger fields have larger voxels."""
Of = Literal["body", "hole"]
WHAT: dict[Of, str] = {"body": "bodies", "hole": "holes"}
EVENT_COLUMNS = ("first", "last", "first_s", "last_s", "event", "of", "before", "after", "x_m", "y_m", "z_m")
TRACK_COLUMNS = ("track", "of", "first", "last", "first_s", "last_s", "parents", "first_volume_m3", "last_volume_m3")


@dataclass(frozen=True)
class Parts:
    """What hangs together at one time. bodies, holes: [Z, Y, X] numbers from 1 on, 0 elsewhere; grid: of both"""

    bodies: np.ndarray
    holes: np.ndarray
    grid: Grid

    @classmethod
    def of(cls, found: Stored, grid: Grid) -> Parts:
        """Bodies are what is above half of the matter's δ; holes what is not, and has matter all around it.

        Parts of fewer than `LEAST_VOLUME` voxels are left out, and filled or emptied.
        """
        factor = -(-max(grid.shape) // MOST_VOXELS)
        z, y, x = (-(-n // factor) for n in grid.shape)
        coarse = Grid.centred((z, y, x), factor * grid.voxel_size[0], tuple(grid.centre))
        full = found.voxelise(coarse).delta / found.matter.delta > LEVEL
        around = _large(~full)
        inside = np.ones(int(around.max(initial=0)) + 1, dtype=bool)
        for axis in range(3):
            inside[np.take(around, (0, -1), axis)] = False
        return cls(_large(full | (around == 0)), _renumbered(around, inside), coarse)

    def write(self, path: Path) -> None:
        """Write them, whole or not at all."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            place = np.array([*self.grid.voxel_size, *self.grid.origin])
            np.savez_compressed(file, bodies=self.bodies, holes=self.holes, place=place)

    @classmethod
    def read(cls, path: Path) -> Parts:
        """What `write` wrote. Errors: `InputError` for anything else."""
        with as_written(path, "the parts of a time of a series"):
            try:
                with np.load(path, allow_pickle=False) as file:
                    bodies, holes, place = (file[name] for name in ("bodies", "holes", "place"))
            except (zipfile.BadZipFile, KeyError) as error:
                raise ValueError(str(error)) from None
            require(bodies.shape == holes.shape, "its arrays differ in shape.")
            size, origin = place.tolist()[:3], place.tolist()[3:]
            return cls(
                bodies, holes, Grid(bodies.shape, (size[0], size[1], size[2]), (origin[0], origin[1], origin[2]))
            )

    def labels(self, of: Of) -> np.ndarray:
        """Those of bodies, or of holes."""
        return self.bodies if of == "body" else self.holes


@dataclass
class PartTrack:
    """A part from one event to the next. first, last: positions in the series; parents: numbers of the tracks that it
    came from; volumes: [m³] at each time"""

    number: int
    of: Of
    first: int
    last: int
    parents: tuple[int, ...]
    volumes: list[float]


@dataclass(frozen=True)
class Event:
    """What happened between two times that follow each other. before, after: numbers of tracks; place: `(x, y, z)` m"""

    first: int
    last: int
    kind: Literal["merger", "split", "appearance", "disappearance", "collapse", "rearrangement"]
    of: Of
    before: tuple[int, ...]
    after: tuple[int, ...]
    place: tuple[float, ...]


@dataclass(frozen=True)
class History:
    """All tracks, and all events in the order of time."""

    tracks: tuple[PartTrack, ...]
    events: tuple[Event, ...]

    @classmethod
    def of(cls, parts: Sequence[Parts]) -> History:
        """Of the parts at times that follow each other.

        A part goes on in the one with which it shares most voxels, and comes from the one with which it shares most;
        where they share none, in the nearest one within its radius. Parts that hang together so are one event, unless
        they are one and one.
        """
        tracks, events = list[PartTrack](), list[Event]()
        for of in ("body", "hole"):
            _follow(of, parts, tracks, events)
        return cls(tuple(tracks), tuple(sorted(events, key=lambda event: event.first)))

    def lines(self, times: Sequence[float]) -> list[str]:
        """One line for each event; times: [T] s."""
        return [
            f"{event.kind} between {times[event.first]:.6g} and {times[event.last]:.6g} s: "
            f"{WHAT[event.of]} {_numbers(event.before)} → {_numbers(event.after)}"
            for event in self.events
        ]

    def event_rows(self, numbers: Sequence[int], times: Sequence[float]) -> Iterable[list[object]]:
        """Rows of `EVENT_COLUMNS`; numbers: of the times in the series."""
        for event in self.events:
            ends = (event.first, event.last)
            when = [*(numbers[k] for k in ends), *(f"{times[k]:.9g}" for k in ends)]
            parts = (" ".join(map(str, names)) for names in (event.before, event.after))
            yield [*when, event.kind, event.of, *parts, *(f"{value:.6g}" for value in event.place)]

    def track_rows(self, numbers: Sequence[int], times: Sequence[float]) -> Iterable[list[object]]:
        """Rows of `TRACK_COLUMNS`."""
        for one in self.tracks:
            when = [*(numbers[k] for k in (one.first, one.last)), *(f"{times[k]:.9g}" for k in (one.first, one.last))]
            ends = (f"{one.volumes[k]:.6g}" for k in (0, -1))
            yield [one.number, one.of, *when, " ".join(map(str, one.parents)), *ends]


def _numbers(names: Sequence[int]) -> str:
    return " and ".join(map(str, names)) or "none"


def _large(mask: np.ndarray) -> np.ndarray:
    """Numbers of the connected parts of at least `LEAST_VOLUME` voxels."""
    found = np.empty(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=found)  # pyright: ignore[reportArgumentType] (as in `bodies.rest_shape`)
    return _renumbered(found, np.bincount(found.ravel()) >= LEAST_VOLUME)


def _renumbered(labels: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Numbers, uint16, from 1 on without gaps, of those labels above 0 that are `kept` [labels]; 0 of others."""
    kept = kept & (np.arange(len(kept)) > 0)
    return (np.cumsum(kept) * kept).astype(np.uint16)[labels]


def _measures(labels: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Centres [K, 3] `(x, y, z)` m and volumes [K] m³."""
    every = np.arange(1, int(labels.max(initial=0)) + 1)
    if not len(every):
        return np.zeros((0, 3)), np.zeros(0)
    places = np.array(ndimage.center_of_mass(labels > 0, labels, every))[:, ::-1]
    volumes = np.bincount(labels.ravel(), minlength=len(every) + 1)[1:] * np.prod(grid.voxel_size)
    return np.array(grid.origin) + places * np.array(grid.voxel_size), volumes


def _edges(before: np.ndarray, now: np.ndarray, measured: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """[K, L] bool: which parts before are which now."""
    k, n = (len(volumes) for _, volumes in measured)
    shared = np.bincount(before.ravel().astype(np.int64) * (n + 1) + now.ravel(), minlength=(k + 1) * (n + 1))
    shared = shared.reshape(k + 1, n + 1)[1:, 1:].astype(float)
    if not k or not n:
        return shared > 0
    (old, size), (new, _) = measured
    apart = np.linalg.norm(old[:, None] - new[None], axis=-1)
    near = apart <= np.cbrt(0.75 / np.pi * size)[:, None]
    lone = np.logical_and.outer(shared.sum(axis=1) == 0, shared.sum(axis=0) == 0) & near
    shared = np.where(lone, 1 / (1 + apart / apart.max(initial=1e-30)), shared)
    best = (shared == shared.max(axis=1, keepdims=True)) | (shared == shared.max(axis=0, keepdims=True))
    return best & (shared > 0)


def _follow(of: Of, parts: Sequence[Parts], tracks: list[PartTrack], events: list[Event]) -> None:
    """Add the tracks and events of bodies, or of holes."""
    last, names = None, list[int]()
    for time, one in enumerate(parts):
        labels = one.labels(of)
        measured = _measures(labels, one.grid)
        given: dict[int, int] = {}
        if last is not None:
            for old, new in _groups(_edges(last[0], labels, (last[1], measured))):
                before, after = tuple(names[i] for i in old), new
                if len(old) == len(new) == 1:
                    given[new[0]] = before[0]
                    continue
                for j in after:
                    given[j] = len(tracks)
                    tracks.append(PartTrack(len(tracks), of, time, time, before, []))
                centres = measured[0][list(new)] if new else last[1][0][list(old)]
                place = tuple(float(value) for value in centres.mean(axis=0))
                told = tuple(given[j] for j in after)
                events.append(Event(time - 1, time, _kind(of, len(old), len(new)), of, before, told, place))
        else:
            for j in range(len(measured[1])):
                given[j] = len(tracks)
                tracks.append(PartTrack(len(tracks), of, time, time, (), []))
        names = [given[j] for j in range(len(measured[1]))]
        for name, volume in zip(names, measured[1]):
            tracks[name].last = time
            tracks[name].volumes.append(float(volume))
        last = labels, measured


def _kind(
    of: Of, old: int, new: int
) -> Literal["merger", "split", "appearance", "disappearance", "collapse", "rearrangement"]:
    if not old:
        return "appearance"
    if not new:
        return "collapse" if of == "hole" else "disappearance"
    return "merger" if new == 1 else "split" if old == 1 else "rearrangement"


def _groups(edges: np.ndarray) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Which parts before and now hang together, by edges [K, L]."""
    from scipy.sparse import block_array, csr_array
    from scipy.sparse.csgraph import connected_components

    k, n = edges.shape
    if not k + n:
        return []
    both = block_array([[csr_array((k, k)), csr_array(edges.astype(float))], [None, csr_array((n, n))]])
    count, group = connected_components(both, directed=False)
    return [
        (tuple(np.flatnonzero(group[:k] == g).tolist()), tuple(np.flatnonzero(group[k:] == g).tolist()))
        for g in range(count)
    ]
