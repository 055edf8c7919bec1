"""What every fit to frames stands on: training and validation frames, wave optics, and the data term."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..checks import InputError, require
from ..fit.problem import Schedule, Term
from ..fit.residuals import Judge, set_aside, split_validation
from ..fit.terms import TERMS, FrameTerm, Objective
from ..matter import Matter
from ..model import Instrument, Model, SolvedLight
from ..optics.background import Light
from ..optics.sampling import fringe_sampling
from ..ranges import checked_dataclass
from ..scan import Scan
from ..volume import Object


@checked_dataclass
class ExtraTerm:
    """A term of `fit.terms.TERMS` beside those of the objective."""

    name: str
    """Which term."""
    weight: float = 1.0
    """Its weight."""

    def __post_init__(self) -> None:
        if self.name not in TERMS:
            raise InputError(f"a term must be one of {', '.join(TERMS)}, but it is {self.name!r}.")
        require(
            self.weight >= 0, f"the weight of the term {self.name} must not be negative, but it is {self.weight:g}."
        )


@dataclass(frozen=True)
class Ground:
    """What a fit to frames begins with.

    train: the frames to fit
    model: the object in their exposures
    frames: the data term
    judge: scores the frames that are set aside; None without any
    """

    train: Scan
    model: Model
    frames: FrameTerm
    judge: Judge | None

    def in_noise(self, weight: float, more: float) -> float:
        """`weight`, and `more` for every pixel of thickness that the noise of the frames amounts to."""
        return weight + more * (0.0 if self.frames.spectral is None else self.frames.spectral.noise)

    def extra(self, terms: tuple[ExtraTerm, ...]) -> list[Term]:
        """The terms that are asked for by name."""
        return [TERMS[term.name](term.weight, self.model, self.train) for term in terms]


def ground(
    scan: Scan,
    obj: Object,
    matter: Matter,
    objective: Objective,
    schedule: Schedule,
    backend: str,
    *,
    finer: int = 0,
    light: Light | None = None,
) -> Ground:
    """The ground of a fit of `obj`, made of `matter`, to the training frames of `scan`.

    backend: resolved. finer: wave samples a pixel, at least, where the schedule does not say how many. light: of these
    frames, which were divided by it, where it is uneven; what is left of it is solved for in every step. Errors:
    `InputError` without training frames, or where they show nothing.
    """
    train, aside = split_validation(scan.train(), schedule.validation_views)
    require(np.ptp(train.frames) > 0, "all training frames are constant, so there is nothing to fit.")
    oversample = schedule.oversample or max(finer, fringe_sampling(train.exposures))
    instrument = Instrument(train.exposures, oversample, backend=backend)
    frames = FrameTerm(train, instrument, objective, matter, schedule.detach_worst)
    judge = None
    if len(aside):
        judge = Judge(aside, Instrument(aside.exposures, oversample, backend=backend), frames.low, frames.span)
    return Ground(train, Model(obj, instrument, light=_solved(light, train, schedule, instrument)), frames, judge)


def _solved(light: Light | None, train: Scan, schedule: Schedule, instrument: Instrument) -> SolvedLight | None:
    """The light of the training frames that are not set aside, where it is uneven."""
    if light is None or light.background is None:
        return None
    used = torch.from_numpy(np.flatnonzero(~set_aside(len(light.background), schedule.validation_views)))
    frames = torch.from_numpy(train.frames).to(instrument.device)
    return SolvedLight(light.background[used], frames, light.air[used])
