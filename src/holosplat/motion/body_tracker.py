"""Closed bodies followed through the frames of several times, stage by stage."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from ..bodies.rest_shape import KnownBody, extent_like
from ..checks import InputError, require
from ..fit.run import Record, Run
from ..inference import Decision
from ..learning.network import Guess
from ..matter import DeltaBeta
from ..mesh import TriangleMesh
from ..optics.background import Light
from ..progress import FitProgress
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Scan
from .detections import (
    Detection,
    SightingOptions,
    apart,
    beside,
    joined,
    network_for,
    only,
    sightings,
    sure_ones,
    whole_ones,
    without_merger,
)
from .elastic import Rest
from .expected import Expected
from .fit import MotionFit, chosen_paths, motion_fit
from .known import KnownBodies, Trials, at_rest, chosen_twins
from .measures import astray, halves_of, tell_shapes
from .track_linking import TrackOptions, first_paths

STAGES = ("sightings", "first paths", "stiff", "beside", "paths", "soft", "twins", "soft again", "halves", "done")
"""In about their order: stiff fits and looks beside their bodies take turns."""
AFTER_SOFT = {"soft": "twins", "soft again": "halves"}
"""The stages of soft fits, and what comes after each."""


@dataclass(frozen=True)
class Followed:
    """The tracked bodies. bodies: on their paths; records: of the steps of all fits; oversample: wave samples a pixel
    in these; timing: seconds of each stage; found: how many bodies each time shows by itself; halves: the bodies by
    halves of the frames, two and two, empty without intervals; rest: their shape at rest [m], if that is known; begun:
    the detection method at single times, in words; body: their known shape, given or found; decisions: on detections,
    pieces of paths, twins, and the kind of bodies; moved: how far frames moved surfaces from a forecast, in the
    standard errors of that, NaN without one."""

    bodies: MovingSurfaces
    records: list[Record]
    oversample: int
    timing: dict[str, float]
    found: tuple[int, ...]
    halves: tuple[MovingSurfaces, ...] = ()
    rest: TriangleMesh | None = None
    begun: str = ""
    body: KnownBody | None = None
    decisions: tuple[Decision, ...] = ()
    moved: float = math.nan


@dataclass
class BodyTracker:
    """Tracking stage by stage: sightings, then stiff fits and looks beside their bodies in turn,
    then paths, the soft fit, and fits to halves of the frames."""

    train: Scan
    material: DeltaBeta
    options: TrackOptions
    seed: int
    light: Light | None
    run: Run
    on_progress: FitProgress
    expected: Expected | None = None
    """Where a forecast has the first bodies, which stay."""
    stage: str = "sightings"
    round: int = 0
    bodies: MovingSurfaces | None = None
    seen: list[list[Detection]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    halves: list[MovingSurfaces] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    oversample: int = 1
    size: float = 1.0
    """Of all bodies of known rest shape, beside what was said."""
    guess: str = ""
    """Whether a network guesses the volumes of single times, and why."""
    cells: float = 0.0
    """Largest extent [m] of red cells of the volume of those that a network of such guesses; 0 where none does."""
    _search: KnownBodies | None = None

    def __post_init__(self) -> None:
        self.run.state = self._state
        if saved := self.run.saved:
            with self.run.as_written():
                self._take_up(saved)

    def _take_up(self, saved: Mapping[str, Any]) -> None:
        """Go on where an earlier run ended."""
        self.stage, self.round, self.oversample = str(saved["next"]), int(saved["round"]), int(saved["oversample"])
        require(self.stage in STAGES, f"next must be one of {', '.join(STAGES)}, but it is {self.stage}.")
        self.bodies = None if saved["bodies"] is None else MovingSurfaces.from_state(saved["bodies"])
        self.seen = [[Detection.from_state(one) for one in bodies] for bodies in saved["seen"]]
        self.counts, self.records = list(saved["counts"]), list(saved["records"])
        self.halves = [MovingSurfaces.from_state(one) for one in saved["halves"]]
        self.size, self.guess, self.cells = float(saved["size"]), str(saved["guess"]), float(saved["cells"])
        self.decisions = [Decision.from_dict(one) for one in saved.get("decisions", ())]

    def _state(self) -> dict[str, Any]:
        """What `_take_up` reads; a fit that runs starts at `bodies`."""
        named = ("round", "oversample", "counts", "size", "guess", "cells", "records")
        return {
            "next": self.stage,
            "bodies": None if self.bodies is None else self.bodies.state(),
            "seen": [[one.state() for one in bodies] for bodies in self.seen],
            "decisions": [one.as_dict() for one in self.decisions],
            "halves": [one.state() for one in self.halves],
            **{name: getattr(self, name) for name in named},
        }

    def until(self, stage: str) -> None:
        """Go on to the end of all that comes before `stage`, or to where an earlier run came."""
        while self.stage not in (stage, "done") and STAGES.index(self.stage) < STAGES.index(stage):
            self.advance()

    def followed(self, said: str = "") -> Followed:
        """The tracked bodies; said: a sentence on their kind."""
        assert self.bodies is not None
        told = self.records, self.oversample, self.run.timing, tuple(self.counts), tuple(self.halves)
        moved = math.nan if self.expected is None else self.expected.deviation(self.bodies)
        if self.expected is not None:
            said += f"; frames moved surfaces by {moved:.2g} standard errors of the forecast (rms)"
        guess, made = self.guess + said, tuple(self.decisions)
        return Followed(self.bodies, *told, self.shape_at_rest(), guess, self.options.body, made, moved)

    def advance(self) -> None:
        """Do the stage that is next."""
        if self.expected is not None and self.stage in STAGES[:2]:
            start = self.expected.on(self.basis)
            self.bodies = self.fitted("correction", self.train, start, self.options.soft, self.light)
            self.counts = [start.count] * len(self.train.instants)
            self.guess, self.stage = "a forecast", "beside" if self.options.rounds else "paths"
        elif self.stage == "sightings":
            network = self.network()
            self.seen = [] if self.options.body and not network else self.look(self.train, network=network)
            self.counts, self.stage = [len(one) for one in self.seen], "first paths"
            if network is not None and self.options.learned and self.options.learned.network.card.of_red_cells:
                whole = [one.mesh for at in self.seen for one in at if not one.cut]
                self.cells = extent_like(whole) if whole else 0.0
        elif self.stage == "first paths":
            self.bodies, self.seen, self.stage = self.first(), [], "stiff"
            if self.options.body is not None:
                self.counts = [self.bodies.count] * len(self.train.instants)
        elif self.bodies is not None:
            self._go_on(self.bodies)
        self.run.end_stage()

    def _go_on(self, bodies: MovingSurfaces) -> None:
        """The stages after the first paths."""
        if self.stage == "stiff":
            whole = self.whole(self.fitted("stiff fit", self.train, bodies, self.options.stiff, self.light))
            self.bodies = self.kept(whole, without_merger(whole, self.train.instants))
            after = "beside" if self.round < self.options.rounds else "paths"
            self.stage = after if self.bodies is whole else "stiff"
        elif self.stage == "beside":
            more = self.more(bodies)
            self.round += 1
            self.bodies, self.stage = (bodies, "paths") if more is None else (more, "stiff")
        elif self.stage == "paths":
            self.bodies, self.stage = self.on_chosen_paths(bodies), "soft"
        elif self.stage == "twins":
            self.bodies = self.told_from_twins(bodies)
            self.stage = "halves" if self.bodies is bodies else "soft again"
        elif self.stage in AFTER_SOFT:
            self.bodies = self.fitted("soft fit", self.train, bodies, self.options.soft, self.light)
            self.stage = AFTER_SOFT[self.stage]
        else:
            self._half(bodies)

    def _half(self, bodies: MovingSurfaces) -> None:
        """The next half of the frames, if there is one."""
        parts = (
            [half for pair in halves_of(self.train, bodies.basis) for half in pair] if self.options.intervals else []
        )
        if len(self.halves) < len(parts):
            part = parts[len(self.halves)]
            light = self.light and self.light.part(torch.from_numpy(part))
            side = 1 - 2 * (len(self.halves) % 2)
            told = tell_shapes(self.train)
            expected = None
            if self.expected is not None:
                expected, bodies = self.expected.astray(bodies, self.seed, side)
            elif not told:
                bodies = astray(bodies, self.seed, side)
            how = self.options.half if told or self.options.body else self.options.soft
            self.halves.append(self.fitted("intervals", self.train[part], bodies, how, light, expected))
        if len(self.halves) == len(parts):
            self.stage = "done"

    def network(self) -> Guess | None:
        """The network that guesses the volumes of single times, tested at the middle time."""
        if self.options.learned is None:
            return None
        at = self.train.at_instant(len(self.train.instants) // 2)
        how = (self.options.sightings, self.options.learned)
        with self.run.timed("sightings"):
            found, decision = network_for(at, self.material, *how, lambda stage, part: None)
        self.guess = decision.line
        self.decisions.append(decision)
        return found

    def look(
        self, frames: Scan, level: float = 1.0, network: Guess | None = None, lacking: bool = False
    ) -> list[list[Detection]]:
        """The bodies that each time of `frames` shows by itself.

        level: factor of the occupancy at the surface; network: what guesses the volumes; lacking: whether `frames` are
        over those of known bodies.
        """
        how = self.options.sightings
        how = replace(how, level=level * how.level, volume=replace(how.volume, lacking=lacking))
        times, found = frames.instants, list[list[Detection]]()
        with self.run.timed("sightings"):
            for t in range(len(times)):
                self.on_progress("bodies at each time", t / len(times), {})
                at = self.run.step("sightings", lambda t=t: self._look_at(frames.at_instant(t), how, network))
                found.append([Detection.from_state(one) for one in at])
        return found

    def _look_at(self, frames: Scan, how: SightingOptions, network: Guess | None) -> list[dict[str, Any]]:
        """The bodies of one time, as a checkpoint has them."""
        return [one.state() for one in sightings(frames, self.material, how, network=network)]

    def first(self) -> MovingSurfaces:
        """Bodies on first paths; the doubtful ones are left to be found beside the others."""
        times, options, basis = self.train.instants, self.options, self.basis
        if options.body is not None:
            begun = None
            with suppress(InputError):  # no track
                begun = self._detect(basis)
            posed = self._search_poses(options.body, basis, begun=begun)
            if posed is None:
                raise InputError(
                    f"no body of the shape {options.body.shape} was found in the frames; check its size, the material "
                    "and the pixel size, or leave --body."
                )
            return posed
        found = self._detect(basis)
        assert found is not None
        sure = sure_ones(found, self.train.views, times)
        return found if options.rounds == 0 or len(sure) == found.count else only(found, sure)

    @property
    def basis(self) -> TimeBasis:
        """Of paths of one piece."""
        times = self.train.instants
        return TimeBasis(float(times[0]), float(times[-1]), self.options.paths.degree)

    def _detect(self, basis: TimeBasis) -> MovingSurfaces | None:
        """The bodies of single times on first paths; None where none were looked for."""
        times, pixel = self.train.instants, self.train.views.finest
        return first_paths(self.seen, times, basis, pixel, self.material, self.options.links) if self.seen else None

    @property
    def rest(self) -> Rest | None:
        """The known shape of the bodies; of a forecast, of those that it has."""
        if self.expected is not None:
            return self.expected.rest
        body = self.options.body
        return None if body is None else at_rest(body, self.train.views.finest, self.size)

    def shape_at_rest(self) -> TriangleMesh | None:
        """In metres, where all bodies have it."""
        others = self.expected is not None and self.bodies is not None and self.bodies.count > self.expected.count
        if (rest := self.rest) is None or others:
            return None
        mesh = rest.elastic.membrane.mesh
        return TriangleMesh(self.train.views.finest * mesh.vertices, mesh.faces, "rest")

    def _search_poses(
        self,
        body: KnownBody,
        basis: TimeBasis,
        known: MovingSurfaces | None = None,
        begun: MovingSurfaces | None = None,
    ) -> MovingSurfaces | None:
        """Bodies of known shape beside `known` ones, on first paths; a search may begin with `begun` ones."""
        with self.run.timed("poses"):
            self._search = self._search or KnownBodies(self.train, self.material, body, self.size)
            found = self._search.bodies(
                basis, known, begun, self.seed, lambda share: self.on_progress("poses", share, {}), self.run
            )
            self.size = self._search.size
        if begun is not None:
            self.guess += (
                f"; poses that begin with them explain {'more' if self._search.of_begun else 'less'} than others"
            )
        return found

    def more(self, bodies: MovingSurfaces) -> MovingSurfaces | None:
        """`bodies`, and those that frames show beside them; None where there are none."""
        times = self.train.instants
        if self.options.body is not None:
            new = self._search_poses(self.options.body, bodies.basis, bodies)
            own = [] if new is None else apart(new, bodies, times)
            return joined(bodies, only(new, own)) if new is not None and own else None
        found = self.look(beside(self.train, bodies, self.oversample), self.options.fainter, lacking=True)
        try:
            new = first_paths(found, times, bodies.basis, bodies.unit_length, self.material, self.options.links)
        except InputError:  # no track
            return None
        apart_ones = apart(new, bodies, times)
        return joined(bodies, only(new, apart_ones)) if apart_ones else None

    def whole(self, bodies: MovingSurfaces) -> MovingSurfaces:
        """`bodies` without pieces of others."""
        return self.kept(bodies, whole_ones(bodies, self.train.instants))

    def kept(self, bodies: MovingSurfaces, numbers: list[int]) -> MovingSurfaces:
        """The `bodies` of these numbers, and those that a forecast has."""
        known = range(0 if self.expected is None else self.expected.count)
        both = sorted({*known, *numbers})
        return bodies if len(both) == bodies.count else only(bodies, both)

    def told_from_twins(self, bodies: MovingSurfaces) -> MovingSurfaces:
        """`bodies` of known rest shape, or their twins, where there are two beams."""
        if self.rest is None or self.expected is not None or not self.options.twins:
            return bodies
        how = (self.options.stiff, self.options.soft, self.oversample, self.seed, self.light, self.run)
        trials = Trials(self.train, self.rest, *how)
        with self.run.timed("twins"):
            found = chosen_twins(bodies, trials, lambda share: self.on_progress("twins", share, {}))
        return self._decided(*found)

    def on_chosen_paths(self, bodies: MovingSurfaces) -> MovingSurfaces:
        """`bodies` on paths of as many pieces as the frames support."""
        how = (self.options.paths, self.options.stiff, self.seed, self.light, self.rest)
        self.on_progress("paths", 0.0, {})
        with self.run.timed("paths"):
            found = chosen_paths(self.train, bodies, *how, expected=self.expected, run=self.run)
        return self._decided(*found)

    def _decided(self, bodies: MovingSurfaces, decision: Decision | None) -> MovingSurfaces:
        """`bodies`, whose decision is kept."""
        self.decisions += [] if decision is None else [decision]
        return bodies

    def fitted(
        self,
        name: str,
        frames: Scan,
        start: MovingSurfaces,
        how: MotionFit,
        light: Light | None,
        expected: Expected | None = None,
    ) -> MovingSurfaces:
        """`start` after a fit to `frames`, from where an earlier run was cut off in it; expected: in place of the
        forecast, of a part of the frames."""
        fit = motion_fit(frames, start, how, self.seed, light, self.rest, expected=expected or self.expected)

        def show(record: Record) -> None:
            self.records.append(record | {"step": len(self.records) + 1})
            self.on_progress(name, fit.share, record)

        self.run.fit(name, fit, show)
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
