"""The total-variation solver: steps, twins, and what it converges to."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.voxels import ROWS, anyhow, around, randoms
from holosplat.baselines import PrimalDual
from holosplat.baselines.tv_steps import cpu, reference
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.projectors.voxels import (
    LatticeProjector,
    SliceProjector,
    projector_for,
)


def gradient(u: np.ndarray) -> np.ndarray:
    """Forward differences [3, Z, Y, X], zero at the last voxel of each axis."""
    return np.stack([np.diff(u, axis=a, append=u.take([-1], axis=a)) for a in range(3)])


def gradient_adjoint(q: np.ndarray) -> np.ndarray:
    """The transpose of `gradient`, made from its definition voxel by voxel."""
    out = np.zeros(q.shape[1:])
    for a in range(3):
        p, u = np.moveaxis(q[a], a, 0), np.moveaxis(out, a, 0)
        for i in range(len(p) - 1):
            u[i + 1] += p[i]
            u[i] -= p[i]
    return out


SHAPES = [(5, 7, 9), (1, 7, 3), (4, 1, 18), (3, 5, 1), (2, 3, 33)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("steps", [cpu, reference])
def test_ascent_equals_its_float64_twin(shape, threads, steps):
    u, q = randoms(*shape, dtype=torch.float32), randoms(3, *shape, seed=1, dtype=torch.float32)
    q[0, -1] = q[1, :, -1] = q[2, :, :, -1] = 0  # as a solver starts: there is no voxel beyond the last
    moved = q.double().numpy() + 0.5 * gradient(u.double().numpy())
    want = moved / np.maximum(1, np.linalg.norm(moved, axis=0) / 0.8)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    steps.ascend(u, q, 0.5, 0.8)
    torch.set_num_threads(before)
    assert np.abs(q.numpy() - want).max() < 1e-6
    assert np.linalg.norm(q.numpy(), axis=0).max() < 0.8 * (1 + 1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("bounds", [(0.0, 0.7), (0.0, float("inf")), (-0.4, 0.7), (float("-inf"), float("inf"))])
@pytest.mark.parametrize("steps", [cpu, reference])
def test_descent_equals_its_float64_twin(shape, bounds, steps):
    u, slope = (randoms(*shape, seed=s, dtype=torch.float32) for s in (2, 3))
    tau, q = (
        0.1 + randoms(*shape, seed=4, dtype=torch.float32).abs(),
        randoms(3, *shape, seed=5, dtype=torch.float32),
    )
    old, wide = u.double().numpy().copy(), torch.empty_like(u)
    q[0, -1] = q[1, :, -1] = q[2, :, :, -1] = 0  # as ascent keeps them: there is no voxel beyond the last
    a, b, c = (t.double().numpy() for t in (slope, tau, q))
    want = np.clip(old - b * (a + 0.3 * gradient_adjoint(c)), *bounds)
    steps.descend(slope, tau, q, 0.3, bounds, u, wide)
    assert np.abs(u.numpy() - want).max() < 1e-6
    assert np.abs(wide.numpy() - (2 * want - old)).max() < 2e-6
    assert float(u.min()) == pytest.approx(max(bounds[0], want.min()))


def test_the_twins_are_adjoint():
    u, q = np.random.default_rng(0).normal(size=(5, 7, 9)), np.random.default_rng(1).normal(size=(3, 5, 7, 9))
    assert (gradient(u) * q).sum() == pytest.approx((u * gradient_adjoint(q)).sum(), rel=1e-12)


class Identity:
    """A projector that sees the volume itself: the solver then denoises, with solutions known on paper."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.array_shape = shape

    def project(self, array: Tensor) -> Tensor:
        return array.clone()

    backproject = volume_in = volume_out = lines_in = lines_out = project


def solve(images: Tensor, weight: float, upper: float | None = None, coupling=1.0, start=0.0) -> Tensor:
    """The denoised volume after many steps."""
    solver = PrimalDual(Identity(tuple(images.shape)), torch.full_like(images, start), weight, upper, coupling)
    solver.run(images, 600)
    return solver.volume


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("coupling", [1.0, 0.25, 3.0])
def test_a_step_is_denoised_as_on_paper(axis, coupling):
    """Rudin–Osher–Fatemi in one dimension: plateaus of n voxels move by λ/n, each to the other."""
    step = torch.zeros(7)
    step[4:] = 1.0
    shape = [3, 3, 3]
    shape[axis] = 7
    images = (0.5 + step).reshape([-1 if a == axis else 1 for a in range(3)]).expand(shape).contiguous()
    want = 0.5 + 0.3 / 4 + step * (1 - 0.3 / 3 - 0.3 / 4)
    found = solve(images, 0.3, coupling=coupling)
    assert torch.allclose(found.movedim(axis, -1), want.expand(3, 3, 7), atol=1e-4)
    assert torch.allclose(solve(images, 5.0, coupling=coupling), images.mean().expand(shape), atol=1e-3)


def test_the_box_holds():
    """Without total variation every voxel is clamped by itself; with it, the values still stay inside."""
    images = randoms(3, 5, 7, dtype=torch.float32) * 2
    assert torch.allclose(solve(images, 1e-9, upper=1.0), images.clamp(0, 1), atol=1e-4)
    assert torch.allclose(solve(images, 1e-9), images.clamp_min(0), atol=1e-4)
    assert float(solve(images, 0.2, upper=1.0).max()) <= 1


def test_no_weight_is_no_total_variation():
    images = randoms(3, 5, 7, dtype=torch.float32)
    assert torch.allclose(solve(images, 0.0), images.clamp_min(0), atol=1e-4)


def test_steps_are_those_of_the_algorithm():
    """Chambolle & Pock (2011), algorithm 1, in float64, with the preconditioned steps of the solver's docstring."""
    images, weight, coupling, upper = randoms(3, 5, 7, dtype=torch.float32), 0.2, 0.5, 0.9
    solver = PrimalDual(Identity((3, 5, 7)), torch.full_like(images, 0.4), weight, upper, coupling)
    solver.run(images, 6)
    b, u, p, q = images.double().numpy(), np.full(images.shape, 0.4), np.zeros(images.shape), np.zeros((3, 3, 5, 7))
    ahead, tau, radius = u, 1 / (1 + 6 * coupling), weight / coupling
    for _ in range(6):
        p = (p + (ahead - b)) / 2
        q = q + 0.5 * gradient(ahead)
        q = q / np.maximum(1, np.linalg.norm(q, axis=0) / radius)
        fresh = np.clip(u - tau * (p + coupling * gradient_adjoint(q)), 0, upper)
        u, ahead = fresh, 2 * fresh - u
    assert np.abs(solver.volume.numpy() - u).max() < 1e-6


def test_the_solution_does_not_depend_on_the_start():
    images = randoms(3, 5, 7, dtype=torch.float32)
    assert torch.allclose(solve(images, 0.2), solve(images, 0.2, start=3.0), atol=1e-3)


def test_steps_may_be_taken_in_pieces():
    views = around(3, (7, 12))
    images = randoms(3, 7, 12, dtype=torch.float32).abs()
    once, twice = (PrimalDual(SliceProjector(ROWS, views), torch.zeros(ROWS.shape), 0.3, 1.0) for _ in range(2))
    once.run(images, 12)
    twice.run(images, 5)
    twice.run(images, 7)
    assert torch.equal(once.volume, twice.volume)
    assert torch.equal(once.lines(), twice.lines())


def cylinder(grid: Grid) -> Tensor:
    """Occupancy [Z, Y, X] of a short elliptic cylinder inside the grid."""
    x, y, z = grid.axes()
    inside = ((x / 4) ** 2 + (z[:, None, None] / 3) ** 2 < 1) & (np.abs(y[:, None]) < 2)
    return torch.from_numpy(inside).float()


def test_tomography_decreases_its_objective_and_finds_the_object():
    """From 8 exact views of a flat object, with `½‖A u - b‖² + λ Σ|∇u|`; the start is the worst."""
    views, weight = around(8, (9, 15)), 0.02
    grid = Grid.of_views(views)
    truth = cylinder(grid)
    projector = projector_for(grid, views)
    images = projector.lines_out(projector.project(projector.volume_in(truth)))
    solver = PrimalDual(projector, torch.full(grid.shape, 0.3), weight, 1.0)

    def objective(volume: Tensor, lines: Tensor) -> float:
        norms = np.linalg.norm(gradient(volume.double().numpy()), axis=0)
        return 0.5 * float((lines - images).double().square().sum()) + weight * float(norms.sum())

    values = [objective(solver.volume, solver.lines())]
    for steps in (10, 40, 150, 400):
        solver.run(images, steps)
        values.append(objective(solver.volume, solver.lines()))
    assert np.all(np.diff(values) < 0), values
    assert values[-1] < 1.001 * objective(truth, images)  # no worse than the truth, which has no residual
    assert float((solver.volume - truth).abs().mean()) < 0.02
    assert torch.equal(solver.volume > 0.5, truth > 0.5)


def test_tomography_runs_on_views_without_a_common_axis():
    grid, views = Grid.centred((7, 5, 9), 1.0), anyhow(6, (11, 13))
    truth, projector = cylinder(grid), LatticeProjector(grid, views)
    solver = PrimalDual(projector, torch.zeros(grid.shape), 0.02, 1.0)
    solver.run(projector.project(truth), 50)
    assert float((solver.volume - truth).abs().mean()) < 0.02


def test_plain_and_compiled_tomography_agree():
    """The same solver on the same projections, with the compiled kernels and with none of them."""
    views = Views.from_rotations(Rotation.random(3, rng=0).as_matrix(), (9, 8), 1.0)
    grid = Grid.centred((7, 6, 8), 1.0)
    truth = torch.zeros(grid.shape)
    truth[2:5, 2:4, 3:6] = 0.8
    volumes = []
    for backend in ("cpu", "reference"):
        projector = LatticeProjector(grid, views, backend)
        solver = PrimalDual(projector, torch.zeros(grid.shape), 0.05, 1.0, backend=backend)
        solver.run(projector.project(truth), 20)
        volumes.append(solver.volume)
    assert float((volumes[0] - volumes[1]).abs().max()) < 1e-5
    assert float(volumes[0].max()) > 0.3


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_arrays_of_another_shape_are_refused(backend):
    projector = LatticeProjector(Grid.centred((4, 5, 6), 1.0), Views.evenly_spaced(2, (7, 8), 1.0), backend)
    with pytest.raises(InputError, match=r"volume must have the shape \(4, 5, 6\)"):
        projector.project(torch.ones(2, 2, 2))
    with pytest.raises(InputError, match=r"line integrals must have the shape \(2, 7, 8\)"):
        projector.backproject(torch.ones(1, 7, 8))
