"""Fits to two halves of the times: where they disagree, frames do not tell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..checks import require
from ..fit.running import Record
from ..optics.background import Light
from ..representations import MovingSurfaces
from ..scan import Scan
from .elastic import Rest
from .fit import MotionFit, motion_fit
from .forecast import Halves
from .halves import astray, tell_shapes

LEAST = 8
"""Times from which on halves of them still tell the paths of the whole."""
USUAL = MotionFit()
"""The usual options of fits to halves."""


def half_sets(
    train: Scan,
    bodies: MovingSurfaces,
    how: MotionFit = USUAL,
    seed: int = 0,
    light: Light | None = None,
    *,
    rest: Rest | None = None,
    on_record: Callable[[Record], None] = lambda record: None,
) -> Halves:
    """`bodies`, fitted to the frames `train` of all times, fitted on to those of every other time, both halves of them.

    Times before and after determine a path, so that each half gives nearly the path of the whole, with independent
    noise. If views are too few for shapes, the halves begin with perturbed shapes, as those of standard errors do
    (`halves.astray`), but at the same middles. light: of the frames, which were divided by it; rest: the known shape of
    the bodies. Errors: `InputError` for fewer than 8 times.
    """
    times = train.instants
    require(
        len(times) >= LEAST,
        f"half-sets need frames of {LEAST} times or more, but there are {len(times)}; leave them with --no-half-sets.",
    )
    number = np.searchsorted(times, train.exposures.time)
    found = []
    for half in (0, 1):
        kept = np.flatnonzero(number % 2 == half)
        part = None if light is None else light.part(torch.from_numpy(kept))
        start = bodies if tell_shapes(train) else _shapes_astray(bodies, seed, 1 - 2 * half)
        fit = motion_fit(train[kept], start, how, seed, part, rest)
        fit.run(on_record)
        one = fit.result().object
        assert isinstance(one, MovingSurfaces)
        found.append(one.with_parameters({"coefficients": one.coefficients.detach()}))
    return found[0], found[1]


def _shapes_astray(bodies: MovingSurfaces, seed: int, side: int) -> MovingSurfaces:
    moved = astray(bodies, seed, side).coefficients
    for number in range(bodies.count):
        own, _ = bodies.body(number)
        moved[:, own] -= (moved[:, own] - bodies.coefficients.detach()[:, own]).mean(1, keepdim=True)
    return bodies.with_parameters({"coefficients": moved})
