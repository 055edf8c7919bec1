"""Standard errors from halves of the frames: what two fits that share no frame disagree by.

Both start from the result of all frames. If halves err independently, each by √2 of what all frames do, half their
difference is a draw of the error of the result. It tells what noise does, and not what all frames have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from ..checks import require
from ..fit.running import Record
from ..optics.background import Light
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Scan
from .elastic import Rest
from .fit import MotionFit, motion_fit
from .forecast import Halves
from .measures import Measures, columns, measured

FEWEST_VIEWS = 4
"""Views of a time from which on half of them still tell a shape."""
NO_ERRORS = ("time_s", "body", "nx", "ny", "nz", "in_field")
"""Columns that have no standard error."""

ASTRAY = 0.1
"""Displacement by which halves of fewer views begin apart, in radii of a body, to either side: what few beams do not
tell of a shape stays where it begins."""

Pair = tuple[np.ndarray, np.ndarray]


def halves_of(train: Scan, basis: TimeBasis) -> list[Pair]:
    """Frames of every second time and the others, where each half tells all coefficients of the paths; and every second
    view of each time and the others, where there are `FEWEST_VIEWS` at every time."""
    times, number = np.unique(train.exposures.time, return_inverse=True)
    order = np.zeros(len(train), dtype=int)
    for t in range(len(times)):
        order[number == t] = np.arange((number == t).sum())
    found = []
    if len(times) // 2 >= basis.count:
        found.append(number % 2)
    if np.bincount(number).min() >= FEWEST_VIEWS:
        found.append(order % 2)
    return [(np.flatnonzero(part == 0), np.flatnonzero(part == 1)) for part in found]


def tell_shapes(train: Scan) -> bool:
    """Whether frames are of so many views that shapes do not depend on where a fit begins."""
    return bool(np.unique(train.exposures.time, return_counts=True)[1].min() >= FEWEST_VIEWS)


def astray(bodies: MovingSurfaces, seed: int, side: int) -> MovingSurfaces:
    """Each of `bodies` displaced by a random smooth field, of second order in the place; the other way for side -1.

    About the middle of a body of radius r (root mean square), a place x is moved by r · ASTRAY · (A ξ + B ξ ξ) with
    ξ = x/r, at all times alike; a number of A and B is drawn from a normal distribution, such that the mean square of
    either term is one where ξ is of length one.
    """
    draws, moved = np.random.default_rng([seed, 1]), bodies.coefficients.detach().clone()
    for number in range(bodies.count):
        own, _ = bodies.body(number)
        shape = moved[:, own].mean(0)
        shape = shape - shape.mean(0)
        radius = float(shape.square().sum(1).mean().sqrt())
        first, second = (torch.from_numpy(draws.normal(size=size)) / 3**0.5 for size in ((3, 3), (3, 3, 3)))
        xi = shape / radius
        moved[:, own] += side * ASTRAY * radius * (xi @ first.T + torch.einsum("ijk,pj,pk->pi", second, xi, xi))
    return bodies.with_parameters({"coefficients": moved})


def standard_errors(bodies: MovingSurfaces, halves: Sequence[MovingSurfaces], scan: Scan) -> Mapping[str, np.ndarray]:
    """Standard errors [T, B] of `bodies` at the times of `scan`, by column; empty without `halves`.

    halves: bodies by the one and the other half of a split, split after split. The square of an error is the mean over
    splits of a quarter of the squared difference, in equal parts of the body at that time, and of all bodies at all
    times, weighed by the part of them that is in the field: of one body alone, few splits tell little.
    """
    if not halves:
        return {}
    rows = [_table(one, scan) for one in (bodies, *halves)]
    seen, found = rows[0]["in_field"], {}
    for column in columns():
        if column in NO_ERRORS:
            continue
        draws = [(one[column] - other[column]) ** 2 / 4 for one, other in zip(rows[1::2], rows[2::2])]
        own = np.mean(draws, axis=0)
        common = float((seen * own).sum() / seen.sum()) if seen.any() else float(own.mean())
        found[column] = np.sqrt(0.5 * own + 0.5 * common)
    return found


def _table(bodies: MovingSurfaces, scan: Scan) -> dict[str, np.ndarray]:
    rows: list[Measures] = list(measured(bodies, scan.exposures))
    times = len(np.unique(scan.exposures.time))
    return {name: np.array([getattr(row, name) for row in rows]).reshape(times, -1) for name in columns()}


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
