"""Frames of ellipsoids that move, turn and deform: a scan of several times with its truth, small enough for tests."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshSeries

PIXEL, STEP, TIMES = 1e-6, 1e-5, 5
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
SHAPE = (37, 30)
ANGLES = (0.0, 45.0, 90.0, 135.0)
BODIES = (
    ((-5.0, -7.0, 2.0), (5.0, 3.0, 4.0), (0.3, 2.2, 0.1)),
    ((4.5, 3.0, -3.0), (3.0, 5.0, 3.5), (-0.2, 1.8, 0.2)),
    ((1.0, 12.0, 5.0), (4.0, 3.2, 4.0), (0.0, 2.5, 0.0)),
)
"""Middle at the middle time, half axes, and step from one time to the next [pixels]; the third leaves the field."""
GROWTH = (0.03, -0.015, -0.015)
"""Logarithms of what axes grow by from one time to the next, in the mean: volumes stay."""


def ellipsoid(body: int, time: float, subdivisions: int = 3) -> TriangleMesh:
    """A body at a time, counted in steps from the middle one."""
    sphere, faces = icosphere(subdivisions)
    middle, axes, step = (np.array(part) for part in BODIES[body])
    grown = axes * np.exp(np.array(GROWTH) * time)
    turn = Rotation.from_rotvec([0.05 * time, 0.3 + body, 0.06 * time]).as_matrix()
    points = (sphere * grown) @ turn.T + middle + time * step
    return TriangleMesh(PIXEL * points, faces, f"ellipsoid{body}")


@cache
def truth(times: int = TIMES) -> MeshSeries:
    """The bodies at all times."""
    half = 0.5 * (times - 1)
    scenes = [
        hs.MeshScene.of_one_material([ellipsoid(k, t - half) for k in range(len(BODIES))], MATERIAL)
        for t in range(times)
    ]
    return MeshSeries(tuple(scenes), STEP * np.arange(times))


@cache
def true_paths(degree: int = 2) -> MovingSurfaces:
    """The bodies, of coarse triangles, on their true paths, as near as polynomials come."""
    basis, middle = TimeBasis(0.0, STEP * (TIMES - 1), degree), 0.5 * (TIMES - 1)
    meshes = [[ellipsoid(k, t - middle, 2) for k in range(len(BODIES))] for t in range(TIMES)]
    nodes = np.array([[mesh.vertices for mesh in at] for at in meshes])
    paths = [basis.fitted(truth().times, nodes[:, k]) for k in range(len(BODIES))]
    faces = [mesh.faces for mesh in meshes[0]]
    return MovingSurfaces.of_bodies(paths, faces, basis, PIXEL, Matter.one(*MATERIAL))


@cache
def scan(photons: float = 5000.0, times: int = TIMES) -> hs.Scan:
    """Four beams over half a turn, five times."""
    views = hs.Views.from_angles(np.array(ANGLES), SHAPE, PIXEL)
    exposures = hs.Exposures.of(views, 20.0, 0.1).repeated(truth(times).times)
    return hs.simulate(truth(times), exposures, photons_per_pixel=photons, is_test=np.zeros(len(exposures), bool))
