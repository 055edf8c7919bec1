"""How bodies are followed through time: the options of `track`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from ..bodies.rest_shape import KnownBody
from ..fit.schedule import Schedule
from ..learning.start import LearnedStart
from ..ranges import Share, ranged
from .detections import SightingOptions
from .fit import MotionFit, PathOptions, converged
from .track_linking import LinkOptions


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
        default_factory=lambda: MotionFit(rate=0.4, stiffness=100.0, schedule=Schedule(steps=60, views_per_step=16))
    )
    """The first fit, in which bodies move and turn nearly as a whole."""
    soft: MotionFit = field(default_factory=converged)
    """The second one, in which they deform."""

    twins: bool = True
    """Whether to compare bodies of known shape with others that have the same shadows in two beams."""
    intervals: bool = True
    """Whether halves of the frames are fitted, too, for standard errors: up to four short fits."""
    half: MotionFit = field(default_factory=lambda: MotionFit(rate=0.1, schedule=Schedule(steps=40, views_per_step=16)))
    """The fit to a half, from the result: errors are hundredths of a pixel. By Adam: halves that L-BFGS fits to the end
    agree on what both have from a known shape (two beams at 24°: volumes off by five standard errors). Where few beams
    see bodies of unknown shape, halves begin apart and are fitted as all frames are, softly: short fits leave them so
    (three beams: a tenth of the error that they say)."""

    def with_effort(self, effort: float) -> TrackOptions:
        """The same with `effort` times the steps, at least one."""
        parts = {name: getattr(self, name) for name in ("stiff", "soft", "half")}
        changed = {name: replace(part, schedule=part.schedule.with_effort(effort)) for name, part in parts.items()}
        return replace(self, **changed)
