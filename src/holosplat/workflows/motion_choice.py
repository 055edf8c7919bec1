"""How matter changes over the times of a scan, chosen by frames that were set aside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch

from ..checks import InputError, as_written, require
from ..inference import Decision, Score, select
from ..io.provenance import NAME, records
from ..matter import MaterialPrior, MatterKind
from ..methods import Auto, Method
from ..methods.cross_validation import predicted_frames
from ..motion.timed_frames import merged
from ..motion.track import TrackOptions
from ..optics.background import LightOptions
from ..progress import FitProgress
from ..scan import Scan
from ..volume import Object
from .reconstruct import reconstruct
from .track import reconstruct_moving, track

Motion = Literal["each", "still", "flow", "bodies"]
MOTION, BY = "motion", "times set aside"
LOOKED_AT, FEWEST = 3, 6
"""Times that are set aside, at most; and times from which on some can be, for a flow needs three others."""

Way = Callable[[Scan], Object | None]
"""Matter at all times from the frames of some; None where there is none of this kind."""


def choose_motion(
    scan: Scan,
    prior: MaterialPrior,
    method: Method = Auto(),
    seed: int = 0,
    *,
    light: LightOptions | None = None,
    matter: MatterKind | None = None,
    bodies: TrackOptions = TrackOptions(),
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Decision:
    """Whether each time is best taken by itself, or all as still matter, as matter that a flow carries, or as bodies.

    Some times are set aside. Still matter, flow and bodies are found in the frames of the others; the null, a time by
    itself, in its own frames but one, which all of them predict. So what is taken in place of the null predicts times
    that it has not seen better than they themselves do. A flow and bodies are tried where `method` and `matter` leave
    them open, as --motion flow and bodies do. on_progress: called with the way and its stage, the fraction of it that
    is done, and a record of numbers. Errors: `InputError` for few times, and for times of one frame.
    """

    def of(way: str) -> FitProgress:
        return lambda stage, fraction, record: on_progress(f"{MOTION}, {way}: {stage}", fraction, record)

    def alone(part: Scan, way: str = "a time by itself") -> Object:
        return reconstruct(part, prior, method, seed, light=light, matter=matter, on_progress=of(way)).object

    def carried(part: Scan) -> Object | None:
        found = reconstruct_moving(part, prior, seed=seed, light=light, on_progress=of("flow"))
        return None if found is None else found.reconstruction.object

    ways: dict[str, Way] = {"still": lambda part: alone(merged(part), "still")}
    if may_flow(method, matter):
        ways["flow"] = carried
    if isinstance(method, Auto) and matter is None:
        ways["bodies"] = lambda part: track(part, prior, bodies, seed, light=light, on_progress=of("bodies")).object
    return decide(scan.train(), alone, ways)


def may_flow(method: Method, matter: MatterKind | None) -> bool:
    """Whether a flow may carry the matter: the method is left to the program, and matter not said to have levels."""
    return isinstance(method, Auto) and matter != "levels"


def motion_named(name: str) -> Motion:
    """The way of that name. Errors: `InputError` for any other."""
    known: dict[str, Motion] = {each: each for each in get_args(Motion)}
    if name not in known:
        raise InputError(f"the motion must be one of {', '.join(known)}, but it is {name[:40]!r}.")
    return known[name]


def begun_motion(folder: Path) -> Decision | None:
    """What the `--motion auto` that began a folder has decided; None where none did.

    Errors: `InputError` where provenance.json says something else of it.
    """
    with as_written(folder / NAME):
        said = next((each["decided"][MOTION] for each in records(folder) if MOTION in each.get("decided", {})), None)
        found = None if said is None else Decision.from_dict(said)
        if found is not None:
            motion_named(found.choice)
        return found


def decide(train: Scan, alone: Callable[[Scan], Object], ways: Mapping[str, Way]) -> Decision:
    """The decision between times `alone`, the null, and `ways` of all times, each from simple to complex.

    A way that finds nothing is not compared; the decision says why.
    """
    times = train.instants
    require(
        len(times) >= FEWEST,
        f"--motion auto sets times aside, so it needs {FEWEST} of them or more, but the scan has {len(times)}; "
        "name the motion.",
    )
    aside = np.unique(np.linspace(1, len(times) - 2, LOOKED_AT).round().astype(int))
    of_time = [np.flatnonzero(train.exposures.time == times[k]) for k in aside]
    few = min(map(len, of_time))
    require(few > 1, "--motion auto sets a frame of a time aside, but a time has one training frame; name the motion.")
    unseen = [frames[n % len(frames)] for n, frames in enumerate(of_time)]
    others = train[np.flatnonzero(~np.isin(train.exposures.time, times[aside]))]

    found, by = dict[str, Object](), BY
    for name, way in ways.items():
        try:
            matter, why = way(others), "nothing moves"
        except InputError as error:
            matter, why = None, str(error).rstrip(".")
        if matter is None:
            by += f"; without {name}, for {why}"
        else:
            found[name] = matter

    @cache
    def single(n: int) -> Object:
        return alone(train[np.setdiff1d(of_time[n], unseen[n : n + 1])].as_static())

    def score(name: str, fold: int) -> Score:
        left = []
        for n, frame in enumerate(unseen):
            part = train[[frame]].as_static()
            now = (single(n) if name == "each" else found[name]).at(float(times[aside[n]]))
            left.append(part.left(predicted_frames(part.exposures, now)))
        return Score.of(torch.cat(left))

    return select(MOTION, ("each", *found), score, by=by)
