"""Metrics against scikit-image, against analytic cases, and against the published thresholds."""

import json
import math

import numpy as np
import pytest
import skimage.metrics

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.metrics import (
    dice,
    fourier_ring_correlation,
    fourier_shell_correlation,
    half_bit_threshold,
    image_scores,
    intensity_range,
    resolution,
    ring_counts,
    ring_weighted_mean,
    robust_material_delta,
    structural_similarity,
    volume_scores,
)
from holosplat.volume import Volume

SHAPES = [(64, 64), (65, 65), (48, 71), (33, 20)]


def images(shape, seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    clean = 1.0 + 0.3 * np.sin(x / 3.0) * np.cos(y / 5.0)
    return clean, clean + noise * rng.standard_normal(shape)


def sphere(grid, radius, centre=(0.0, 0.0, 0.0), delta=4e-7, ratio=500.0):
    x, y, z = grid.axes()
    distance = np.sqrt(
        (x[None, None] - centre[0]) ** 2 + (y[None, :, None] - centre[1]) ** 2 + (z[:, None, None] - centre[2]) ** 2
    )
    fill = np.clip(0.5 + (radius - distance) / grid.voxel_size[0], 0, 1)
    return Volume(delta * fill, delta / ratio * fill, grid)


# --- images ---


@pytest.mark.parametrize("shape", SHAPES)
def test_ssim_psnr_l1_agree_with_scikit_image(shape):
    clean, noisy = images(shape)
    low, high = 0.4, 1.9
    scores = image_scores(noisy[None], clean[None], (low, high))
    a, b = (clean - low) / (high - low), (noisy - low) / (high - low)
    ssim = skimage.metrics.structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0
    )
    assert scores.ssim[0] == pytest.approx(ssim, abs=1e-12)
    assert scores.psnr[0] == pytest.approx(skimage.metrics.peak_signal_noise_ratio(a, b, data_range=1.0), abs=1e-10)
    assert scores.l1[0] == pytest.approx(np.abs(a - b).mean(), abs=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
def test_identical_images_score_perfectly(shape):
    clean, _ = images(shape)
    scores = image_scores(clean[None], clean[None], intensity_range(clean))
    assert scores.ssim[0] == pytest.approx(1.0, abs=1e-12)
    assert scores.l1[0] == 0.0
    assert math.isinf(scores.psnr[0])
    assert scores.frcm[0] == pytest.approx(1.0, abs=1e-12)
    assert json.loads(json.dumps(scores.as_dict(), allow_nan=False))["mean"]["psnr"] == "inf"


def test_constant_offset_has_analytic_scores():
    clean, _ = images((40, 40))
    scores = image_scores(clean[None] + 0.05, clean[None], (0.5, 1.5))
    assert scores.l1[0] == pytest.approx(0.05)
    assert scores.psnr[0] == pytest.approx(-20 * math.log10(0.05))
    assert scores.frcm[0] == pytest.approx(1.0)  # the mean is subtracted


def test_scores_do_not_clip_and_share_one_map():
    train = np.stack([np.full((16, 16), 0.5), np.full((16, 16), 1.5)])
    assert intensity_range(train) == (0.5, 1.5)
    measured = np.full((2, 16, 16), 1.0)
    scores = image_scores(measured + 3.0, measured, intensity_range(train))
    assert scores.l1 == pytest.approx([3.0, 3.0])
    assert scores.mean["l1"] == pytest.approx(3.0)
    assert len(scores) == 2


def test_mean_and_dictionary_hold_every_frame():
    clean, noisy = images((32, 40))
    other = images((32, 40), seed=2, noise=0.3)[1]
    scores = image_scores(np.stack([noisy, other]), np.stack([clean, clean]), (0.0, 2.0))
    numbers = json.loads(json.dumps(scores.as_dict(), allow_nan=False))
    assert numbers["per_frame"]["ssim"] == pytest.approx(scores.ssim)
    assert numbers["mean"]["frcm"] == pytest.approx(scores.frcm.mean())
    assert numbers["data_range"] == [0.0, 2.0]
    curves = json.loads(json.dumps(scores.curves()))
    assert np.shape(curves["frc"]) == (2, 16)
    assert len(curves["frequency"]) == len(curves["half_bit"]) == 16


@pytest.mark.parametrize(
    "call",
    [
        lambda: image_scores(np.zeros((1, 16, 16)), np.zeros((1, 16, 17)), (0, 1)),
        lambda: image_scores(np.zeros((0, 16, 16)), np.zeros((0, 16, 16)), (0, 1)),
        lambda: image_scores(np.zeros((1, 16, 16)), np.full((1, 16, 16), np.nan), (0, 1)),
        lambda: image_scores(np.zeros((1, 16, 16)), np.zeros((1, 16, 16)), (1, 1)),
        lambda: structural_similarity(np.zeros((10, 40)), np.zeros((10, 41))),
        lambda: intensity_range(np.ones((2, 4, 4))),
        lambda: intensity_range(np.ones((0, 4, 4))),
        lambda: fourier_ring_correlation(np.zeros((4, 4)), np.zeros((4, 5))),
        lambda: fourier_shell_correlation(np.zeros((4, 4, 4)), np.zeros((4, 4, 4)), (1.0, 1.0)),
        lambda: resolution(np.zeros(3), np.zeros(4), 0.1, 1.0),
        lambda: dice(np.ones(3, bool), np.ones(4, bool)),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(InputError):
        call()


# --- Fourier correlation ---


def textbook_frc(a, b):
    """The definition, ring by ring, of a square image."""
    n = len(a)
    k = np.fft.fftfreq(n) * n
    radius = np.hypot(*np.meshgrid(k, k, indexing="ij"))
    fa, fb = np.fft.fft2(a - a.mean()), np.fft.fft2(b - b.mean())
    curve = []
    for r in range(1, n // 2 + 1):
        ring = (radius >= r - 0.5) & (radius < r + 0.5)
        power = np.sum(np.abs(fa[ring]) ** 2) * np.sum(np.abs(fb[ring]) ** 2)
        curve.append(np.sum(fa[ring] * fb[ring].conj()).real / np.sqrt(power))
    return np.array(curve)


@pytest.mark.parametrize("n", [32, 33])
def test_square_images_have_the_textbook_rings(n):
    clean, noisy = images((n, n), noise=0.5)
    frequency, frc = fourier_ring_correlation(clean, noisy)
    assert frequency == pytest.approx(np.arange(1, n // 2 + 1) / n)
    assert frc == pytest.approx(textbook_frc(clean, noisy), abs=1e-12)
    weights = np.arange(1, n // 2 + 1)
    assert ring_weighted_mean(frc) == pytest.approx(np.sum(weights * frc) / weights.sum())


@pytest.mark.parametrize("shape", [(48, 71), (71, 48), (33, 20), (64, 9)])
def test_rectangular_rings_step_by_the_shortest_side_and_are_never_empty(shape):
    a, b = np.random.default_rng(1).standard_normal((2, *shape))
    frequency, frc = fourier_ring_correlation(a, b)
    assert frequency == pytest.approx(np.arange(1, min(shape) // 2 + 1) / min(shape))
    assert np.all(ring_counts(shape) >= 1)
    assert np.all(np.abs(frc) <= 1 + 1e-12)
    assert fourier_ring_correlation(a, a)[1] == pytest.approx(np.ones_like(frc))
    transposed = fourier_ring_correlation(a.T, b.T)[1]
    assert transposed == pytest.approx(frc, abs=1e-12)


def test_ring_counts_cover_the_whole_plane():
    k = np.fft.fftfreq(31) * 31
    radius = np.hypot(*np.meshgrid(k, k, indexing="ij"))
    expected = [np.sum((radius >= r - 0.5) & (radius < r + 0.5)) for r in range(1, 16)]
    assert ring_counts((31, 31)) == pytest.approx(expected)


def test_independent_noise_is_uncorrelated_within_its_statistics():
    a, b = np.random.default_rng(3).standard_normal((2, 256, 256))
    frc = fourier_ring_correlation(a, b)[1]
    scaled = frc * np.sqrt(ring_counts((256, 256)))  # n / 2 independent pairs: the variance is 1 / n
    assert np.std(scaled) == pytest.approx(1.0, abs=0.2)
    assert np.max(np.abs(scaled)) < 4.0


def test_equal_signal_and_noise_give_snr_over_one_plus_snr():
    rng = np.random.default_rng(4)
    signal, n1, n2 = rng.standard_normal((3, 256, 256))
    for snr in (0.25, 1.0, 4.0):
        frc = fourier_ring_correlation(signal * np.sqrt(snr) + n1, signal * np.sqrt(snr) + n2)[1]
        assert ring_weighted_mean(frc) == pytest.approx(snr / (1 + snr), abs=0.01)
        against_truth = fourier_ring_correlation(signal, signal * np.sqrt(snr) + n2)[1]
        assert ring_weighted_mean(against_truth) == pytest.approx(np.sqrt(snr / (1 + snr)), abs=0.01)


def test_shift_turns_the_correlation_into_a_bessel_function():
    from scipy.special import j0

    image = np.random.default_rng(5).standard_normal((256, 256))
    frequency, frc = fourier_ring_correlation(image, np.roll(image, 3, axis=1))
    inner = frequency > 0.04  # rings with enough samples
    assert np.max(np.abs(frc - j0(2 * np.pi * 3 * frequency))[inner]) < 0.15
    assert fourier_ring_correlation(image, -image)[1] == pytest.approx(-np.ones_like(frc))


def test_no_power_is_no_correlation():
    assert not fourier_ring_correlation(np.ones((16, 16)), np.ones((16, 16)))[1].any()


def test_shells_of_cubes_boxes_and_long_voxels():
    rng = np.random.default_rng(6)
    a, b = rng.standard_normal((2, 16, 20, 25))
    frequency, fsc = fourier_shell_correlation(a, b)
    assert frequency == pytest.approx(np.arange(1, 9) / 16)
    assert np.all(ring_counts((16, 20, 25)) > 0)
    assert np.all(np.abs(fsc) < 1)
    frequency, fsc = fourier_shell_correlation(a, a, (1.0, 0.5, 0.5))  # the sides are 16, 10 and 12.5
    assert frequency == pytest.approx(np.arange(1, 6) / 10)  # Nyquist of the longest edge
    assert fsc == pytest.approx(np.ones(5))


def test_half_bit_threshold_has_the_published_values():
    """van Heel & Schatz 2005: (0.2071 + 1.9102/√n) / (1.2071 + 0.9102/√n)."""
    counts = np.array([1.0, 8.0, 26.0, 100.0, 1e4, 1e14])
    root = 1 / np.sqrt(counts)
    published = (0.2071 + 1.9102 * root) / (1.2071 + 0.9102 * root)
    assert half_bit_threshold(counts) == pytest.approx(published, abs=1e-4)
    assert half_bit_threshold(np.array([1e14]))[0] == pytest.approx(0.1716, abs=1e-4)


def test_resolution_interpolates_the_first_crossing():
    frequency = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    curve = np.array([1.0, 0.8, 0.4, 0.0, 0.9])
    assert resolution(frequency, curve, 0.5, 1e-7) == pytest.approx(1e-7 / 0.275)
    assert resolution(frequency, curve, np.full(5, 0.5), 1e-7) == pytest.approx(1e-7 / 0.275)
    assert resolution(frequency, np.ones(5), 0.5, 1e-7) is None
    assert resolution(frequency, np.zeros(5), 0.5, 1e-7) == math.inf


# --- volumes ---


def test_a_perfect_reconstruction_scores_perfectly():
    truth = sphere(Grid.centred((40, 36, 44), 1e-7), 1.2e-6)
    scores = volume_scores(truth, truth)
    assert scores.relative_error_delta == 0.0
    assert scores.relative_error_beta == 0.0
    assert scores.dice == 1.0
    assert scores.material_delta == pytest.approx(4e-7, rel=1e-6)
    assert scores.delta_deviation == pytest.approx(0.0)
    assert scores.ratio == pytest.approx(500.0, rel=1e-5)
    assert scores.resolution_fixed is None
    assert scores.fsc == pytest.approx(np.ones_like(scores.fsc))
    json.dumps([scores.as_dict(), scores.curves()], allow_nan=False)


def test_dice_of_two_spheres_is_the_lens():
    """Two spheres of radius R a distance d apart share π(4R + d)(2R - d)²/12 (Kern & Bland 1938)."""
    grid, r, d = Grid.centred((96, 96, 96), 1.0), 30.0, 20.0
    scores = volume_scores(sphere(grid, r, (d / 2, 0, 0)), sphere(grid, r, (-d / 2, 0, 0)))
    lens = math.pi * (4 * r + d) * (2 * r - d) ** 2 / 12
    assert scores.dice == pytest.approx(lens / (4 / 3 * math.pi * r**3), rel=2e-3)


def test_scaled_delta_and_beta_show_as_deviations():
    truth = sphere(Grid.centred((32, 32, 32), 1e-7), 1e-6)
    found = Volume(truth.delta * 0.9, truth.beta * 1.2, truth.grid)
    scores = volume_scores(found, truth)
    assert scores.relative_error_delta == pytest.approx(0.1, rel=1e-5)
    assert scores.relative_error_beta == pytest.approx(0.2, rel=1e-5)
    assert scores.delta_deviation == pytest.approx(-0.1, rel=1e-5)
    assert scores.beta_deviation == pytest.approx(0.2, rel=1e-5)
    assert scores.ratio == pytest.approx(500 * 0.75, rel=1e-5)
    assert scores.ratio_deviation == pytest.approx(-0.25, rel=1e-5)


def test_signed_and_absent_beta():
    truth = sphere(Grid.centred((32, 32, 32), 1e-7), 1e-6, delta=2.7e-8, ratio=-1800.0)
    scores = volume_scores(Volume(truth.delta, truth.beta * 1.5, truth.grid), truth)
    assert scores.true_ratio == pytest.approx(-1800.0, rel=1e-5)
    assert scores.beta_deviation == pytest.approx(0.5, rel=1e-5)
    empty = Volume(truth.delta, np.zeros_like(truth.beta), truth.grid)
    scores = volume_scores(empty, empty)
    assert scores.relative_error_beta is None
    assert scores.beta_deviation is None
    assert scores.ratio is None
    assert scores.ratio_deviation is None
    json.dumps(scores.as_dict(), allow_nan=False)


def test_negative_contrast_is_matter_too():
    truth = sphere(Grid.centred((32, 32, 32), 1e-7), 1e-6, delta=-3e-8)
    assert robust_material_delta(truth) == pytest.approx(-3e-8, rel=1e-5)
    assert volume_scores(truth, truth).dice == 1.0


def test_empty_reconstruction_resolves_nothing():
    truth = sphere(Grid.centred((32, 32, 32), 1e-7), 1e-6)
    zero = np.zeros_like(truth.delta)
    scores = volume_scores(Volume(zero, zero, truth.grid), truth)
    assert scores.dice == 0.0
    assert scores.relative_error_delta == 1.0
    assert scores.resolution_half_bit == math.inf
    assert scores.as_dict()["resolution_half_bit"] == "inf"


def test_blur_costs_resolution_in_metres():
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(7)
    grid = Grid.centred((64, 64, 64), 1e-7)
    signal = rng.standard_normal(grid.shape) + 5
    blurred = gaussian_filter(signal, 1.5, mode="wrap") + 0.05 * rng.standard_normal(grid.shape)
    scores = volume_scores(Volume(blurred, blurred * 0, grid), Volume(signal, signal * 0, grid))
    assert scores.pitch == 1e-7
    assert 2e-7 < scores.resolution_fixed < 6e-7
    assert scores.resolution_half_bit >= scores.resolution_fixed


def test_given_material_moves_the_threshold():
    truth = sphere(Grid.centred((32, 32, 32), 1e-7), 1e-6)
    half = Volume(truth.delta * 0.45, truth.beta, truth.grid)
    assert volume_scores(half, truth).dice == 0.0
    assert volume_scores(half, truth, material_delta=3e-7).dice > 0.9


def test_volumes_on_other_grids_or_without_matter_are_refused():
    truth = sphere(Grid.centred((16, 16, 16), 1e-7), 5e-7)
    with pytest.raises(InputError, match="one grid"):
        volume_scores(Volume(truth.delta, truth.beta, Grid.centred((16, 16, 16), 1.1e-7)), truth)
    with pytest.raises(InputError, match="no voxel"):
        volume_scores(truth, truth, material_delta=1.0)
    zero = Volume(np.zeros_like(truth.delta), truth.beta, truth.grid)
    with pytest.raises(InputError, match="zero everywhere"):
        volume_scores(truth, zero)


def test_flat_images_have_smooth_curves():
    """Cut objects leak along both axes; with rings of the long side's step the curve would oscillate here."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(8)
    image = gaussian_filter(rng.standard_normal((140, 128)), 3)[:40]
    image += 0.05 * image.std() * np.arange(40)[:, None]
    frc = fourier_ring_correlation(image, image + 0.1 * image.std() * rng.standard_normal(image.shape))[1]
    assert np.max(np.abs(np.diff(frc))) < 0.3
