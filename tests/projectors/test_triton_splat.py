"""The GPU's splat and voxeliser against the float64 reference: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from helpers.kernels import few_programs
from helpers.splats import DETECTOR, KINDS, NAMES, VOLUME, cloud, error, poses
from helpers.watch import Watch
from holosplat.projectors.splat import splat, voxelise

FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-5


@pytest.fixture(autouse=True)
def modules(gpu, monkeypatch):
    """The modules that walk over boxes, with their usual sizes."""
    return few_programs(monkeypatch, gpu)


def draw_views(arrays, backend, **options) -> Tensor:
    return splat(*arrays, *poses(3), DETECTOR, backend=backend, **options)


def draw_volume(arrays, backend, **options) -> Tensor:
    return voxelise(*arrays, VOLUME, backend=backend, **options)


DRAWS = pytest.mark.parametrize("draw", [draw_views, draw_volume])


def value_and_gradients(draw, arrays: list[Tensor], backend: str, gpu: torch.device) -> tuple[Tensor, list[Tensor]]:
    """The drawing, and the gradients of a fixed random sum over it: `cuda` in float32, `reference` in float64."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [a.to(gpu, dtype).requires_grad_() for a in arrays]
    value = draw(leaves, backend)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return value.detach(), list(torch.autograd.grad(value, leaves, weights.to(value)))


def assert_twins(draw, arrays: list[Tensor], gpu: torch.device) -> None:
    (value, gradients), (truth, true_gradients) = (
        value_and_gradients(draw, arrays, backend, gpu) for backend in ("cuda", "reference")
    )
    assert error(value, truth) < FORWARD_TOLERANCE
    for name, gradient, true in zip(NAMES, gradients, true_gradients):
        assert error(gradient, true) < GRADIENT_TOLERANCE, name


# --- against the specification ------------------------------------------------------------------------------


@DRAWS
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_as_the_reference(kind, channels, draw, gpu):
    assert_twins(draw, cloud(kind, channels, 12 if kind == "large" else 120), gpu)


@DRAWS
@pytest.mark.parametrize("kind", ["thin", "large"])
def test_boxes_too_large_for_one_warp(kind, draw, gpu, modules, monkeypatch):
    for module in modules:
        monkeypatch.setattr(module, "BLOCKS", replace(module.BLOCKS, large=200, large_lanes=2048))
    assert_twins(draw, cloud(kind, 2, 6), gpu)


@DRAWS
def test_the_sizes_of_production(draw, gpu, modules, monkeypatch):
    for module, usual in modules.items():
        monkeypatch.setattr(module, "BLOCKS", replace(usual, large=60, large_programs=5))
    arrays = [torch.cat(pair) for pair in zip(cloud("small", 2, 8), cloud("thin", 2, 3))]
    assert_twins(lambda a, b: draw(a, b, cutoff=2.5), arrays, gpu)


@DRAWS
def test_rasters_that_need_64_bits(draw, gpu, modules, monkeypatch):
    for module in modules:
        monkeypatch.setattr(module, "WIDE_FROM", 0)
    assert_twins(draw, cloud("ordinary", 2, 40), gpu)


@pytest.mark.parametrize(("cutoff", "variance"), [(3.0, 1 / 12), (6.0, 0.5), (4.0, 0.0)])
def test_cutoff_and_variance_mean_the_same(cutoff, variance, gpu):
    arrays = cloud("ordinary", 2, 60)
    assert_twins(lambda a, b: draw_views(a, b, cutoff=cutoff, pixel_variance=variance), arrays, gpu)
    assert_twins(lambda a, b: draw_volume(a, b, cutoff=cutoff, voxel_variance=variance), arrays, gpu)


@pytest.mark.parametrize("shape", [(1, 1), (1, 57), (64, 3), (17, 240)])
def test_odd_detectors(shape, gpu):
    assert_twins(lambda a, b: splat(*a, *poses(2), shape, backend=b), cloud("ordinary", 2, 60), gpu)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 23, 2), (30, 1, 5)])
def test_odd_volumes(shape, gpu):
    assert_twins(lambda a, b: voxelise(*a, shape, backend=b), cloud("ordinary", 2, 60), gpu)


# --- properties ---------------------------------------------------------------------------------------------


@DRAWS
def test_no_gaussians_draw_nothing(draw, gpu):
    value, gradients = value_and_gradients(draw, cloud("small", 2, 0), "cuda", gpu)
    assert not value.any()
    assert [tuple(g.shape) for g in gradients] == [(0, 3), (0, 3), (0, 4), (0, 2)]


def test_no_views(gpu):
    def draw(arrays, backend):
        return splat(*arrays, torch.zeros(0, 3, 3), torch.zeros(0, 2), DETECTOR, backend=backend)

    value, gradients = value_and_gradients(draw, cloud("small", 1, 9), "cuda", gpu)
    assert value.shape == (0, 1, *DETECTOR)
    assert not any(g.any() for g in gradients)


@DRAWS
@pytest.mark.filterwarnings("ignore:invalid value encountered")  # numpy's, in the interpreter
@pytest.mark.parametrize("array", range(4))
def test_what_is_no_number_is_left_out(array, draw, gpu):
    """A Gaussian with a NaN or an infinite parameter touches no pixel, has no gradient, and spoils no other's."""
    arrays, trusted = cloud("ordinary", 2, 20), {"trusted": True}
    spoiled = [a.clone() for a in arrays]
    spoiled[array][3], spoiled[array][5, 1] = math.nan, math.inf
    for a in arrays:
        a[[3, 5]] = torch.tensor([[500.0], [500.0]])  # out of sight
    arrays[1][[3, 5]], views = 1.0, [a.to(gpu) for a in poses(3)]

    def drawn(a, b):
        return splat(*a, *views, DETECTOR, backend=b, **trusted) if draw is draw_views else draw(a, b, **trusted)

    value, gradients = value_and_gradients(drawn, spoiled, "cuda", gpu)
    wanted, wanted_gradients = value_and_gradients(drawn, arrays, "reference", gpu)
    assert error(value, wanted) < FORWARD_TOLERANCE
    for gradient, true in zip(gradients, wanted_gradients):
        assert error(gradient, true) < GRADIENT_TOLERANCE
        assert not gradient[[3, 5]].any()


@DRAWS
def test_arrays_and_gradients_may_lie_anyhow_in_memory(draw, gpu):
    centres, scales, quaternions, amplitudes = cloud("small", 2, 30)
    scattered = [centres.T.contiguous().T, scales, quaternions[:, [1, 2, 3, 0]][:, [3, 0, 1, 2]], amplitudes[:, 1:]]
    assert_twins(draw, scattered, gpu)
    leaves = [a.to(gpu).requires_grad_() for a in (centres, scales, quaternions, amplitudes)]
    (given,) = torch.autograd.grad(draw(leaves, "cuda").sum(), leaves[0])  # an expanded gradient
    true = [a.detach().double().requires_grad_() for a in leaves]
    assert error(given, torch.autograd.grad(draw(true, "reference").sum(), true[0])[0]) < GRADIENT_TOLERANCE


@DRAWS
def test_gradients_are_bitwise_the_same_in_every_run(draw, gpu):
    arrays = cloud("ordinary", 2, 60)
    (_, first), (_, second) = (value_and_gradients(draw, arrays, "cuda", gpu) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second))


@DRAWS
def test_nothing_waits_for_the_device(draw, gpu):
    leaves = [a.to(gpu).requires_grad_() for a in cloud("small", 2, 10)]
    views = [a.to(gpu) for a in poses(3)]
    with Watch():
        if draw is draw_views:
            value = splat(*leaves, *views, DETECTOR, backend="cuda", trusted=True)
        else:
            value = voxelise(*leaves, VOLUME, backend="cuda", trusted=True)
        value.sum().backward()
    assert leaves[0].grad is not None


def test_the_watch_sees():
    with Watch(), pytest.raises(AssertionError, match="waits"):
        torch.ones(3).sum().item()
    with Watch(), pytest.raises(AssertionError, match="waits"):
        torch.ones(3)[torch.ones(3) > 0]
    with Watch(), pytest.raises(AssertionError, match="moves"):
        torch.ones(3).to("meta")


def test_the_benchmark_runs(gpu, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    benchmark = importlib.import_module("gpu")

    def clock(call, repeats: int) -> float:
        call()
        return 1e-3

    sizes = benchmark.Sizes(count=50, views=2, side=24, compared=20)
    found = benchmark.measure(sizes, gpu.type, clock)
    assert 1000 < found["pairs"] < 50 * 2 * 24**2
    assert max(found["errors"].values()) < FORWARD_TOLERANCE
