"""L1 and SSIM with their gradient: the compiled kernels against the plain form in float64, and what both promise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat import native
from holosplat.checks import InputError
from holosplat.fit.fidelity import Target, cpu, l1_and_ssim, reference
from holosplat.fit.terms import comparisons as terms

LOW, SPAN = 0.8, 0.7
VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-6, 5e-6
"""Absolute; largest difference over largest value."""

SHAPES = [(40, 57), (11, 11), (12, 200), (131, 64), (300, 29), (17, 16), (26, 42), (27, 538)]
"""Odd, rectangular, the window itself, one row of windows more, and around multiples of the vector's length."""
SMALL = [(7, 9), (1, 1), (10, 30), (30, 4)]
"""Smaller than the window in one direction or both."""
KINDS = ("random", "smooth", "nearly equal", "constant background", "far off")


def pair(kind: str, shape: tuple[int, int], views: int = 2) -> tuple[Tensor, Tensor]:
    """Predicted and measured frames [V, H, W], float32, the measured ones mostly in [LOW, LOW + SPAN]."""
    rng = np.random.default_rng(len(kind) + sum(shape))
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = 0.5 + 0.4 * np.sin(0.3 * y + np.arange(views)[:, None, None]) * np.cos(0.2 * x)
    noise = rng.random((2, views, *shape))
    disc = (y - shape[0] / 2) ** 2 + (x - shape[1] / 2) ** 2 < (min(shape) / 4) ** 2
    a, b = {
        "random": (noise[0], noise[1]),
        "smooth": (waves**2, waves),
        "nearly equal": (waves + 1e-4 * noise[0], waves),
        "constant background": (0.9 - 0.3 * disc * waves, 0.9 - 0.3 * disc * noise[1]),
        "far off": (2 + noise[0], noise[1]),
    }[kind]
    return tuple(torch.from_numpy((LOW + SPAN * f) * np.ones((views, 1, 1))).float() for f in (a, b))  # type: ignore[return-value]


UPSTREAM = (0.7, -1.3)
"""Weights of L1 and of 1 - SSIM in the sum that is differentiated; views count 1, 2, 3, … times."""


def compared(predicted: Tensor, frames: Tensor, backend: str) -> tuple[Tensor, Tensor, Tensor]:
    """L1 [V], 1 - SSIM [V] and the gradient of a weighted sum of both."""
    if backend == "reference":
        predicted, frames = predicted.double(), frames.double()
    leaf = predicted.clone().requires_grad_()
    l1, ssim = l1_and_ssim(leaf, Target(frames, LOW, SPAN, backend))
    views = torch.arange(1, len(frames) + 1)
    (gradient,) = torch.autograd.grad((views * (UPSTREAM[0] * l1 + UPSTREAM[1] * ssim)).sum(), leaf)
    return l1.detach(), ssim.detach(), gradient


def error(found: Tensor, true: Tensor) -> float:
    """Largest difference over largest true value."""
    return float((found.double() - true).abs().max() / true.abs().max())


def check(predicted: Tensor, frames: Tensor) -> None:
    found, true = (compared(predicted, frames, backend) for backend in ("cpu", "reference"))
    for name, a, b in zip(("L1", "1 - SSIM"), found, true):
        np.testing.assert_allclose(a, b, rtol=2e-7, atol=VALUE_TOLERANCE, err_msg=name)
    assert error(found[2], true[2]) < GRADIENT_TOLERANCE


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_kernel_is_the_plain_form(kind, shape):
    check(*pair(kind, shape))


@pytest.mark.parametrize("shape", SMALL)
def test_images_smaller_than_the_window_have_one(shape):
    check(*pair("random", shape))
    assert Target(torch.ones(2, *shape), LOW, SPAN).statistics.shape == (2, 2, *(max(n - 10, 1) for n in shape))


@pytest.mark.parametrize("isa", native.available_isas())
@pytest.mark.parametrize("kind", KINDS)
def test_every_build_gives_the_same(isa, kind, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    check(*pair(kind, (53, 71)))


@pytest.mark.parametrize("views", [1, 3, 4, 5])
def test_any_number_of_views(views):
    check(*pair("random", (45, 23), views))


def test_memory_order_does_not_matter():
    predicted, frames = pair("random", (33, 47))
    wanted = compared(predicted, frames, "cpu")
    turned = [f.transpose(1, 2).contiguous().transpose(1, 2) for f in (predicted, frames)]
    wide = [torch.cat([f, f], dim=2)[:, :, :47] for f in (predicted, frames)]
    for arrays in (turned, wide):
        assert not arrays[0].is_contiguous()
        assert all(torch.equal(a, b) for a, b in zip(compared(*arrays, "cpu"), wanted))


@pytest.mark.parametrize("shape", [(512, 64), (97, 130)])
def test_threads_change_nothing(shape):
    predicted, frames = pair("random", shape, views=3)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5, 16):
            torch.set_num_threads(threads)
            results.append((*compared(predicted, frames, "cpu"), Target(frames, LOW, SPAN).statistics))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other))


def test_differences_of_a_millionth_are_not_lost():
    """Both values and gradient keep their digits where frames all but agree: nothing cancels."""
    _, frames = pair("smooth", (40, 50))
    predicted = frames + 1e-6 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    found, true = (compared(predicted, frames, backend) for backend in ("cpu", "reference"))
    assert float(true[1].max()) < 1e-8
    np.testing.assert_allclose(found[1], true[1], rtol=1e-5)
    slopes = []
    for backend, held in (("cpu", torch.float32), ("reference", torch.float64)):
        leaf = predicted.to(held).requires_grad_()
        value = l1_and_ssim(leaf, Target(frames.to(held), LOW, SPAN, backend))[1]
        slopes.append(torch.autograd.grad(value.sum(), leaf)[0])
    assert error(slopes[0], slopes[1]) < GRADIENT_TOLERANCE


@pytest.mark.parametrize("frames", [torch.full((1, 20, 20), 1.1), pair("random", (20, 20))[1]])
def test_equal_frames_cost_nothing_and_pull_nowhere(frames):
    l1, ssim, gradient = compared(frames, frames, "cpu")
    assert not l1.any()
    assert not ssim.any()
    assert not gradient.any()


# --- the tests see what they should -------------------------------------------------------------------------


def without(part: str, predicted: Tensor, frames: Tensor) -> Tensor:
    """The gradient of `compared`, in float64, with one thing forgotten."""
    leaf = predicted.double().requires_grad_()
    a, b = (leaf - LOW) / SPAN, (frames.double() - LOW) / SPAN
    held = {name: (a.detach() if name == part else a) for name in ("mean", "square", "cross", "l1")}
    mean_b, variance_b = reference.statistics(b, 0.0, 1.0).unbind(dim=1)
    mean = reference.local_mean(held["mean"])
    variance = reference.local_mean(held["square"] ** 2) - mean**2
    covariance = reference.local_mean(held["cross"] * b) - mean * mean_b
    means = (2 * mean * mean_b + reference.C1) / (mean**2 + mean_b**2 + reference.C1)
    variances = (2 * covariance + reference.C2) / (variance + variance_b + reference.C2)
    ssim, l1 = 1 - (means * variances).mean(dim=(1, 2)), (held["l1"] - b).abs().mean(dim=(1, 2))
    views = torch.arange(1, len(frames) + 1)
    (gradient,) = torch.autograd.grad((views * (UPSTREAM[0] * l1 + UPSTREAM[1] * ssim)).sum(), leaf)
    return gradient


@pytest.mark.parametrize("kind", KINDS)
def test_the_tolerance_sees_a_missing_or_biased_term(kind):
    predicted, frames = pair(kind, (53, 71))
    *_, true = compared(predicted, frames, "reference")
    assert error(without("nothing", predicted, frames), true) < 1e-9
    for part in ("mean", "square", "cross", "l1"):
        assert error(without(part, predicted, frames), true) > 10 * GRADIENT_TOLERANCE, part
    assert error(1.0001 * true, true) > 10 * GRADIENT_TOLERANCE
    edge = true.clone()
    edge[:, 42] *= 1.01  # one row wrong, as at the seam of two bands
    assert error(edge, true) > 10 * GRADIENT_TOLERANCE
    assert error(true.roll(1, dims=2), true) > 10 * GRADIENT_TOLERANCE


# --- the plain form -----------------------------------------------------------------------------------------


def test_the_plain_form_has_the_right_gradient():
    predicted, frames = (f.double() for f in pair("random", (13, 15)))
    target = Target(frames, LOW, SPAN, "reference")
    leaf = predicted.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: l1_and_ssim(p, target), (leaf,), eps=1e-7, atol=1e-6, fast_mode=True)


def test_the_terms_of_the_objective_are_the_same():
    predicted, frames = (f.double() for f in pair("smooth", (21, 34)))
    l1, ssim = l1_and_ssim(predicted, Target(frames, LOW, SPAN, "reference"))
    a, b = (predicted - LOW) / SPAN, (frames - LOW) / SPAN
    np.testing.assert_allclose(l1, terms.l1(a, b), rtol=1e-12)
    np.testing.assert_allclose(ssim, terms.one_minus_ssim(a, b), rtol=1e-12)


@pytest.mark.parametrize("shape", [*SHAPES[:3], *SMALL])
def test_statistics_are_local_means_and_variances(shape):
    _, frames = pair("random", shape)
    b = (frames.double() - LOW) / SPAN
    rows, columns = (min(n, 11) for n in shape)
    one, two = (np.exp(-0.5 * ((np.arange(n) - (n - 1) / 2) / 1.5) ** 2) for n in (rows, columns))
    weights = torch.from_numpy(np.outer(one, two) / np.outer(one, two).sum())
    patches = b.unfold(1, rows, 1).unfold(2, columns, 1)
    mean = (patches * weights).sum(dim=(3, 4))
    variance = ((patches - mean[..., None, None]) ** 2 * weights).sum(dim=(3, 4))
    for statistics in (reference.statistics(b, 0.0, 1.0), cpu.statistics(frames, LOW, SPAN)):
        np.testing.assert_allclose(statistics[:, 0], mean, atol=1e-7)
        np.testing.assert_allclose(statistics[:, 1], variance, atol=1e-7)


# --- targets ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_some_views_of_a_target_are_a_target(backend):
    predicted, frames = pair("random", (20, 31), views=5)
    target, index = Target(frames, LOW, SPAN, backend), torch.tensor([3, 0, 4])
    part = target[index]
    assert (len(target), len(part)) == (5, 3)
    assert torch.equal(part.frames, frames[index])
    for whole, some in zip(l1_and_ssim(predicted, target), l1_and_ssim(predicted[index], part)):
        assert torch.equal(whole[index], some)


def test_values_alone_take_no_gradient(monkeypatch):
    predicted, frames = pair("random", (20, 31))
    passed, call = [], native.call
    monkeypatch.setattr(native, "call", lambda *args: (passed.append(args), call(*args))[1])
    target, leaf = Target(frames, LOW, SPAN), predicted.clone().requires_grad_()
    with torch.no_grad():
        quiet = l1_and_ssim(leaf, target)
    plain, wanted = l1_and_ssim(predicted, target), l1_and_ssim(leaf, target)
    images = [args[4].value for args in passed if args[0] == "holosplat_fidelity"]
    assert [image is None for image in images] == [True, True, False]
    assert [value.requires_grad for value in (*quiet, *plain, *wanted)] == [False] * 4 + [True] * 2
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(quiet, plain, wanted))


def test_what_cannot_be_compared_is_refused():
    predicted, frames = pair("random", (20, 31))
    for arguments, message in (
        ((frames[0], LOW, SPAN), "shape"),
        ((frames.double(), LOW, SPAN), "float32"),
        ((frames.int(), LOW, SPAN), "real numbers"),
        ((frames, LOW, 0.0), "span"),
        ((frames, LOW, SPAN, "tpu"), "backend"),
    ):
        with pytest.raises(InputError, match=message):
            Target(*arguments)
    target = Target(frames, LOW, SPAN)
    for wrong in (predicted[:1], predicted[:, 1:], predicted.double()):
        with pytest.raises(InputError, match="like the target's"):
            l1_and_ssim(wrong, target)


@pytest.mark.parametrize("size", [1e9, 1e12, 1e18])
def test_an_absurd_prediction_is_as_unlike_as_can_be(size):
    """Nothing overflows on the way to a dissimilarity of one."""
    generator = torch.Generator().manual_seed(0)
    frames = 1 + 0.1 * torch.randn(1, 40, 40, generator=generator)
    _, found = l1_and_ssim(size * torch.randn(1, 40, 40, generator=generator), Target(frames, 0.0, 2.0))
    assert float(found) == pytest.approx(1, abs=1e-3)
