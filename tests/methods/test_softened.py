"""Surfaces near to those of the frames: as smooth in pixels on large triangles as on small ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import bumpy, poses, surfaces
from holosplat.beamline.simulate import simulate
from holosplat.fit.terms import Objective
from holosplat.fit.terms.object import Bending
from holosplat.materials import HAEMOGLOBIN
from holosplat.mesh import TriangleMesh
from holosplat.methods import SurfaceFit
from holosplat.methods.coarse import CoarseToFine
from holosplat.methods.surface_fit import _membrane, softened, surface_fit
from holosplat.representations import SurfaceMesh
from holosplat.representations.isosurface import edge_lengths
from holosplat.scan import Exposures, Scan
from holosplat.specimens.scene import MeshScene

BY_EDGES = 1e6
PITCH = 1e-6


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Two views of a bumpy body."""
    true = bumpy(3, 9.0, depth=0.25)
    scene = MeshScene.of_one_material([replace(true, vertices=PITCH * true.vertices)], HAEMOGLOBIN.delta_beta(20.0))
    return simulate(scene, Exposures.of(poses(2, (35, 41), 3, PITCH), 20.0, 0.05, 0.0))


def torus(rows: int) -> SurfaceMesh:
    """Of regular triangles, [pixels]: every vertex has six neighbours."""
    i, j = np.meshgrid(np.arange(2 * rows), np.arange(rows), indexing="ij")
    u, v = np.pi * (i + 0.5 * j) / rows, 2 * np.pi * j / rows
    away = 20 + 9 * np.cos(v)
    points = np.stack([away * np.cos(u), away * np.sin(u), 9 * np.sin(v)], axis=-1).reshape(-1, 3)

    def at(right: int, up: int) -> np.ndarray:
        """Rows are shifted by half a column each, and by `rows` / 2 of them all around."""
        turned = np.where(j + up >= rows, i + right + rows // 2, i + right)
        return (turned % (2 * rows) * rows + (j + up) % rows).ravel()

    faces = np.concatenate([np.stack(f, 1) for f in ((at(0, 0), at(1, 0), at(0, 1)), (at(1, 0), at(1, 1), at(0, 1)))])
    return surfaces(TriangleMesh(points, faces), unit=PITCH)


def mean_edge(mesh: SurfaceMesh) -> float:
    return float(edge_lengths(mesh.vertices, mesh.faces).mean())


def test_small_triangles_stay_as_they_are():
    """To the last bit, and large ones count by powers of their edges."""
    small, large, usual = surfaces(bumpy(3, 6.0)), surfaces(bumpy(1, 9.0)), SurfaceFit(objective=Objective(bending=2.0))
    assert mean_edge(small) < 1
    assert softened(usual, small, 1.0) == usual
    found, longer = softened(usual, large, 1.5), mean_edge(large) / 1.5
    assert longer > 2
    assert found.stiffness == pytest.approx(usual.stiffness / longer**2)
    assert found.objective.bending == pytest.approx(2.0 / longer**6)
    assert replace(found, stiffness=usual.stiffness, objective=usual.objective) == usual


def test_fits_near_their_end_are_softened():
    how, large = CoarseToFine(), surfaces(bumpy(1, 9.0))
    soft = softened(SurfaceFit(), large, how.near_edge)
    for make, steps in ((how.nearby, how.last_steps), (how.between, how.finer_steps)):
        fit = make(SurfaceFit(), large)
        assert (fit.stiffness, fit.objective) == (soft.stiffness, soft.objective)
        assert (fit.rate, fit.schedule.steps) == (how.near_rate, steps)


@pytest.mark.parametrize(("edge", "ratio"), [(1.0, 1.0), (BY_EDGES, 64.0)])
def test_a_body_is_as_bent_on_large_triangles_as_on_small_ones(scan, edge, ratio):
    """Counted by edges alone it is 64 times as bent on triangles twice as large."""
    values = []
    for rows in (20, 40):
        start = torus(rows)
        assert mean_edge(start) > 1
        fit = surface_fit(scan, start, softened(SurfaceFit(), start, edge))
        (bending,) = (term for term in fit.plan.problem.terms if isinstance(term, Bending))
        (part,) = bending(fit.model, None)  # type: ignore[arg-type]
        assert part.weight is not None
        values.append(part.weight * float(part.value.detach()))
    assert values[0] / values[1] == pytest.approx(ratio, rel=0.1)


@pytest.mark.parametrize(("edge", "ratio"), [(1.0, 1.0), (BY_EDGES, 4.0)])
def test_a_vertex_draws_along_what_is_as_near_in_pixels(edge, ratio):
    """The mean square of the distance in what a pull at one vertex moves, on triangles of two sizes."""
    reach = []
    for subdivisions in (4, 5):
        start = surfaces(bumpy(subdivisions, 40.0, depth=0.0), unit=PITCH)
        pull = torch.zeros_like(start.vertices)
        pull[0] = 1.0
        moved = _membrane(start, softened(SurfaceFit(), start, edge).stiffness)(pull)[:, 0]
        away = (start.vertices - start.vertices[0]).square().sum(1)
        reach.append(float((moved * away).sum() / moved.sum()))
    assert reach[0] / reach[1] == pytest.approx(ratio, rel=0.15)
