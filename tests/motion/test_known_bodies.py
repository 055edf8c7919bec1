"""Bodies of known rest shape: what strains cost, and poses found by two beams, on a raster of odd sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.motion_shadows import FLOW, OTHER, RADIUS, TURN, cell, pose, shadows
from holosplat.bodies.rest_shape import KnownBody, centroid
from holosplat.checks import InputError
from holosplat.cli.track import BodyFlags
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.motion.elastic import Elastic, RestShapeKept, strain_energy
from holosplat.motion.known import drift, poses_like
from holosplat.motion.track import TrackOptions, follow
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshSeries


def test_strain_costs_nothing_at_rest_in_any_pose_and_of_any_size():
    rest = cell()
    moved = torch.from_numpy(rest.vertices @ TURN.T + 7.0)
    longer = torch.from_numpy(rest.vertices * np.array([1.3, 1.0, 1 / 1.3]))
    assert float(Elastic(rest)(moved)) == pytest.approx(0, abs=1e-12)
    costs = [Elastic(replace(rest, vertices=s * rest.vertices))(s * longer) for s in (1.0, 3.0)]
    assert float(costs[0]) > 0.05
    assert float(costs[1]) == pytest.approx(float(costs[0]), rel=1e-9)


def test_a_strained_sheet_costs_what_skalak_says():
    """A ball blown up by a factor s: I₁ = 2(s² - 1), I₂ = s⁴ - 1, and its area by s²; nothing bends."""
    sphere, faces = icosphere(2)
    s, nodes = 1.1, torch.from_numpy(1.1 * sphere)
    first, second = 2 * (s**2 - 1), s**4 - 1
    skalak = 0.25 * (first**2 + 2 * first - 2 * second + second**2)
    whole = 0.5 * 345 * (s**2 - 1) ** 2
    assert float(Elastic(TriangleMesh(sphere, faces))(nodes)) == pytest.approx(skalak + whole, rel=1e-6)


def test_the_term_is_the_mean_over_times_and_its_gradient_is_right():
    rest, basis = cell(), TimeBasis(0.0, 2.0, 1)
    nodes = [rest.vertices * np.array([1.0 + 0.1 * k, 1.0, 1.0]) for k in range(2)]
    paths = [np.stack([one, 1.1 * one]) for one in nodes]
    bodies = MovingSurfaces.of_bodies(paths, [rest.faces] * 2, basis, 1.0, Matter.one(1e-7, 0.0))
    elastic = Elastic(rest)
    term = RestShapeKept(2.0, elastic, bodies)

    class Fake:
        def __init__(self, values):
            self.values = values

        def parameters(self):
            return {"object.coefficients": self.values}

    values = bodies.coefficients.clone().requires_grad_()
    (part,) = term(Fake(values), None)  # type: ignore[arg-type]
    wanted = sum(float(elastic(torch.from_numpy(f * one))) for one in nodes for f in (1.0, 1.05, 1.1)) / 3
    assert float(part.value.detach()) == pytest.approx(wanted)
    part.value.backward()
    way = torch.randn(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ends = [float(term(Fake(values.detach() + e * way), None)[0].value) for e in (1e-5, -1e-5)]  # type: ignore[arg-type]
    assert values.grad is not None
    assert float((values.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)
    with pytest.raises(InputError, match="its triangles"):
        RestShapeKept(1.0, Elastic(TriangleMesh(*icosphere(1))), bodies)


def test_bodies_of_single_times_become_poses():
    """A body that moves and is longer along one axis than at rest; lengths in pixels of 2 µm."""
    longer = np.diag([1.5, 1.0, 1 / 1.5])
    nodes = 2e-6 * (cell().vertices @ longer.T @ TURN.T)
    paths = np.stack([nodes + 2e-6 * np.array([3.0, 1.0, 0.0]), 2e-6 * FLOW + 0 * nodes])
    basis = TimeBasis(0.0, 4.0, 1)
    when = np.linspace(0, 4, 8)
    dense = np.array([paths[0] + (t / 2 - 1) * paths[1] for t in when])
    matter = Matter.one(*HAEMOGLOBIN.delta_beta(20.0))
    bodies = MovingSurfaces.of_bodies([basis.fitted(when, dense)], [cell().faces], basis, 2e-6, matter)
    (found,) = poses_like(bodies, cell(), (0.0, 4.0), 2e-6)
    np.testing.assert_allclose(found.centre, [3.0, 1.0, 0.0], atol=0.01)
    np.testing.assert_allclose(found.velocity, FLOW, atol=0.01)
    np.testing.assert_allclose(found.matrix @ found.matrix.T, TURN @ longer @ longer.T @ TURN.T, atol=0.02)


def test_matter_drifts_where_shadows_go():
    found = drift(shadows([pose(TURN, (3.0, 2.0, -2.5)), pose(OTHER, (-5.0, -3.0, 2.0))]))
    assert found == pytest.approx(FLOW, abs=0.6)


def test_flags_name_a_body():
    assert BodyFlags().known() is None
    assert BodyFlags(body="red-cell", body_size=8e-6).known() == KnownBody(size=8e-6)


def test_two_beams_follow_a_cell_of_known_shape():
    """From frames to a path: the cell's centre at all times, to a third of a pixel after a few steps."""
    size, speed, times = 3.91e-6 / RADIUS, np.array([0.0, 1.5, 0.0]), np.array([0.0, 1e-5, 2e-5])
    material = HAEMOGLOBIN.delta_beta(20.0)
    mesh = KnownBody().mesh(size, coarse=True)
    centres = size * (np.array([2.0, -1.0, -3.0]) + np.arange(3)[:, None] * speed)
    moved = [TriangleMesh(size * mesh.vertices @ TURN.T + centre, mesh.faces, "cell") for centre in centres]
    truth = MeshSeries(tuple(hs.MeshScene.of_one_material([one], material) for one in moved), times)
    views = hs.Views.from_angles([0.0, 70.0], (37, 31), size)
    exposures = hs.Exposures.of(views, 20.0, 0.3).repeated(times)
    scan = hs.simulate(truth, exposures, photons_per_pixel=3000, seed=1, is_test=np.zeros(6, dtype=bool))
    options = replace(TrackOptions(body=KnownBody(instants=3), rounds=0, intervals=False).with_effort(0.05))
    result = follow(scan, material, options)
    found = result.bodies
    assert found.count == 1
    assert result.rest is not None
    assert np.ptp(result.rest.vertices, axis=0).max() == pytest.approx(7.82e-6, rel=0.1)
    energies = strain_energy(found, times, result.rest)  # next to nothing beside shear modulus times area, 3.9e-16 J
    assert (energies >= 0).all()
    assert (energies < 1e-16).all()
    for time, centre in zip(times, centres):
        assert np.linalg.norm(centroid(found.bodies(float(time))[0]) - centre) < 0.33 * size
    empty = replace(scan, frames=1 + 0.01 * np.random.default_rng(0).normal(size=scan.frames.shape))
    with pytest.raises(InputError, match="no body of the shape"):
        follow(empty, material, options)
