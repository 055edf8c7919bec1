"""Numbers of bodies against closed forms: an ellipsoid that moves, turns and stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.polycube import polycube
from holosplat.bodies.rest_shape import centroid, is_cut, moments
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.motion.detections import Detection
from holosplat.motion.measures import angular_velocity, columns, measure, measured, row, volume_velocity
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere

AXES = np.array([5e-6, 3e-6, 2e-6])
CENTRE = np.array([2e-6, -1e-6, 4e-6])
TURN = Rotation.from_rotvec([0.4, -0.2, 0.7]).as_matrix()
VIEWS = Views.from_angles([0.0, 60.0], (21, 31), 1e-6)


def ellipsoid(subdivisions: int = 4) -> TriangleMesh:
    sphere, faces = icosphere(subdivisions)
    return TriangleMesh((sphere * AXES) @ TURN.T + CENTRE, faces)


def test_moments_are_those_of_an_ellipsoid():
    """V = 4/3 π abc, second moments V/5 diag(a², b², c²) in its own axes."""
    volume, centre, second = moments(ellipsoid())
    assert volume == pytest.approx(4 / 3 * np.pi * AXES.prod(), rel=4e-3)
    assert centre == pytest.approx(CENTRE, abs=1e-12)
    assert centroid(ellipsoid()) == pytest.approx(CENTRE, abs=1e-12)
    bent = polycube(2.0, ((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    assert centroid(bent) == pytest.approx([5 / 3, 5 / 3, 1], abs=1e-12)
    assert bent.volume == pytest.approx(24)
    assert TURN.T @ second @ TURN / volume == pytest.approx(np.diag(AXES**2) / 5, rel=4e-3, abs=1e-17)


def test_moments_of_a_body_far_away_with_a_cavity():
    """A box minus a smaller box, wound inwards: what is enclosed by both is not there."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces = np.array([*faces, [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
    box = lambda low, size: np.array(low) + np.array(size) * corners + 100  # noqa: E731
    mesh = TriangleMesh(
        np.concatenate([box((0, 0, 0), (2, 3, 4)), box((1, 1, 1), (0.5, 1, 1))]),
        np.concatenate([faces, faces[:, ::-1] + 8]),
    )
    volume, centre, _ = moments(mesh)
    assert volume == pytest.approx(24 - 0.5)
    assert centre - 100 == pytest.approx((24 * np.array([1, 1.5, 2]) - 0.5 * np.array([1.25, 1.5, 1.5])) / 23.5)


def test_velocities_of_a_rigid_motion_and_a_stretch():
    """A rigid motion has its own velocity and spin; an even stretch along axes moves no centre, and turns nothing."""
    mesh, along, spin = ellipsoid(), np.array([0.05, 0.02, -0.03]), np.array([2e3, -1e3, 5e2])
    rigid = along + np.cross(spin, mesh.vertices - CENTRE)
    stretch = ((mesh.vertices - CENTRE) @ TURN * np.array([3e3, -2e3, -1e3])) @ TURN.T
    for speed in (rigid, rigid + stretch):
        assert volume_velocity(mesh, speed) == pytest.approx(along, abs=1e-9)
        assert angular_velocity(mesh, speed) == pytest.approx(spin, rel=1e-6)


def test_the_velocity_of_the_volume_is_the_change_of_its_centre():
    """Of any motion of the vertices, against finite differences."""
    mesh = ellipsoid(2)
    speed = np.sin(1e6 * mesh.vertices[:, [1, 2, 0]]) + np.array([0.3, 0.0, -0.2])
    step = 1e-10
    ahead, behind = (centroid(TriangleMesh(mesh.vertices + s * speed, mesh.faces)) for s in (step, -step))
    assert volume_velocity(mesh, speed) == pytest.approx((ahead - behind) / (2 * step), rel=1e-5)


def test_measures_say_shape_and_direction():
    found = measure(ellipsoid(), np.zeros((2562, 3)), 1e-5, 3, VIEWS)
    assert (found.time_s, found.body, found.in_field) == (1e-5, 3, 1.0)
    assert (found.a_m, found.b_m, found.c_m) == pytest.approx(AXES, rel=4e-3)
    assert abs(np.array([found.nx, found.ny, found.nz]) @ TURN[:, 2]) == pytest.approx(1, abs=1e-6)
    assert found.elongation == pytest.approx(2 / 8, abs=2e-3)
    assert found.deformation == pytest.approx(3 / 7, abs=2e-3)
    p = 1.6075  # Thomsen's formula for the area of an ellipsoid, right to 1.1 %
    a, b, c = AXES**p
    assert found.area_m2 == pytest.approx(4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / p), rel=0.012)
    assert len(row(found)) == len(columns())


def test_a_moving_body_is_measured_at_every_time():
    """It leaves the field, whose rows end at 10.5 µm, and the part that is seen falls to nothing."""
    sphere, faces = icosphere(2)
    basis, times = TimeBasis(0.0, 1e-4, 2), np.linspace(0, 1e-4, 3)
    places = np.array([3e-6 * sphere + np.array([0, 0.3 * t, 0]) for t in times])
    body = MovingSurfaces.of_bodies([basis.fitted(times, places)], [faces], basis, 1e-6, Matter.one(1e-7, 0.0))
    found = list(measured(body, Exposures.of(VIEWS, 20.0, 0.1).repeated(times)))
    assert [one.vy_m_s for one in found] == pytest.approx([0.3] * 3, rel=1e-6)
    assert [one.in_field for one in found] == [1.0, 0.0, 0.0]


def test_what_the_edge_cuts_is_known():
    """Rows cut in any view; columns only where all views' do, which a body on the axis is not."""
    sphere, faces = icosphere(2)
    at = lambda *centre: TriangleMesh(3e-6 * sphere + 1e-6 * np.array(centre), faces)  # noqa: E731
    assert not is_cut(at(0, 0, 0), VIEWS)
    assert is_cut(at(0, 7.0, 0), VIEWS)
    assert not is_cut(at(14.0, 0, 0), VIEWS)
    assert is_cut(at(14.0, 0, -30.0), VIEWS)
    assert Detection(at(0, 0, 0), False).reach == pytest.approx(3e-6, rel=0.03)


def test_what_one_beam_sees_is_in_the_field():
    """Beside the columns of one view, within those of another; and half of a ball beyond the rows of both."""
    sphere, faces = icosphere(3)
    views = Views.from_angles([0.0, 90.0], (21, 31), 1e-6)
    at = lambda *centre: TriangleMesh(3e-6 * sphere + 1e-6 * np.array(centre), faces)  # noqa: E731
    parts = [measure(at(*c), np.zeros_like(sphere), 0.0, 0, views).in_field for c in ((20, 0, 0), (0, 10.5, 0))]
    assert parts == pytest.approx([1.0, 0.5], abs=0.05)


def test_a_cone_shows_less_of_what_is_near_its_source():
    """Of a source at 50 µm, a field of 31 µm shows 21.7 µm at 15 µm before the plane, and 40.3 µm behind it."""
    views = replace(Views.from_angles([0.0], (31, 31), 1e-6), sources=np.array([50e-6]))
    sphere, faces = icosphere(3)
    at = lambda x, z: TriangleMesh(2e-6 * sphere + [1e-6 * x, 0, 1e-6 * z], faces)  # noqa: E731
    parts = [measure(at(*place), np.zeros_like(sphere), 0.0, 0, views).in_field for place in ((13.2, -15), (17.5, 15))]
    assert parts == [0.0, 1.0]
