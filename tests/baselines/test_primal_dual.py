"""The primal–dual solver: what it finds, and that it finds the minimum."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.baselines import PrimalDual
from holosplat.geometry import Grid, Views
from holosplat.metrics import dice
from holosplat.projectors.voxels import SliceProjector

SIDE, ANGLES = 24, 15
DISCS = ((-3.0, 2.0, 6.0), (6.0, -5.0, 3.0))
"""x, z and radius of each disc [pixels]; the phantom is the same in all slices."""


def disc_views() -> Views:
    return Views.evenly_spaced(ANGLES, (3, SIDE), 1.0)


def disc_lines() -> torch.Tensor:
    """Exact line integrals [V, 3, SIDE] of the discs: chords, averaged over each pixel's width."""
    fine = (np.arange(SIDE * 32) + 0.5) / 32 - SIDE / 2
    lines = np.zeros((ANGLES, fine.size))
    for v, rotation in enumerate(disc_views().rotations):
        for x, z, radius in DISCS:
            middle = (rotation @ [x, 0, z])[0]
            lines[v] += 2 * np.sqrt(np.clip(radius**2 - (fine - middle) ** 2, 0, None))
    return torch.from_numpy(lines.reshape(ANGLES, 1, SIDE, 32).mean(3)).float().repeat(1, 3, 1)


def disc_truth() -> torch.Tensor:
    """Occupancy [SIDE, 3, SIDE] of the discs, averaged over voxels."""
    fine = (np.arange(SIDE * 16) + 0.5) / 16 - SIDE / 2
    inside = np.zeros((fine.size, fine.size))
    for x, z, radius in DISCS:
        inside += (fine[None] - x) ** 2 + (fine[:, None] - z) ** 2 < radius**2
    return torch.from_numpy(inside.reshape(SIDE, 16, SIDE, 16).mean((1, 3))).float()[:, None].repeat(1, 3, 1)


def a_solver(weight: float = 0.1, upper: float | None = 1.0, **options) -> PrimalDual:
    grid = Grid.centred((SIDE, 3, SIDE), 1.0)
    return PrimalDual(SliceProjector(grid, disc_views()), torch.zeros(grid.shape), weight, upper, **options)


def objective(volume: torch.Tensor, lines: torch.Tensor, weight: float) -> float:
    """½‖A u - b‖² + λ Σ|∇u|, with forward differences."""
    u = volume.double().numpy()
    projected = SliceProjector(Grid.centred((SIDE, 3, SIDE), 1.0), disc_views())
    misfit = projected.lines_out(projected.project(projected.volume_in(volume))).double() - lines.double()
    steps = [np.diff(u, axis=i, append=np.take(u, [-1], axis=i)) for i in range(3)]
    return 0.5 * float(misfit.square().sum()) + weight * float(np.sqrt(sum(s**2 for s in steps)).sum())


def test_discs_are_found_from_exact_projections():
    solver, truth = a_solver(), disc_truth()
    solver.run(disc_lines(), 150)
    assert solver.volume.shape == truth.shape
    assert float((solver.volume - truth).norm() / truth.norm()) < 0.12
    assert dice(solver.volume.numpy() > 0.5, truth.numpy() > 0.5) > 0.97
    error = solver.lines() - disc_lines()
    assert float(error.norm() / disc_lines().norm()) < 0.02


def test_the_box_is_kept():
    """Also at every moment on the way, and with measurements that ask for more."""
    solver = a_solver()
    for _ in range(5):
        solver.run(2 * disc_lines() - 1, 8)
        assert float(solver.volume.min()) >= 0
        assert float(solver.volume.max()) <= 1
    assert float(solver.volume.max()) == 1


def test_without_an_upper_bound_values_are_non_negative_only():
    solver = a_solver(upper=None)
    solver.run(3 * disc_lines() - 0.5, 80)
    assert float(solver.volume.min()) == 0
    assert float(solver.volume.max()) > 2.5


def test_the_solution_minimises_the_objective():
    """No worse than the truth, nor than the solution moved towards the truth, smoothed, scaled, or disturbed."""
    weight, lines, noise = 0.4, disc_lines(), torch.Generator().manual_seed(0)
    lines = lines + 0.5 * torch.randn(lines.shape, generator=noise)
    solver = a_solver(weight)
    solver.run(lines, 600)
    best = objective(solver.volume, lines, weight)
    assert best < objective(disc_truth(), lines, weight)
    others = [solver.volume.lerp(disc_truth(), 0.1), 0.99 * solver.volume, torch.ones_like(solver.volume)]
    others += [(solver.volume + 0.02 * torch.randn(solver.volume.shape, generator=noise)).clamp(0, 1)]
    others += [solver.volume.lerp(solver.volume.roll(1, axis), 0.05) for axis in (0, 1, 2)]
    assert all(objective(other, lines, weight) > best for other in others)


def test_coupling_changes_the_way_but_not_the_end():
    lines, ends = disc_lines(), []
    for coupling in (1.0, 0.25):
        solver = a_solver(0.3, coupling=coupling)
        solver.run(lines, 400)
        ends.append(objective(solver.volume, lines, 0.3))
    assert ends[1] == pytest.approx(ends[0], rel=2e-3)


def test_total_variation_suppresses_noise():
    lines = disc_lines()
    lines = lines + torch.randn(lines.shape, generator=torch.Generator().manual_seed(1))
    errors = []
    for weight in (0.0, 0.6):
        solver = a_solver(weight)
        solver.run(lines, 150)
        errors.append(float((solver.volume - disc_truth()).norm() / disc_truth().norm()))
    assert errors[1] < 0.7 * errors[0]


def test_a_solver_is_warm():
    """It goes on where it was, and starts where it is told to."""
    whole, parts, lines = a_solver(), a_solver(), disc_lines()
    whole.run(lines, 20)
    parts.run(lines, 12)
    parts.run(lines, 8)
    assert torch.equal(whole.volume, parts.volume)
    started = PrimalDual(whole.projector, disc_truth(), 0.1, 1.0)
    assert torch.equal(started.volume, disc_truth())
    wanted = SliceProjector(Grid.centred((SIDE, 3, SIDE), 1.0), disc_views())
    assert torch.equal(started.lines(), wanted.lines_out(wanted.project(wanted.volume_in(disc_truth()))))


def test_a_solver_goes_on_from_a_coarser_one():
    """With volume and dual of total variation taken over, it is sooner where both end."""
    coarse, lines = a_solver(0.4), disc_lines()
    coarse.run(lines, 300)
    fine_views = disc_views().refined(2)
    fine = SliceProjector(Grid.of_views(fine_views), fine_views)
    images = lines.repeat_interleave(2, 1).repeat_interleave(2, 2)
    errors, warm = [], coarse.on_finer(fine, 2, 0.4)
    start = warm.volume.clone()
    end = PrimalDual(fine, start, 0.4, 1.0, 0.25)
    end.run(images, 600)
    for solver in (warm, PrimalDual(fine, start, 0.4, 1.0, 0.25)):
        solver.run(images, 10)
        errors.append(float((solver.volume - end.volume).norm() / end.volume.norm()))
    assert warm.bounds == (0.0, 1.0)
    assert errors[0] < 0.9 * errors[1]
