"""Cells in a channel: Poiseuille's flow, regularised Stokeslets, contacts, steps in time, and all of it together."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.specimens.flow.suspension import (
    BLOB,
    Channel,
    Medium,
    Repulsion,
    State,
    Stepper,
    Suspension,
    contact_forces,
    mutual_velocity,
    one_way_velocity,
    wall_forces,
)
from holosplat.specimens.membrane.model import Membrane
from holosplat.specimens.membrane.rest import geodesic_sphere, resting_cell

BOXES = ((80e-6, 34e-6, 26e-6), (50e-6, 17e-6, 31e-6), (20e-6, 20e-6, 20e-6))
MIDDLE = torch.tensor([40e-6, 17e-6, 13e-6], dtype=torch.float64)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("box", BOXES)
def test_poiseuille_in_a_rectangle(box):
    """Nothing slips, Stokes' equation μ∇²u = -G holds, and the flow rate is the integral."""
    channel = Channel(box, 0.03)
    across = random(200, 3) * torch.tensor(box)
    for axis in (1, 2):
        for wall in (0.0, box[axis]):
            at_wall = across.clone()
            at_wall[:, axis] = wall
            assert float(channel.speed(at_wall).abs().max()) < 1e-4 * 0.03
    inside = (0.15 + 0.7 * random(50, 3)) * torch.tensor(box)
    step, laplacian = 2e-8, 0.0
    for axis in (1, 2):
        way = step * torch.eye(3, dtype=torch.float64)[axis]
        laplacian = laplacian + channel.speed(inside + way) + channel.speed(inside - way) - 2 * channel.speed(inside)
    assert torch.allclose(-laplacian / step**2, torch.full((50,), channel.pressure_gradient(1.0)).double(), rtol=1e-3)
    y, z = (((np.arange(n) + 0.5) / n) * extent for n, extent in ((301, box[1]), (299, box[2])))
    grid = np.stack(np.meshgrid([0.0], y, z, indexing="ij"), -1)
    mean = float(channel.speed(torch.from_numpy(grid)).mean())
    assert mean == pytest.approx(channel.flow_rate() / (box[1] * box[2]), rel=1e-4)


def test_known_channels():
    square = Channel((1e-3, 1e-4, 1e-4), 1.0)
    # White (2006), table 3-1: peak 2.0963 of the mean
    assert square.flow_rate() / 1e-8 == pytest.approx(0.4770, abs=2e-4)
    plane = Channel((1e-3, 1e-2, 1e-4), 1.0)
    z = torch.linspace(0, 1e-4, 11, dtype=torch.float64)
    points = torch.stack([torch.zeros_like(z), torch.full_like(z, 5e-3), z], -1)
    assert torch.allclose(plane.speed(points), 1 - (z / 5e-5 - 1) ** 2, atol=1e-9)
    assert plane.velocity(points)[:, 1:].abs().max() == 0
    behind = torch.tensor([[0.0, -1e-6, 5e-5], [0.0, 5e-3, 2e-4]]).double()
    assert plane.speed(behind).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("box", "peak", "said"),
    [((1e-4, 1e-4, 3.0), 0.1, "box extent z"), ((1e-4, 1e-4), 0.1, "three extents"), ((1e-4,) * 3, -1.0, "peak")],
)
def test_channels_that_are_refused(box, peak, said):
    with pytest.raises(InputError, match=said):
        Channel(box, peak)


def test_a_ball_of_stokeslets_drags_as_stokes_says():
    """F = 6πμRU, with the blob in proportion to the nodes' spacing, at several resolutions."""
    for frequency in (4, 6, 9):
        ball, _ = geodesic_sphere(frequency)
        nodes = torch.from_numpy(2e-6 * ball)
        forces = torch.tensor([1e-12, 0, 0]).double().expand(len(nodes), 3) / len(nodes)
        blob = BLOB * math.sqrt(4 * math.pi * 4e-12 / len(nodes))
        speed = one_way_velocity(nodes, nodes, forces, blob).mean(0) / (8 * math.pi * 1e-3)
        assert float(speed[0]) == pytest.approx(1e-12 / (6 * math.pi * 1e-3 * 2e-6), rel=5e-3)
        assert float(speed[1:].abs().max()) < 1e-3 * float(speed[0])


def test_the_blob_vanishes_far_away():
    """Against the singular Stokeslet (f + (f·r) r/r²)/(8πμr): the error falls with ε²."""
    source, force = torch.zeros(1, 3).double(), torch.tensor([[1.0, 2.0, -0.5]]).double()
    target = torch.tensor([[3.0, -1.0, 2.0]]).double()
    r = target.norm()
    exact = (force + (force * target).sum() * target / r**2) / r
    errors = [float((one_way_velocity(target, source, force, e) - exact).norm()) for e in (0.2, 0.1)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)
    assert errors[1] < 1e-3 * float(exact.norm())


def test_the_velocity_has_no_divergence():
    sources, forces, target = random(7, 3), random(7, 3, seed=1) - 0.5, random(3, seed=2)
    jacobian = torch.autograd.functional.jacobian(lambda x: one_way_velocity(x[None], sources, forces, 0.2)[0], target)
    assert isinstance(jacobian, torch.Tensor)
    assert abs(float(torch.trace(jacobian))) < 1e-12 * float(jacobian.abs().sum())


def test_both_ways_at_once():
    first, second = 5 * random(549, 3), 5 * random(41, 3, seed=1) + 1
    f, g = random(549, 3, seed=2) - 0.5, random(41, 3, seed=3) - 0.5
    on_first, on_second = mutual_velocity(first, second, (f, g), 0.3)
    assert torch.allclose(on_first, one_way_velocity(first, second, g, 0.3))
    assert torch.allclose(on_second, one_way_velocity(second, first, f, 0.3))
    r = (first[-1] - second).double()
    s = (r**2).sum(-1, keepdim=True) + 0.09
    plain = (g * (s + 0.09) + (g * r).sum(-1, keepdim=True) * r) / s**1.5
    assert torch.allclose(on_first[-1], plain.sum(0))


def test_pairs_of_cells_in_parts_are_all_of_them(monkeypatch):
    """Velocities do not depend on how many pairs of nodes are taken at once; cells touch across the channel's ends."""
    membrane = Membrane(resting_cell(3))
    suspension = Suspension(membrane, Channel((20e-6, 19e-6, 23e-6), 0.05))
    nodes = torch.from_numpy(membrane.mesh.vertices.copy()) + 1e-6 * torch.tensor(
        [[[1.0, 9.0, 11.0]], [[12.0, 8.0, 8.0]], [[19.5, 9.0, 13.9]]]
    )
    whole = suspension.velocity(nodes)
    monkeypatch.setattr("holosplat.specimens.flow.suspension.pairs_at_a_time", lambda device: 1)
    monkeypatch.setattr("holosplat.specimens.flow.suspension.pairs_at_a_time", lambda device: 1)
    assert torch.allclose(suspension.velocity(nodes), whole, rtol=1e-12, atol=1e-16)
    assert contact_forces(nodes, suspension.channel, suspension.repulsion)[[0, 2]].abs().max() > 0


def test_repulsion_is_the_energys_slope_and_ends_smoothly():
    repulsion = Repulsion(2e-11, 0.6e-6)
    distance = (torch.tensor([-0.1, 0.01, 0.1, 0.3, 0.59, 0.61]).double() * 1e-6).requires_grad_()
    (slope,) = torch.autograd.grad(repulsion.energy(distance).sum(), distance)
    assert torch.allclose(-slope, repulsion.force(distance).detach(), rtol=1e-9, atol=1e-24)
    assert float(repulsion.force(torch.tensor(0.3e-6))) == pytest.approx(2e-11)
    assert float(repulsion.force(torch.tensor(0.6e-6))) == 0


def test_contacts_across_the_periodic_ends():
    channel, repulsion = Channel(BOXES[0], 0.05), Repulsion(2e-11, 1e-6)
    nodes = torch.tensor([[[79.8, 17, 13], [79.8, 17.1, 13]], [[80.3, 17, 13], [40, 3, 3]]]).double() * 1e-6
    forces = contact_forces(nodes, channel, repulsion)
    assert float(forces[0, 0, 0]) == pytest.approx(-float(repulsion.force(torch.tensor(0.5e-6).double())), rel=1e-6)
    assert float(forces.sum((0, 1)).abs().max()) < 1e-24
    assert float(forces[1, 1].abs().max()) == 0
    shifted = nodes + torch.tensor([[[80e-6, 0, 0]], [[0.0, 0, 0]]], dtype=torch.float64)
    assert torch.allclose(contact_forces(shifted, channel, repulsion), forces, rtol=1e-6, atol=1e-20)
    assert float(contact_forces(nodes[:1], channel, repulsion).abs().max()) == 0  # not within a cell


def test_walls_push_inwards():
    channel, repulsion = Channel(BOXES[0], 0.05), Repulsion(2e-11, 1e-6)
    nodes = torch.tensor([[5, 0.5, 13], [5, 33.5, 25.5], [5, 17, 13], [5, -3, 13]]).double() * 1e-6
    forces = wall_forces(nodes, channel, repulsion)
    assert torch.allclose(forces[0], torch.tensor([0, 2e-11, 0]).double(), rtol=1e-6)
    assert torch.allclose(forces[1], torch.tensor([0, -2e-11, -2e-11]).double(), rtol=1e-6)
    assert float(forces[2].abs().max()) == 0
    assert float(forces[3, 1]) > 1e-9


def suspension(**options: float) -> Suspension:
    return Suspension(Membrane(resting_cell(3)), Channel(BOXES[0], 0.05), Medium(**options))


def test_a_resting_cell_feels_the_mean_flow():
    """No force yet: every node goes with the fluid, and a cell of no size would go with it at its centre."""
    system = suspension()
    nodes = (torch.from_numpy(system.membrane.mesh.vertices.copy()) + MIDDLE)[None]
    found = system.velocity(nodes)
    assert torch.allclose(found, system.channel.velocity(nodes), rtol=1e-6, atol=1e-9)
    assert float(found[..., 0].mean()) == pytest.approx(0.05, rel=0.06)


def test_cells_act_on_each_other_alike_wherever_they_are():
    """A period along x changes nothing; nor does the order of the cells; beyond reach they are alone."""
    system = suspension()
    rest = torch.from_numpy(system.membrane.mesh.vertices.copy())
    pair = torch.stack([1.1 * rest + MIDDLE, 1.05 * rest + MIDDLE + torch.tensor([9e-6, 2e-6, 0])])
    found = system.velocity(pair)
    alone = torch.cat([system.velocity(pair[:1]), system.velocity(pair[1:])])
    assert float((found - alone).abs().max()) > 1e-6  # m/s: they do act
    shifted = pair + torch.tensor([[[-80e-6, 0, 0]], [[160e-6, 0, 0]]], dtype=torch.float64)
    assert torch.allclose(system.velocity(shifted), found, rtol=1e-6, atol=1e-9)
    assert torch.allclose(system.velocity(pair.flip(0)), found.flip(0), rtol=1e-9, atol=1e-12)
    far = pair.clone()
    far[1, :, 0] += 30e-6
    assert torch.allclose(system.velocity(far)[0], alone[0], rtol=1e-9, atol=1e-12)  # beyond reach


def test_reach_and_numbers_that_are_refused():
    with pytest.raises(InputError, match="reach must lie between 0 and half the channel's length"):
        suspension(reach=50e-6)
    with pytest.raises(InputError, match="viscosity"):
        suspension(viscosity=-1.0)
    with pytest.raises(InputError, match="repulsion range"):
        suspension(repulsion_range=0.0)


def test_steps_keep_to_their_tolerance():
    """Nodes on circles: the error falls with the tolerance as a third-order method's does, T^(2/3) steps fewer."""
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]).double()
    start = torch.tensor([[[1.0, 0, 0.3]]]).double()
    exact = torch.tensor([[[math.cos(3), math.sin(3), 0.3]]]).double()
    errors, steps = [], []
    for tolerance in (1e-5, 1e-8):
        state = Stepper(lambda x: x @ turn.T, tolerance).advance(State(start, 0.0, 0.1), 3.0)
        errors.append(float((state.nodes - exact).norm()))
        steps.append(state.taken)
        assert state.time == 3.0
    assert errors[0] < 1e-3
    assert steps[1] / steps[0] == pytest.approx(10, rel=0.3)  # error of a step ∝ step³
    assert errors[0] / errors[1] > 50


def test_stiff_motion_stays_stable_and_wild_motion_stops():
    """Fast decay, a thousand times the time in which it decays: steps as long as stability lets, no longer."""
    start = torch.ones(1, 2, 3).double()
    state = Stepper(lambda x: -1e3 * x, 1e-6).advance(State(start, 0.0, 0.5), 1.0)
    assert float(state.nodes.abs().max()) < 1e-5
    assert 200 < state.taken < 2000
    with pytest.raises(InputError, match="motion must be smooth"):
        Stepper(lambda x: torch.where(x > 0.5, x / 0, x), 1e-6).advance(State(start, 0.0, 0.1), 1.0)
    with pytest.raises(InputError, match="must lie ahead"):
        Stepper(lambda x: x, 1e-6).advance(State(start, 1.0, 0.1), 0.5)


def test_a_cell_drifts_deforms_and_keeps_its_volume():
    """Off the axis a cell is sheared, falls behind the fluid at its centre (by Faxén's a²/6 ∇²u or so), and keeps."""
    system = suspension()
    rest = torch.from_numpy(system.membrane.mesh.vertices.copy())
    start = (rest[:, [2, 0, 1]] + MIDDLE + torch.tensor([0, 5e-6, 0]))[None]
    until = 1e-4
    stepper = Stepper(system.velocity, 1e-9)
    state = stepper.advance(State(start, 0.0, 1e-7), until)
    drift = float((state.nodes - start)[..., 0].mean()) / until
    centre = float(system.channel.speed(start.mean(1))[0])
    assert 0.92 * centre < drift < centre
    membrane = system.membrane
    assert abs(float(membrane.volume(state.nodes)[0] / membrane.rest.volume) - 1) < 0.01
    assert abs(float(membrane.surface(state.nodes)[0] / membrane.rest.surface) - 1) < 0.05
    half = stepper.advance(stepper.advance(State(start, 0.0, 1e-7), 0.5 * until), until)
    assert float((half.nodes - state.nodes).abs().max()) < 2e-8
