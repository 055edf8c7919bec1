"""Flows without divergence, and Gaussians that they carry: closed forms, orders of convergence, gradients, files."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io.objects import read_object, write_object
from holosplat.matter import Matter
from holosplat.projectors.splat.reference import rotation_matrices
from holosplat.representations import Flow, GaussianCloud, Lattice, MovingGaussians, TimeBasis
from holosplat.representations.moving_gaussians import principal_axes, quaternions_of

LATTICE = Lattice.around((40.0, 26.0, 32.0), 4)
BASIS = TimeBasis(1.0, 3.0, 2)


def random_flow(seed: int = 0, sources: bool = False, size: float = 30.0) -> Flow:
    torch.manual_seed(seed)
    potential = size * torch.randn(3, 3, *LATTICE.counts, dtype=torch.float64)
    return Flow(potential, LATTICE, BASIS, 2.0, 8, potential[:, 0].flip(0).contiguous() if sources else None)


def points(count: int = 30) -> Tensor:
    torch.manual_seed(5)
    return 12 * torch.rand(count, 3, dtype=torch.float64) - 6


def linear_flow(matrix: Tensor) -> Flow:
    """v = M x, M without trace: `A = (M x) × x / 3`, as `∇ × ((M x) × x) = 3 M x` then; splines hold it, their
    coefficients being its values less the mean of a cell, which are constant where A is a square."""
    nodes = LATTICE.nodes()
    potential = torch.linalg.cross(nodes @ matrix.T, nodes) / 3
    z, y, x = LATTICE.counts
    values = potential.reshape(x, y, z, 3).permute(3, 2, 1, 0)[None]
    return Flow(values.contiguous(), LATTICE, TimeBasis(1.0, 3.0, 0), 2.0, 16)


def cloud(count: int = 6, dtype: torch.dtype = torch.float64) -> GaussianCloud:
    torch.manual_seed(2)
    arrays = (
        8 * torch.rand(count, 3) - 4,
        0.4 * torch.randn(count, 3) + 0.6,
        torch.randn(count, 4),
        torch.randn(count, 1),
    )
    return GaussianCloud([a.to(dtype) for a in arrays], 1e-6, Matter.one(2e-7, 1e-9))


def covariance(of: GaussianCloud) -> Tensor:
    axes = rotation_matrices(of.quaternions) * of.scales[:, None]
    return axes @ axes.mT


def test_the_divergence_is_zero_to_rounding_and_derivatives_are_those_of_the_velocity():
    flow, at, step = random_flow(), points(), 1e-5
    gradient = flow.gradient(at, 2.3)
    assert float(gradient.diagonal(dim1=1, dim2=2).sum(1).abs().max()) < 1e-15
    moves = step * torch.eye(3, dtype=torch.float64)
    numbers = [(flow.velocity(at + d, 2.3) - flow.velocity(at - d, 2.3)) / (2 * step) for d in moves]
    assert torch.allclose(torch.stack(numbers, -1), gradient, atol=1e-8)
    assert float(gradient.abs().max()) > 0.05


def test_sources_have_a_divergence():
    flow = random_flow(sources=True)
    assert float(flow.gradient(points(), 2.3).diagonal(dim1=1, dim2=2).sum(1).abs().max()) > 0.01


@pytest.mark.parametrize("what", ["volume", "way back"])
def test_volumes_are_kept_to_the_order_of_the_steps(what):
    at, errors = points(), []
    for steps in (2, 4, 8):
        flow = replace(random_flow(size=150.0), steps=steps)
        there, turned = flow.carried_with_jacobian(at, 1.0, 3.0)
        wrong = torch.linalg.det(turned) - 1 if what == "volume" else flow.carried(there, 3.0, 1.0) - at
        errors.append(float(wrong.abs().max()))
    assert errors[0] > 1e-6
    for coarse, fine in pairwise(errors):
        assert fine < coarse / 2**3.5


def test_a_linear_flow_moves_gaussians_as_its_exponential_does():
    matrix = torch.tensor([[0.1, 0.3, -0.2], [-0.4, -0.3, 0.1], [0.2, 0.1, 0.2]], dtype=torch.float64)
    moving, time = MovingGaussians(cloud(), linear_flow(matrix)), 2.7
    part = (time - 2.0) / 2.0
    f = torch.linalg.matrix_exp(part * matrix)
    found, before = moving.at(time), moving.cloud
    assert torch.allclose(found.centres, before.centres @ f.T, atol=1e-6)
    assert torch.allclose(covariance(found), f @ covariance(before) @ f.T, rtol=1e-5, atol=1e-6)
    assert torch.equal(found.raw_amplitudes, before.raw_amplitudes)
    volumes = [float(one.scales.prod(1).sum()) for one in (found, before)]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-6)


def test_amplitudes_change_as_fading_says():
    fading = torch.tensor([[0.5] * 6, [0.1] * 6], dtype=torch.float64)
    moving = MovingGaussians(cloud(), random_flow(), fading)
    later = moving.at(3.0).raw_amplitudes - moving.cloud.raw_amplitudes
    assert torch.allclose(later, torch.full((6, 1), 0.5 * 0.5 + 0.25 * 0.1, dtype=torch.float64))
    assert moving.at(2.0) is moving.cloud


def test_axes_and_quaternions_are_those_of_the_covariance():
    torch.manual_seed(1)
    shapes = torch.randn(50, 3, 3, dtype=torch.float64)
    logs, quaternions = principal_axes(shapes)
    axes = rotation_matrices(quaternions) * logs.exp()[:, None]
    assert torch.allclose(axes @ axes.mT, shapes @ shapes.mT, atol=1e-12)
    turns = rotation_matrices(torch.randn(50, 4, dtype=torch.float64))
    assert torch.allclose(rotation_matrices(quaternions_of(turns)), turns, atol=1e-12)


def test_gradients_are_those_of_finite_differences():
    """Of every parameter, through shapes, centres and amplitudes of a later time."""
    views = Views.from_angles([0.0, 50.0], (11, 13), 1e-6)
    start = MovingGaussians(cloud(3).on("reference"), random_flow(), 0.1 * torch.ones(2, 3, dtype=torch.float64))
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 1, 11, 13)))

    def value(parameters: dict[str, Tensor]) -> Tensor:
        return (start.with_parameters(parameters).at(2.8).thickness(views) * weights).sum()

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in start.parameters().items()}
    value(leaves).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        torch.manual_seed(7)
        way = torch.randn_like(leaf)
        step = 1e-5 / float(way.abs().max())
        with torch.no_grad():
            ends = [float(value({**leaves, name: leaf + s * step * way})) for s in (1, -1)]
        assert float((leaf.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-4, abs=1e-7)


@pytest.mark.parametrize("sources", [False, True])
def test_files_hold_moving_gaussians(sources, tmp_path):
    flow = random_flow(sources=sources)
    flow = flow.with_parameters({name: tensor.float() for name, tensor in flow.parameters().items()})
    written = MovingGaussians(cloud(dtype=torch.float32), flow, 0.1 * torch.ones(2, 6))
    write_object(tmp_path / "object.h5", written)
    found = read_object(tmp_path / "object.h5")
    assert isinstance(found, MovingGaussians)
    grid = Grid.centred((9, 11, 13), 1e-6)
    for time in (1.0, 2.35):
        assert np.array_equal(found.at(time).voxelise(grid).delta, written.at(time).voxelise(grid).delta)
    assert (
        found.described == written.described == "6 Gaussians carried by a flow of 7 × 6 × 7 nodes and degree 2 in time"
    )


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="potential of a flow"):
        Flow(torch.zeros(1, 3, 4, 4, 4), LATTICE, BASIS, 2.0)
    with pytest.raises(InputError, match="fading must have the shape"):
        MovingGaussians(cloud(), random_flow(), torch.zeros(2, 5))
