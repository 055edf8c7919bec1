"""Numbers of bodies in motion: place, velocity, size, shape, spin; and their errors from halves of the frames.

Standard errors from halves of the frames: what two fits that share no frame disagree by.
Both start from the result of all frames. If halves err independently, each by √2 of what all frames do, half their
difference is a draw of the error of the result. It tells what noise does, and not what all frames have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
import torch

from ..bodies.rest_shape import moments
from ..checks import require
from ..fit.run import Record, Run
from ..geometry import Views
from ..mesh import TriangleMesh, vector_areas
from ..optics.background import Light
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Exposures, Scan
from .elastic import Rest
from .expected import second_order_field
from .fit import SHORT, MotionFit, motion_fit
from .forecast import Halves, early_count, on_paths, places_of


@dataclass(frozen=True)
class Measures:
    """A body at one time, in SI units; the fields' names are the columns of tracks.csv.

    Centre and velocity are the volume's; half axes a ≥ b ≥ c those of the ellipsoid with the same second moments, n the
    direction of the shortest (of either sign); elongation (a - b)/(a + b), deformation (a - c)/(a + c) (Taylor 1934);
    spin the angular velocity of the rigid motion nearest to that of the vertices, which is determined as far as a
    rotation changes frames; in_field the part of the vertices that some frame of that time sees.
    """

    time_s: float
    body: int
    x_m: float
    y_m: float
    z_m: float
    vx_m_s: float
    vy_m_s: float
    vz_m_s: float
    volume_m3: float
    area_m2: float
    a_m: float
    b_m: float
    c_m: float
    nx: float
    ny: float
    nz: float
    elongation: float
    deformation: float
    spin_x_rad_s: float
    spin_y_rad_s: float
    spin_z_rad_s: float
    in_field: float


def columns() -> list[str]:
    """The names of the numbers, with their units."""
    return [one.name for one in fields(Measures)]


def measured(bodies: MovingSurfaces, exposures: Exposures) -> Iterator[Measures]:
    """Measure every body at each time of the `exposures`, ordered by time, then by body."""
    for time in np.unique(exposures.time):
        speeds, views = bodies.velocities(float(time)), exposures.views[exposures.time == time]
        for number, (mesh, speed) in enumerate(zip(bodies.bodies(float(time)), speeds)):
            yield measure(mesh, speed, float(time), number, views)


def measured_columns(bodies: MovingSurfaces, exposures: Exposures) -> dict[str, np.ndarray]:
    """The same by column, [T, B] of each body at each time."""
    rows, times = list(measured(bodies, exposures)), len(np.unique(exposures.time))
    return {name: np.array([getattr(row, name) for row in rows]).reshape(times, -1) for name in columns()}


def measure(mesh: TriangleMesh, speed: np.ndarray, time: float, number: int, views: Views) -> Measures:
    """Measure one body whose vertices have the velocities `speed` [P, 3] [m/s]; views: those of its time."""
    volume, centre, second = moments(mesh)
    values, axes = np.linalg.eigh(second / volume)
    c, b, a = np.sqrt(5 * np.maximum(values, 0))
    seen = np.array([_in_field(mesh.vertices, views[[v]]) for v in range(len(views))]).any(0).mean()
    spin = angular_velocity(mesh, speed)
    place = (*centre, *volume_velocity(mesh, speed), volume, mesh.area)
    shape = (a, b, c, *axes[:, 0], (a - b) / (a + b), (a - c) / (a + c))
    return Measures(time, number, *(float(value) for value in (*place, *shape, *spin, seen)))


def row(of: Measures) -> list[str]:
    """The numbers as text, for a table."""
    return [str(v) if isinstance(v, int) else f"{v:.7g}" for v in astuple(of)]


def volume_velocity(mesh: TriangleMesh, speed: np.ndarray) -> np.ndarray:
    """Velocity [3] [m/s] of the centre of the volume: (∫ (x - c) (v · n) dA) / V (Reynolds' transport theorem)."""
    volume, centre, _ = moments(mesh)
    corners, normals = (mesh.vertices - centre)[mesh.faces], vector_areas(mesh)
    through = np.einsum("fci,fi->fc", speed[mesh.faces], normals)
    # of linear functions f, g on a triangle: ∫ f g = A/12 (Σ fᵢ gᵢ + Σ fᵢ Σ gᵢ)
    sums = np.einsum("fci,fc->i", corners, through) + np.einsum("fi,f->i", corners.sum(1), through.sum(1))
    return sums / 12 / volume


def angular_velocity(mesh: TriangleMesh, speed: np.ndarray) -> np.ndarray:
    """Angular velocity [3] [rad/s] of the rigid motion nearest to the velocities `speed` [P, 3] on the surface."""
    weights = np.bincount(mesh.faces.ravel(), np.repeat(np.linalg.norm(vector_areas(mesh), axis=1) / 3, 3))
    weights = weights / weights.sum()
    arms, speeds = (values - weights @ values for values in (mesh.vertices, speed))
    inertia = np.einsum("p,pk,pk->", weights, arms, arms) * np.eye(3) - np.einsum("p,pi,pj->ij", weights, arms, arms)
    return np.linalg.solve(inertia, weights @ np.cross(arms, speeds))


def _in_field(points: np.ndarray, view: Views) -> np.ndarray:
    """Whether points [P, 3] [m] are on the detector of one view, [P] bool."""
    lab = points @ view.rotations[0].T
    wider = 1.0 if view.sources is None else view.sources[0] / (view.sources[0] + lab[:, 2:])
    seen = wider * lab[:, :2] - view.shifts[0]
    rows, columns = view.shape
    return (np.abs(seen) <= 0.5 * np.array([columns, rows]) * view.pixel_sizes[0]).all(1)


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

    About the middle of a body of radius r (root mean square), a place x is moved by r · ASTRAY times the field at x/r,
    at all times alike.
    """
    draws, moved = np.random.default_rng([seed, 1]), bodies.coefficients.detach().clone()
    for number in range(bodies.count):
        own, _ = bodies.body(number)
        shape = moved[:, own].mean(0)
        shape = shape - shape.mean(0)
        radius = float(shape.square().sum(1).mean().sqrt())
        field = second_order_field(draws)((shape / radius).numpy())
        moved[:, own] += side * ASTRAY * radius * torch.from_numpy(field)
    return bodies.with_parameters({"coefficients": moved})


def standard_errors(bodies: MovingSurfaces, halves: Sequence[MovingSurfaces], scan: Scan) -> Mapping[str, np.ndarray]:
    """Standard errors [T, B] of `bodies` at the times of `scan`, by column; empty without `halves`.

    halves: bodies by the one and the other half of a split, split after split. The square of an error is the mean over
    splits of a quarter of the squared difference, in equal parts of the body at that time, and of all bodies at all
    times, weighed by the part of them that is in the field: of one body alone, few splits tell little.
    """
    if not halves:
        return {}
    rows = [measured_columns(one, scan.exposures) for one in (bodies, *halves)]
    seen, found = rows[0]["in_field"], {}
    for column in columns():
        if column in NO_ERRORS:
            continue
        draws = [(one[column] - other[column]) ** 2 / 4 for one, other in zip(rows[1::2], rows[2::2])]
        own = np.mean(draws, axis=0)
        common = float((seen * own).sum() / seen.sum()) if seen.any() else float(own.mean())
        found[column] = np.sqrt(0.5 * own + 0.5 * common)
    return found


def half_fit(rest: Rest | None) -> MotionFit:
    """The usual fit to a half: to its end. Of a known shape at rest it is short, for else halves agree on what both
    have from that."""
    return MotionFit() if rest is None else SHORT


def half_sets(
    train: Scan,
    bodies: MovingSurfaces,
    how: MotionFit | None = None,
    seed: int = 0,
    light: Light | None = None,
    *,
    rest: Rest | None = None,
    run: Run | None = None,
    on_record: Callable[[Record], None] = lambda record: None,
) -> Halves:
    """`bodies`, fitted to the frames `train` of all times, fitted on to those of every other time, both halves of them.

    Times before and after determine a path, so that each half gives nearly the path of the whole, with independent
    noise. If views are too few for shapes, the halves begin with perturbed shapes, as those of standard errors do
    (`astray`), but at the same middles. how: as `half_fit` by default; light: of the frames, which were divided by it;
    rest: the known shape of the bodies; run: keeps both fits, and goes on with them. Errors: `InputError` for fewer
    times than tell the paths of halves.
    """
    times = train.instants
    require(
        len(times) >= 2 * (count := bodies.basis.count),
        f"half-sets of paths of {count} coefficients need frames of {2 * count} times or more, but there are "
        f"{len(times)}; leave them with --no-half-sets.",
    )
    number = np.searchsorted(times, train.exposures.time)
    found, run = [], run or Run()
    for half in (0, 1):
        kept = np.flatnonzero(number % 2 == half)
        part = None if light is None else light.part(torch.from_numpy(kept))
        start = bodies if tell_shapes(train) else _shapes_astray(bodies, seed, 1 - 2 * half)
        fit = motion_fit(train[kept], start, how or half_fit(rest), seed, part, rest)
        kept_half = run.part(f"half-set {half}")
        kept_half.fit("half-sets", fit, on_record)
        kept_half.keep()
        one = fit.result().object
        assert isinstance(one, MovingSurfaces)
        found.append(one.with_parameters({"coefficients": one.coefficients.detach()}))
    return found[0], found[1]


def early_part(train: Scan, bodies: MovingSurfaces, times: np.ndarray) -> tuple[np.ndarray, MovingSurfaces]:
    """Numbers of the frames of `train` in the first two thirds of `times` [T] s, and the `bodies` on paths of these
    alone, of no more coefficients than half of them tell: what `half_sets` begins with, to test forecasts."""
    first = early_count(len(times))
    kept = np.flatnonzero(train.exposures.time < times[first - 1 : first + 1].mean())
    known = train[kept].instants
    degree = min(bodies.basis.degree, len(known) // 2 - 1)
    basis = replace(
        bodies.basis,
        last=float(known[-1]),
        degree=degree,
        pieces=min(bodies.basis.pieces, len(known) // 2 - degree),
    )
    return kept, on_paths(bodies, known, places_of(bodies, known), basis)


def _shapes_astray(bodies: MovingSurfaces, seed: int, side: int) -> MovingSurfaces:
    moved = astray(bodies, seed, side).coefficients
    for number in range(bodies.count):
        own, _ = bodies.body(number)
        moved[:, own] -= (moved[:, own] - bodies.coefficients.detach()[:, own]).mean(1, keepdim=True)
    return bodies.with_parameters({"coefficients": moved})
