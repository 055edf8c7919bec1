"""Membranes: energies in closed form and against finite differences, forces by hand, meshes, optical tweezers."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from holosplat.checks import InputError
from holosplat.mesh import TriangleMesh
from holosplat.specimens.membrane import model
from holosplat.specimens.membrane.model import Elasticity, Membrane
from holosplat.specimens.membrane.rest import (
    RestShape,
    geodesic_sphere,
    resting_cell,
)
from holosplat.specimens.red_cells import RedCell, icosphere

NOTHING = Elasticity(**{field.name: 0.0 for field in fields(Elasticity)})
MODULI = {
    "stretching": {"springs": 1e-5},
    "linear stretching": {"linear_springs": 1e-5},
    "skalak": {"skalak_shear": 3e-6, "skalak_dilation": 2.0},
    "bending": {"bending": 3e-19},
    "local area": {"local_area": 1e-5},
    "global area": {"global_area": 1e-3},
    "volume": {"volume": 1e3},
}
RADIUS = 3e-6


def only(name: str) -> Elasticity:
    return replace(NOTHING, **MODULI[name])


def sphere(frequency: int = 4) -> TriangleMesh:
    vertices, faces = geodesic_sphere(frequency)
    return TriangleMesh(RADIUS * vertices, faces)


def crumpled(membrane: Membrane, cells: int = 2) -> torch.Tensor:
    """Cells stretched unevenly, their nodes moved at random."""
    noise = torch.randn(cells, *membrane.mesh.vertices.shape, generator=torch.Generator().manual_seed(1))
    unevenly = torch.tensor([1.2, 0.85, 1.1], dtype=torch.float64)
    return torch.from_numpy(membrane.mesh.vertices.copy()) * unevenly + 5e-8 * noise.double()


@pytest.mark.parametrize("name", MODULI)
def test_forces_are_the_energys_gradient(name):
    """By hand, by differentiation, and by central differences along a random direction."""
    membrane = Membrane(resting_cell(4), only(name))
    nodes = crumpled(membrane).requires_grad_()
    assert list(membrane.energies(nodes)) == [name]
    (gradient,) = torch.autograd.grad(membrane.energy(nodes).sum(), nodes)
    nodes = nodes.detach()
    forces = membrane.forces(nodes)
    assert float((forces + gradient).abs().max() / gradient.abs().max()) < 1e-12
    way = torch.randn(nodes.shape, generator=torch.Generator().manual_seed(2)).double()
    step = 1e-12
    ahead, behind = (membrane.energy(nodes + sign * step * way) for sign in (1, -1))
    slope = (ahead - behind) / (2 * step)
    assert torch.allclose(slope, -(forces * way).sum((-2, -1)), rtol=2e-6)


@pytest.mark.parametrize("name", MODULI)
def test_a_cell_neither_pushes_nor_turns_itself(name):
    membrane = Membrane(resting_cell(4), only(name))
    nodes = crumpled(membrane)
    forces = membrane.forces(nodes)
    scale = float(forces.abs().sum())
    assert float(forces.sum(1).abs().max()) < 1e-12 * scale
    assert float(torch.linalg.cross(nodes, forces).sum(1).abs().max()) < 1e-11 * scale * RADIUS


def test_nothing_pulls_at_rest_wherever_the_cell_is():
    membrane = Membrane(resting_cell(4), Elasticity(springs=1e-5, linear_springs=1e-5, local_area=1e-5))
    turn, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    nodes = torch.from_numpy(membrane.mesh.vertices @ turn.T + 1e-4)
    strained = float(membrane.forces(1.01 * nodes).abs().max())
    assert float(membrane.forces(nodes).abs().max()) < 1e-9 * strained
    assert abs(float(membrane.energy(nodes))) < 1e-12 * float(membrane.energy(1.01 * nodes))


@pytest.mark.parametrize("ratio", [0.6, 0.97, 1.0, 1.3, 2.5])
def test_energies_of_a_sphere_blown_up(ratio):
    """Every edge grows by λ, areas by λ², the volume by λ³; angles stay."""
    every = dict.fromkeys((field.name for field in fields(Elasticity)), 1.0) | {"skalak_dilation": 3.0}
    membrane = Membrane(sphere(), Elasticity(**every))
    nodes, rest = ratio * torch.from_numpy(membrane.mesh.vertices.copy()), membrane.rest
    surface, volume, square = float(rest.surface), float(rest.volume), float((rest.length**2).sum())
    one, two = 2 * (ratio**2 - 1), ratio**4 - 1

    def kappa(s: float) -> float:
        return (s**0.5 + s**-2.5) / (s + s**-3)

    wanted = {
        "stretching": square * quad(lambda s: kappa(s) * (s - 1), 1, ratio)[0],
        "linear stretching": square * 0.5 * (ratio - 1) ** 2,
        "local area": surface * 0.5 * (ratio**2 - 1) ** 2,
        "global area": surface * 0.5 * (ratio**2 - 1) ** 2,
        "volume": volume * 0.5 * (ratio**3 - 1) ** 2,
        "bending": 0.0,
        "skalak": 0.25 * surface * (one**2 + 2 * one - 2 * two + 3.0 * two**2),
    }
    found = {name: float(energy) for name, energy in membrane.energies(nodes).items()}
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-24)


def test_skalaks_shear_modulus():
    """A triangle pulled long and narrow by e keeps its area, and holds 2 G e² for each unit of it, to first order."""
    corner = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]).double()
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    rest = RestShape.of(TriangleMesh(corner.numpy(), faces))
    errors = []
    for e in (2e-2, 1e-2):
        pulled = corner[rest.faces[:1]] * torch.tensor([1 + e, 1 / (1 + e), 1.0]).double()
        gradient = model.deformation_gradient(pulled, replace(rest, frame=rest.frame[:1]))
        one, two = model.strain_invariants(gradient)
        density = 0.25 * (one**2 + 2 * one - 2 * two + 5.0 * two**2)
        errors.append(abs(float(density) / (2 * e**2) - 1))
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.2)


def test_bending_of_a_sphere():
    """Even triangles of side l meet at l/(√3 R): Σ k/2 θ² comes to 4π k/√3, whatever l and R."""
    found = []
    for frequency in (4, 8, 12):
        membrane = Membrane(sphere(frequency), replace(NOTHING, bending=1.0))
        rest = membrane.rest
        membrane.rest = replace(rest, angle=torch.zeros_like(rest.angle))
        found.append(float(membrane.energy(torch.from_numpy(membrane.mesh.vertices.copy()))))
    assert np.allclose(found, 4 * np.pi / 3**0.5, rtol=0.03)
    assert float(rest.angle.min()) > 0  # convex is positive


def test_bending_of_a_triangle_that_has_lost_its_area_stays_finite(monkeypatch):
    """A corner on its way to the opposite edge: the angle's gradient grows as one over the height without end."""
    membrane = Membrane(sphere(2), only("bending"))
    nodes, (a, b, c) = torch.from_numpy(membrane.mesh.vertices.copy()), membrane.mesh.faces[0]
    middle = 0.5 * (nodes[a] + nodes[b])

    def force(height: float) -> float:
        moved = nodes.clone()
        moved[c] = middle + height * (nodes[c] - middle)
        return float(membrane.forces(moved)[c].norm())

    bounded = [force(height) for height in (0.2, 1e-3, 1e-6)]
    assert bounded[2] == pytest.approx(bounded[1], rel=0.05)
    assert bounded[2] < 2 * bounded[0]
    monkeypatch.setattr(model, "THIN", 0.0)
    assert force(0.2) == bounded[0]
    assert force(1e-6) > 1e3 * bounded[2]


def test_float32_and_single_cells():
    membrane = Membrane(resting_cell(4))
    nodes = crumpled(membrane)
    exact = membrane.forces(nodes)
    assert torch.allclose(membrane.forces(nodes[1]), exact[1], rtol=1e-12, atol=1e-24)
    membrane.rest = membrane.rest.to(torch.float32)
    rough = membrane.forces(nodes.float())
    assert rough.dtype == torch.float32
    assert float((rough - exact).abs().max() / exact.abs().max()) < 1e-3


@pytest.mark.parametrize("damage", ["open", "inside out", "one turned", "loose node"])
def test_what_is_no_membrane(damage):
    vertices, faces = icosphere(1)
    if damage == "open":
        faces = faces[1:]
    elif damage == "inside out":
        faces = faces[:, ::-1]
    elif damage == "one turned":
        faces = np.concatenate([faces[:1, ::-1], faces[1:]])
    else:
        vertices = np.concatenate([vertices, [[2.0, 0, 0]]])
    with pytest.raises(InputError, match=r"repair it|loose nodes"):
        Membrane(TriangleMesh(1e-6 * vertices, faces))


@pytest.mark.parametrize("wrong", [{"bending": -1e-19}, {"volume": float("inf")}, {"springs": float("nan")}])
def test_moduli_are_numbers_from_zero_on(wrong):
    with pytest.raises(InputError, match="must"):
        Membrane(resting_cell(3), Elasticity(**wrong))


def test_resting_cells_lie_on_the_smooth_cell_and_are_even():
    volumes = []
    for frequency in (3, 6, 12):
        mesh = resting_cell(frequency)
        assert mesh.vertices.shape == (10 * frequency**2 + 2, 3)
        assert mesh.faces.shape == (20 * frequency**2, 3)
        assert np.allclose(RedCell().level(mesh.vertices), 1, atol=1e-9)
        length = RestShape.of(mesh).length
        assert float(length.max() / length.min()) < 1.6
        volumes.append(mesh.volume)
    assert (volumes[1] - volumes[0]) / (volumes[2] - volumes[1]) == pytest.approx(4, rel=0.15)  # second order
    smooth = volumes[2] + (volumes[2] - volumes[1]) / 3  # Richardson's
    assert smooth == pytest.approx(94e-18, rel=0.01)  # Evans & Fung 1972


@pytest.mark.parametrize("frequency", [2, 21, 6.0, "6"])
def test_resolutions_that_are_refused(frequency):
    with pytest.raises(InputError, match="frequency must be a whole number from 3 to 20"):
        resting_cell(frequency)
