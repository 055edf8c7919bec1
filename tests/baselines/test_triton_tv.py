"""The GPU's steps of total variation against plain torch in float64: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

import importlib
import math
from types import ModuleType

import pytest
import torch
from torch import Tensor

from helpers.voxels import anyhow, around, randoms
from holosplat.baselines import PrimalDual
from holosplat.baselines.tv_steps import reference
from holosplat.geometry import Grid
from holosplat.projectors.voxels import projector_for

SHAPES = [(5, 7, 9), (1, 7, 3), (4, 1, 18), (3, 5, 1), (2, 3, 33), (11, 13, 17)]
"""The last has several blocks of voxels."""


@pytest.fixture
def steps(gpu) -> ModuleType:
    return importlib.import_module("holosplat.baselines.tv_steps.cuda")


def dual(shape: tuple[int, int, int], gpu: torch.device) -> Tensor:
    """As a solver has it: there is no voxel beyond the last."""
    q = randoms(3, *shape, seed=1)
    q[0, -1] = q[1, :, -1] = q[2, :, :, -1] = 0
    return q.float().to(gpu)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("radius", [0.8, 0])
def test_ascent_equals_its_float64_twin(steps, gpu, shape, radius):
    u, q = randoms(*shape).float().to(gpu), dual(shape, gpu)
    want = q.double()
    reference.ascend(u.double(), want, 0.5, radius)
    steps.ascend(u, q, 0.5, radius)
    assert float((q - want).abs().max()) < 1e-6
    assert bool(q.any()) == (radius > 0)


def test_nothing_varies_where_there_is_nothing(steps, gpu):
    """Neither 0 / 0 without total variation, nor a step of it."""
    q = torch.zeros(3, 3, 4, 5, device=gpu)
    steps.ascend(torch.ones(3, 4, 5, device=gpu), q, 0.5, 0.0)
    assert not q.any()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("bounds", [(0.0, 0.7), (0.0, math.inf), (-0.4, 0.7), (-math.inf, math.inf)])
def test_descent_equals_its_float64_twin(steps, gpu, shape, bounds):
    u, slope, tau = (randoms(*shape, seed=seed).float().to(gpu) for seed in (2, 3, 4))
    tau, q, ahead = 0.1 + tau.abs(), dual(shape, gpu), torch.empty_like(u)
    want, want_ahead = u.double(), torch.empty_like(u, dtype=torch.float64)
    reference.descend(slope.double(), tau.double(), q.double(), 0.3, bounds, want, want_ahead)
    steps.descend(slope, tau, q, 0.3, bounds, u, ahead)
    assert float((u - want).abs().max()) < 2e-6
    assert float((ahead - want_ahead).abs().max()) < 4e-6
    assert float(u.min()) == pytest.approx(max(bounds[0], float(want.min())), abs=1e-5)


@pytest.mark.parametrize(
    ("grid", "views"),
    [(Grid.centred((5, 3, 4), 1.0), around(3, (3, 7))), (Grid.centred((5, 7, 6), 1.0), anyhow(3, (9, 8)))],
)
def test_tomography_agrees_with_the_compiled_kernels(gpu, grid, views):
    volumes = []
    for backend, there in (("cpu", torch.device("cpu")), ("cuda", gpu)):
        projector, truth = projector_for(grid, views, backend), torch.zeros(grid.shape, device=there)
        truth[2:4, 1:3, 1:3] = 0.8
        images = projector.lines_out(projector.project(projector.volume_in(truth)))
        solver = PrimalDual(projector, torch.zeros(grid.shape, device=there), 0.05, 1.0, backend=backend)
        solver.run(images, 5)
        volumes.append(solver.volume.cpu())
    assert float((volumes[0] - volumes[1]).abs().max()) < 1e-5
    assert float(volumes[0].max()) > 0.2
