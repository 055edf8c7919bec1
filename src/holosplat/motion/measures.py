"""Numbers of bodies in motion: where they are, how fast, how large, of what shape, how they turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields

import numpy as np

from ..bodies.moments import moments
from ..geometry import Views
from ..mesh import TriangleMesh
from ..representations import MovingSurfaces
from ..scan import Exposures


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


def measure(mesh: TriangleMesh, speed: np.ndarray, time: float, number: int, views: Views) -> Measures:
    """Measure one body whose vertices have the velocities `speed` [P, 3] [m/s]; views: those of its time."""
    volume, centre, second = moments(mesh)
    values, axes = np.linalg.eigh(second / volume)
    c, b, a = np.sqrt(5 * np.maximum(values, 0))
    seen = np.array([_in_field(mesh.vertices, views[[v]]) for v in range(len(views))]).any(0).mean()
    spin = angular_velocity(mesh, speed)
    place = (*centre, *volume_velocity(mesh, speed), volume, area(mesh))
    shape = (a, b, c, *axes[:, 0], (a - b) / (a + b), (a - c) / (a + c))
    return Measures(time, number, *(float(value) for value in (*place, *shape, *spin, seen)))


def row(of: Measures) -> list[str]:
    """The numbers as text, for a table."""
    return [str(v) if isinstance(v, int) else f"{v:.7g}" for v in astuple(of)]


def area(mesh: TriangleMesh) -> float:
    """Area of the surface [m²]."""
    return float(np.linalg.norm(_normals(mesh), axis=1).sum())


def volume_velocity(mesh: TriangleMesh, speed: np.ndarray) -> np.ndarray:
    """Velocity [3] [m/s] of the centre of the volume: (∫ (x - c) (v · n) dA) / V (Reynolds' transport theorem)."""
    volume, centre, _ = moments(mesh)
    corners, normals = (mesh.vertices - centre)[mesh.faces], _normals(mesh)
    through = np.einsum("fci,fi->fc", speed[mesh.faces], normals)
    # of linear functions f, g on a triangle: ∫ f g = A/12 (Σ fᵢ gᵢ + Σ fᵢ Σ gᵢ)
    sums = np.einsum("fci,fc->i", corners, through) + np.einsum("fi,f->i", corners.sum(1), through.sum(1))
    return sums / 12 / volume


def angular_velocity(mesh: TriangleMesh, speed: np.ndarray) -> np.ndarray:
    """Angular velocity [3] [rad/s] of the rigid motion nearest to the velocities `speed` [P, 3] on the surface."""
    weights = np.bincount(mesh.faces.ravel(), np.repeat(np.linalg.norm(_normals(mesh), axis=1) / 3, 3))
    weights = weights / weights.sum()
    arms, speeds = (values - weights @ values for values in (mesh.vertices, speed))
    inertia = np.einsum("p,pk,pk->", weights, arms, arms) * np.eye(3) - np.einsum("p,pi,pj->ij", weights, arms, arms)
    return np.linalg.solve(inertia, weights @ np.cross(arms, speeds))


def _normals(mesh: TriangleMesh) -> np.ndarray:
    """Vector areas [F, 3] [m²]."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def _in_field(points: np.ndarray, view: Views) -> np.ndarray:
    """Whether points [P, 3] [m] are on the detector of one view, [P] bool."""
    seen = points @ view.rotations[0, :2].T - view.shifts[0]
    rows, columns = view.shape
    return (np.abs(seen) <= 0.5 * np.array([columns, rows]) * view.pixel_sizes[0]).all(1)
