"""The GPU's fidelity terms and Adam against float64: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from helpers.watch import Watch
from holosplat.fit import adam, fidelity

LOW, SPAN = 0.65, 0.6
VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-6, 2e-5


def frames_of(shape: tuple[int, int, int], noise: float) -> tuple[Tensor, Tensor]:
    """Measured frames, and predicted ones that differ by `noise`."""
    generator = torch.Generator().manual_seed(0)
    measured = 0.7 + 0.5 * torch.rand(shape, generator=generator)
    return measured, measured + noise * torch.randn(shape, generator=generator)


def values_and_gradient(
    measured: Tensor, predicted: Tensor, weights: Tensor, backend: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Statistics, L1 and 1 - SSIM [2, V], and the gradient of their sum weighted with [2, V]."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    target = fidelity.Target(measured.to(dtype), LOW, SPAN, backend)
    leaf = predicted.to(dtype, copy=True).requires_grad_()
    values = torch.stack(fidelity.l1_and_ssim(leaf, target))
    (gradient,) = torch.autograd.grad((values * weights.to(values)).sum(), leaf)
    return target.statistics, values.detach(), gradient


def error(found: Tensor, true: Tensor) -> float:
    """Largest difference over largest true value."""
    return float((found.double() - true).abs().max() / true.abs().max())


SMALL, LARGE = [(1, 11, 64), (2, 20, 5)], [(2, 30, 37), (3, 7, 40)]
BOTH, EACH = (1.0, 1.0), [(0.0, 1.0), (1.0, 0.0)]


@pytest.mark.parametrize(
    ("shape", "noise", "weights"),
    [(shape, noise, weights) for shape in SMALL for noise in (0.3, 1e-3) for weights in (BOTH, *EACH)]
    + [(shape, 0.3, BOTH) for shape in LARGE],  # where the interpreter takes seconds
)
def test_fidelity_is_that_of_the_reference(shape, noise, weights, gpu):
    measured, predicted = (a.to(gpu) for a in frames_of(shape, noise))
    upstream = torch.tensor(weights)[:, None] * torch.linspace(0.5, 2, shape[0])
    found, true = (values_and_gradient(measured, predicted, upstream, b) for b in ("cuda", "reference"))
    for value, truth, tolerance in zip(found, true, (VALUE_TOLERANCE, VALUE_TOLERANCE, GRADIENT_TOLERANCE)):
        assert error(value, truth) < tolerance


def test_the_fidelity_check_would_catch_a_biased_term():
    measured, predicted = frames_of((2, 30, 37), 0.1)
    ones = torch.ones(2, 2)
    _, values, gradient = values_and_gradient(measured, predicted, ones, "reference")
    _, moved, turned = values_and_gradient(measured, predicted, ones * torch.tensor([[1.0], [1.001]]), "reference")
    assert torch.equal(values, moved)
    assert error(turned, gradient) > GRADIENT_TOLERANCE


def test_equal_frames_have_no_gradient(gpu):
    measured, _ = frames_of((1, 20, 20), 0.0)
    _, values, gradient = values_and_gradient(measured.to(gpu), measured.to(gpu), torch.ones(2, 1), "cuda")
    assert not values.any()
    assert not gradient.any()


def test_fidelity_takes_no_views_and_no_gradient(gpu):
    measured, predicted = (a.to(gpu) for a in frames_of((2, 20, 20), 0.1))
    target = fidelity.Target(measured, LOW, SPAN, "cuda")
    with torch.no_grad():
        values = fidelity.l1_and_ssim(predicted, target)
    with_gradient = fidelity.l1_and_ssim(predicted.clone().requires_grad_(), target)
    assert all(torch.equal(a, b.detach()) for a, b in zip(values, with_gradient))
    none = target[torch.zeros(0, dtype=torch.int64, device=gpu)]
    leaf = predicted[:0].requires_grad_()
    parts = fidelity.l1_and_ssim(leaf, none)
    assert [p.shape for p in parts] == [(0,), (0,)]
    assert torch.autograd.grad(parts[0].sum() + parts[1].sum(), leaf)[0].shape == (0, 20, 20)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11])
def test_adam_is_that_of_the_reference(count, gpu):
    generator = torch.Generator().manual_seed(count)
    sizes = [(700, 3), (1024, 1), (1, 4), (0, 2), (33, 5), (2, 2), (0, 1), (5, 1), (64, 4), (9, 3), (1, 1)][:count]
    arrays = [[torch.randn(s, generator=generator).to(gpu) for s in sizes] for _ in range(3)]
    arrays.append([torch.rand(s, generator=generator).to(gpu) for s in sizes])
    arrays[1][0] = arrays[1][0].T.contiguous().T  # gradients may lie anyhow
    exact = [[a.double() for a in group] for group in arrays]
    factors = adam.factors([0.01 * 1.7**k for k in range(count)], 7, 1e-12).to(gpu)
    for _ in range(3):
        adam.step(*arrays, factors, backend="cuda")
        adam.step(*exact, factors.double(), backend="reference")
    for found, true in zip(arrays, exact):
        assert all(torch.allclose(a.double(), b, rtol=2e-6, atol=2e-6) for a, b in zip(found, true))


@pytest.mark.parametrize(("count", "launches"), [(0, 0), (1, 1), (4, 1), (5, 2), (12, 3)])
def test_one_launch_moves_up_to_four_arrays(count, launches, gpu, monkeypatch):
    from holosplat.fit.adam import cuda

    sizes, usual = [], cuda._launch

    def noted(arrays, factors):
        sizes.append(len(arrays))
        usual(arrays, factors)

    monkeypatch.setattr(cuda, "_launch", noted)
    arrays = [[torch.ones(3, device=gpu) for _ in range(count)] for _ in range(4)]
    adam.step(*arrays, adam.factors([0.1] * count, 1, 1e-12).to(gpu), backend="cuda")
    assert len(sizes) == launches
    assert sum(sizes) == count


def test_nothing_waits_for_the_device(gpu):
    measured, predicted = (a.to(gpu) for a in frames_of((2, 20, 20), 0.1))
    target = fidelity.Target(measured, LOW, SPAN, "cuda")
    leaf, moments = predicted.clone().requires_grad_(), [torch.zeros_like(predicted) for _ in range(2)]
    many = [[a.clone() for _ in range(5)] for a in (leaf.detach(), *moments)]
    factors, index = adam.factors([0.1] * 5, 1, 1e-12).to(gpu), torch.tensor([1, 0], device=gpu)
    with Watch():
        sum(part.sum() for part in fidelity.l1_and_ssim(leaf, target[index])).backward()
        adam.step(many[0], [leaf.grad] * 5, *many[1:], factors, backend="cuda")
    assert not any(torch.equal(p, predicted) for p in many[0])
