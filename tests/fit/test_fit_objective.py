"""The terms of the objective, each against an independent computation, and their gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity as skimage_similarity

from holosplat.checks import InputError
from holosplat.fit.terms import Objective
from holosplat.fit.terms import comparisons as terms
from holosplat.fit.total_variation import total_variation
from holosplat.metrics import image_scores

SHAPES = [(16, 16), (17, 17), (15, 22), (23, 12), (12, 24), (13, 26), (31, 14)]
"""Square, odd, rectangular, and twice as long as wide (where ring radii fall between two rings)."""


def images(shape: tuple[int, int], views: int = 3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Two alike but different stacks [V, H, W] of values in about [0, 1], float64."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    smooth = 0.5 + 0.3 * np.sin(0.6 * rows) * np.cos(0.4 * columns + np.arange(views)[:, None, None])
    a, b = (smooth + 0.1 * rng.standard_normal((views, *shape)) for _ in range(2))
    return torch.from_numpy(a), torch.from_numpy(b)


IMAGE_TERMS = {
    "l1": terms.l1,
    "l2_amplitude": terms.l2_amplitude,
    "huber": lambda a, b: terms.huber(a, b, 0.05 + 0.1 * b.abs()),
    "ssim": terms.one_minus_ssim,
    "frc": terms.one_minus_frcm,
}


def test_the_default_objective_is_l1():
    widths = {"frc_ramp", "anisotropy_limit", "rounding", "floor"}
    assert {name for name, w in vars(Objective()).items() if w > 0} == {"l1"} | widths
    assert not Objective().uses_volume
    assert Objective(tv_volume=0.1).uses_volume
    assert Objective(overfull=0.1).uses_volume
    assert Objective(two_levels=0.1).uses_volume


# --- image terms --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_l1_is_the_mean_absolute_difference_of_each_view(shape):
    a, b = images(shape)
    np.testing.assert_allclose(terms.l1(a, b), [np.abs(x - y).mean() for x, y in zip(a.numpy(), b.numpy())])


@pytest.mark.parametrize("shape", SHAPES)
def test_huber_is_the_absolute_difference_but_for_small_ones(shape):
    """Half its width less than the absolute difference beyond the width, `z²/2w` within: one and the other at z = w."""
    a, b = images(shape)
    width = 0.02 + 0.2 * torch.rand(a.shape, generator=torch.Generator().manual_seed(1), dtype=a.dtype)
    z, w = np.abs(a.numpy() - b.numpy()), width.numpy()
    wanted = np.where(z < w, z**2 / (2 * w), z - w / 2).mean(axis=(1, 2))
    np.testing.assert_allclose(terms.huber(a, b, width), wanted)
    np.testing.assert_allclose(terms.huber(a, b, 1e-9 * width), terms.l1(a, b), rtol=1e-6)
    wide = 100 * torch.ones_like(a)
    np.testing.assert_allclose(terms.huber(a, b, wide), (a - b).square().mean(dim=(1, 2)) / 200)


@pytest.mark.parametrize("shape", SHAPES)
def test_l2_amplitude_is_the_mean_squared_difference_of_roots(shape):
    a, b = (image.clamp_min(0) for image in images(shape))
    wanted = [np.mean((np.sqrt(x) - np.sqrt(y)) ** 2) for x, y in zip(a.numpy(), b.numpy())]
    np.testing.assert_allclose(terms.l2_amplitude(a, b), wanted, rtol=1e-4)


def test_l2_amplitude_bears_intensities_of_zero_and_below():
    a = torch.zeros(1, 3, 4, requires_grad=True)
    value = terms.l2_amplitude(a, torch.full((1, 3, 4), -0.1))
    (gradient,) = torch.autograd.grad(value.sum(), a)
    assert float(value.detach()) == pytest.approx(0, abs=1e-9)
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("shape", SHAPES)
def test_ssim_agrees_with_the_metric_and_with_scikit_image(shape):
    a, b = images(shape)
    found = 1 - terms.one_minus_ssim(a, b).numpy()
    np.testing.assert_allclose(found, image_scores(a.numpy(), b.numpy(), (0, 1)).ssim, atol=2e-6)
    for x, y, value in zip(a.numpy(), b.numpy(), found):
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
        assert value == pytest.approx(skimage_similarity(x, y, **options), abs=2e-6)


def test_ssim_of_images_smaller_than_its_window_is_still_a_similarity():
    a, b = images((7, 9))
    value = terms.one_minus_ssim(a, b)
    assert value.shape == (3,)
    assert bool(((value > 0) & (value < 2)).all())


@pytest.mark.parametrize("shape", SHAPES)
def test_frcm_agrees_with_the_metric(shape):
    a, b = images(shape)
    found = 1 - terms.one_minus_frcm(a, b).numpy()
    np.testing.assert_allclose(found, image_scores(a.numpy(), b.numpy(), (0, 1)).frcm, atol=1e-9)


@pytest.mark.parametrize("shape", [(16, 16), (15, 22), (12, 24)])
def test_terms_in_float32_are_those_in_float64(shape):
    """The fit runs in float32."""
    a, b = images(shape)
    for name, term in IMAGE_TERMS.items():
        np.testing.assert_allclose(term(a.float(), b.float()), term(a, b), rtol=2e-3, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("shape", SHAPES)
def test_total_variation_of_an_image_is_the_mean_of_absolute_steps(shape):
    a, _ = images(shape)
    wanted = [np.abs(np.diff(x, axis=0)).mean() + np.abs(np.diff(x, axis=1)).mean() for x in a.numpy()]
    np.testing.assert_allclose(terms.tv_image(a), wanted)
    assert float(terms.tv_image(torch.ones(1, 5, 6)).sum()) == 0


@pytest.mark.parametrize("name", IMAGE_TERMS)
def test_a_perfect_prediction_costs_nothing_and_any_other_something(name):
    a, b = images((15, 18))
    term = IMAGE_TERMS[name]
    np.testing.assert_allclose(term(b, b), 0, atol=1e-6)
    assert float(term(a, b).min()) > 1e-3


@pytest.mark.parametrize("name", IMAGE_TERMS)
def test_each_view_has_its_own_value(name):
    """Views do not mix: the value of a view alone is its value in the batch."""
    a, b = images((14, 17))
    term = IMAGE_TERMS[name]
    np.testing.assert_allclose(term(a, b), [float(term(a[i : i + 1], b[i : i + 1])[0]) for i in range(3)], rtol=1e-12)


@pytest.mark.parametrize("name", [*IMAGE_TERMS, "tv_image"])
def test_image_terms_have_the_right_gradients(name):
    """Finite differences in float64, on odd rectangular images."""
    a, b = images((11, 13), views=2, seed=4)
    a = a.abs().requires_grad_()
    term = {**IMAGE_TERMS, "tv_image": lambda x, _: terms.tv_image(x)}[name]
    assert torch.autograd.gradcheck(lambda x: term(x, b.abs()), (a,), eps=1e-7, atol=1e-5, fast_mode=True)


# --- object terms -------------------------------------------------------------------------------------------


def test_anisotropy_is_the_mean_log_excess_over_the_limit():
    axes = torch.tensor([[1.0, 1.0, 1.0], [5.0, 1.0, 2.0], [0.1, 2.0, 4.0], [8.0, 0.5, 0.5]])
    excess = [0.0, 0.0, np.log(40 / 10), np.log(16 / 10)]
    assert float(terms.anisotropy(axes.log(), 10.0)) == pytest.approx(np.mean(excess), rel=1e-5)
    assert float(terms.anisotropy(axes[:2].log(), 10.0)) == 0
    assert float(terms.anisotropy(axes[:0].log(), 10.0)) == 0


def test_total_variation_of_a_volume_is_the_mean_length_of_the_smoothed_gradient():
    density = np.random.default_rng(1).random((2, 5, 6, 7))
    steps = [np.diff(density, axis=i) for i in (1, 2, 3)]
    squares = steps[0][:, :, :-1, :-1] ** 2 + steps[1][:, :-1, :, :-1] ** 2 + steps[2][:, :-1, :-1] ** 2
    for smoothing in (0.02, 0.3):
        wanted = (np.sqrt(squares + smoothing**2) - smoothing).mean()
        assert float(total_variation(torch.from_numpy(density), smoothing)) == pytest.approx(wanted, rel=1e-9)
    assert float(total_variation(torch.full((1, 4, 4, 4), 0.7))) == 0


@pytest.mark.parametrize("shape", [(1, 5, 6, 7), (2, 4, 3, 9), (1, 2, 2, 2), (1, 9, 17, 33)])
def test_the_compiled_total_variation_is_its_plain_form(shape):
    """Value and gradient against the plain form in float64."""
    density = torch.rand(shape, generator=torch.Generator().manual_seed(3))
    results = []
    for values, backend in ((density, "cpu"), (density.double(), "reference")):
        leaf = values.clone().requires_grad_()
        value = total_variation(leaf, 0.05, backend)
        (gradient,) = torch.autograd.grad(3 * value, leaf)
        assert value.dtype == leaf.dtype
        results.append((float(value.detach()), gradient.double()))
    (found, gradient), (wanted, exact) = results
    assert found == pytest.approx(wanted, rel=1e-5)
    np.testing.assert_allclose(gradient, exact, rtol=0, atol=1e-5 * float(exact.abs().max()))


def test_overfull_is_the_mean_square_beyond_one():
    density = torch.tensor([0.3, 1.0, 1.5, 3.0]).reshape(1, 1, 2, 2)
    assert float(terms.overfull(density)) == pytest.approx((0.25 + 4.0) / 4)
    assert float(terms.overfull(torch.rand(1, 3, 4, 5))) == 0


def test_two_levels_costs_what_lies_between_nothing_and_one():
    density = torch.tensor([0.0, 0.5, 1.0, 0.25, 1.5, -0.1]).reshape(1, 1, 2, 3)
    assert float(terms.two_levels(density)) == pytest.approx((0.25 + 0.1875) / 6)
    (slope,) = torch.autograd.grad(terms.two_levels(faint := torch.tensor([0.2, 0.8], requires_grad=True)), faint)
    assert slope[0] > 0 > slope[1]  # what is nearly nothing is pushed down, what is nearly one up


@pytest.mark.parametrize("name", ["anisotropy", "tv_volume", "overfull", "two_levels"])
def test_object_terms_have_the_right_gradients(name):
    rng = torch.Generator().manual_seed(2)
    shape = (7, 3) if name == "anisotropy" else (2, 3, 5, 4)
    values = (3 * torch.rand(shape, generator=rng, dtype=torch.float64)).requires_grad_()
    term = {
        "anisotropy": lambda x: terms.anisotropy(x, 2.0),
        "tv_volume": total_variation,
        "overfull": terms.overfull,
        "two_levels": terms.two_levels,
    }[name]
    assert torch.autograd.gradcheck(term, (values,), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize(
    ("density", "message"),
    [
        (torch.zeros(1, 4, 4, 4).double(), "must be float32"),
        (torch.zeros(4, 4, 4), "shape"),
        (torch.zeros(1, 4, 4, 0), "zero"),
    ],
)
def test_volumes_that_the_kernel_cannot_take_are_refused(density, message):
    with pytest.raises(InputError, match=message):
        total_variation(density, backend="cpu")


def test_an_objective_compares_frames():
    with pytest.raises(InputError, match="needs a term on the frames"):
        Objective(l1=0.0, tv_volume=1.0)


@pytest.mark.parametrize("name", ["l1", "two_levels", "noise_width", "coarse"])
def test_weights_are_not_negative(name):
    with pytest.raises(InputError, match=f"{name} must not be negative, but it is -0.5"):
        Objective(**{"ssim": 1.0, name: -0.5})
