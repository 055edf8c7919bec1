"""`follow`: the frames of several times in, closed bodies on smooth paths out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from ..checks import InputError, require
from ..fit.running import Record
from ..fit.schedule import Schedule
from ..matter import DeltaBeta
from ..optics.background import Light
from ..progress import FitProgress
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Scan
from .elastic import Rest
from .fit import MotionFit, motion_fit
from .identities import LinkOptions
from .known import KnownBodies
from .pieces import PathOptions, chosen_paths
from .remainder import apart, beside, joined, only, sure_ones, whole_ones
from .rest_shape import KnownBody
from .sightings import Sighting, SightingOptions, sightings
from .start import first_paths


def _stiff() -> MotionFit:
    return MotionFit(rate=0.4, stiffness=100.0, schedule=Schedule(steps=60, views_per_step=16))


def _soft() -> MotionFit:
    return MotionFit(schedule=Schedule(steps=150, views_per_step=16))


@dataclass(frozen=True)
class TrackOptions:
    """How bodies are followed through time."""

    kind: ClassVar[str] = "track"

    body: KnownBody | None = None
    """What is known of the bodies' shape at rest, which makes two beams enough; None: nothing."""
    sightings: SightingOptions = field(default_factory=SightingOptions)
    """How bodies are found at single times."""
    links: LinkOptions = field(default_factory=LinkOptions)
    """Which of them are one body."""
    paths: PathOptions = field(default_factory=PathOptions)
    """How the vertices move."""
    rounds: int = 4
    """How often bodies are looked for beside those that are known, at most."""
    fainter: float = 0.6
    """Factor of the level there: few views smear a body, and beside what is known there is little to take it for."""
    stiff: MotionFit = field(default_factory=_stiff)
    """The first fit, in which bodies move and turn nearly as a whole."""
    soft: MotionFit = field(default_factory=_soft)
    """The second one, in which they deform."""

    def with_effort(self, effort: float) -> TrackOptions:
        """The same with `effort` times the steps, at least one."""
        parts = {name: getattr(self, name) for name in ("stiff", "soft")}
        changed = {
            name: replace(part, schedule=replace(part.schedule, steps=max(1, round(effort * part.schedule.steps))))
            for name, part in parts.items()
        }
        return replace(self, **changed)


USUAL = TrackOptions()
"""What `follow` does unless it is told."""


@dataclass(frozen=True)
class Followed:
    """What `follow` found. bodies: on their paths; records: of the steps of both fits; oversample: wave samples a pixel
    in these; timing: seconds of each stage; found: sightings at each time."""

    bodies: MovingSurfaces
    records: list[Record]
    oversample: int
    timing: dict[str, float]
    found: tuple[int, ...]


def follow(
    scan: Scan,
    material: DeltaBeta,
    options: TrackOptions = USUAL,
    seed: int = 0,
    *,
    light: Light | None = None,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Followed:
    """The bodies of `material` in the training frames of `scan`, of several times.

    light: of the training frames, which were divided by it, where it is uneven. Errors: `InputError` for a scan of one
    time, and where no body is seen.
    """
    train = scan.train()
    require_times(train)
    run = _Following(train, material, options, seed, light, on_progress)
    bodies = run.whole(run.fitted("stiff", run.first()))
    for _ in range(options.rounds):
        more = run.more(bodies)
        if more is None:
            break
        bodies = run.whole(run.fitted("stiff", more))
    bodies = run.fitted("soft", run.on_chosen_paths(bodies))
    found = tuple(len(one) for one in run.seen) or (bodies.count,) * len(train.instants)
    return Followed(bodies, run.records, run.oversample, run.timing, found)


@dataclass
class _Following:
    """What `follow` has done so far."""

    train: Scan
    material: DeltaBeta
    options: TrackOptions
    seed: int
    light: Light | None
    on_progress: FitProgress
    seen: list[list[Sighting]] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    timing: dict[str, float] = field(default_factory=dict)
    oversample: int = 1
    known: KnownBodies | None = None

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.timing[name] = self.timing.get(name, 0.0) + time.perf_counter() - began

    def look(self, frames: Scan, level: float = 1.0) -> list[list[Sighting]]:
        """The bodies that each time of `frames` shows by itself; the first look is kept.

        level: factor of the occupancy at the surface.
        """
        how = replace(self.options.sightings, level=level * self.options.sightings.level)
        times, found = frames.instants, list[list[Sighting]]()
        with self._timed("sightings"):
            for t in range(len(times)):
                self.on_progress("bodies at each time", t / len(times), {})
                found.append(sightings(frames.at_instant(t), self.material, how))
        self.seen = self.seen or found
        return found

    def first(self) -> MovingSurfaces:
        """Bodies on first paths; the doubtful ones are left to be found beside the others."""
        times, options = self.train.instants, self.options
        basis = TimeBasis(float(times[0]), float(times[-1]), options.paths.degree)
        if options.body is not None:
            return self._posed(options.body, basis)
        self.look(self.train)
        found = first_paths(self.seen, times, basis, self.train.views.finest, self.material, options.links)
        sure = sure_ones(found, self.train.views, times)
        return found if options.rounds == 0 or len(sure) == found.count else only(found, sure)

    @property
    def rest(self) -> Rest | None:
        """What is known of the bodies' shape."""
        return None if self.known is None else self.known.rest

    def _posed(self, body: KnownBody, basis: TimeBasis) -> MovingSurfaces:
        """Bodies of known shape on first paths."""
        self.on_progress("poses", 0.0, {})
        with self._timed("poses"):
            self.known = KnownBodies(self.train, self.material, body)
            found = self.known.bodies(basis)
        if found is None:
            raise InputError(
                f"no body of the shape {body.shape} was found in the frames; check its size, the material and the "
                "pixel size, or leave --body."
            )
        return found

    def more(self, bodies: MovingSurfaces) -> MovingSurfaces | None:
        """`bodies`, and those that frames show beside them; None where there are none."""
        times = self.train.instants
        if self.known is not None:
            with self._timed("poses"):
                new = self.known.bodies(bodies.basis, bodies)
            own = [] if new is None else apart(new, bodies, times)
            return joined(bodies, only(new, own)) if new is not None and own else None
        found = self.look(beside(self.train, bodies, self.oversample), self.options.fainter)
        try:
            new = first_paths(found, times, bodies.basis, bodies.unit_length, self.material, self.options.links)
        except InputError:  # no track
            return None
        apart_ones = apart(new, bodies, times)
        return joined(bodies, only(new, apart_ones)) if apart_ones else None

    def whole(self, bodies: MovingSurfaces) -> MovingSurfaces:
        """`bodies` without pieces of others."""
        kept = whole_ones(bodies, self.train.instants)
        return bodies if len(kept) == bodies.count else only(bodies, kept)

    def on_chosen_paths(self, bodies: MovingSurfaces) -> MovingSurfaces:
        """`bodies` on paths of as many pieces as frames ask for."""
        self.on_progress("paths", 0.0, {})
        with self._timed("paths"):
            return chosen_paths(
                self.train, bodies, self.options.paths, self.options.stiff, self.seed, self.light, self.rest
            )

    def fitted(self, name: Literal["stiff", "soft"], start: MovingSurfaces) -> MovingSurfaces:
        """`start` after the fit of that name."""
        fit = motion_fit(self.train, start, getattr(self.options, name), self.seed, self.light, self.rest)
        before = len(self.records)

        def keep(record: Record) -> None:
            self.records.append(record | {"step": before + record["step"]})
            self.on_progress(f"{name} fit", fit.share, record)

        with self._timed(f"{name} fit"):
            fit.run(keep)
        found, self.oversample = fit.result().object, fit.oversample
        assert isinstance(found, MovingSurfaces)
        return found.with_parameters({"coefficients": found.coefficients.detach()})


def require_times(scan: Scan) -> None:
    """`InputError` unless the training frames are of two times or more."""
    count = len(scan.instants)
    require(
        count >= 2,
        f"bodies are followed through frames of two times or more, but the training frames are of {count}; "
        "use reconstruct.",
    )
