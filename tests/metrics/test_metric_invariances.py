"""Properties of the scores for whatever images and volumes: symmetry, bounds, and what units do not change."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from helpers.strategies import images, numbers
from holosplat.geometry import Grid
from holosplat.metrics import dice, fourier_ring_correlation, image_scores, structural_similarity, volume_scores
from holosplat.metrics.images import fourier_shell_correlation, half_bit_threshold, peak_signal_to_noise, ring_counts
from holosplat.volume import Volume

SHAPES = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6))
LARGE = {"least": 11, "most": 20}
"""Images that hold at least one window of SSIM."""


@st.composite
def pairs(draw: st.DrawFn, least: int = 2, most: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Two images of one shape: the other one is independent, or partly the same."""
    first = draw(images(least, most))
    other = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).uniform(0, 1, first.shape)
    share = draw(numbers(0.0, 1.0))
    return first, share * first + (1 - share) * other


@st.composite
def volumes(draw: st.DrawFn) -> tuple[Volume, Volume]:
    """A body of 30 to 60 voxels in a box with uneven edges, and a noisy copy of it."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    grid = Grid((7, 6, 8), (1e-6, 2e-6, 1.5e-6), (0.0, 0.0, 0.0))
    inside = np.zeros(grid.shape)
    inside[2:5, 1:5, 2 : 5 + draw(st.integers(0, 2))] = 1
    rough = inside + 0.2 * draw(numbers(0.0, 1.0)) * random.standard_normal(grid.shape)
    return Volume(1e-7 * rough, 1e-10 * rough, grid), Volume(1e-7 * inside, 1e-10 * inside, grid)


# --- overlap ------------------------------------------------------------------------------------------------


@given(SHAPES.flatmap(lambda shape: st.tuples(arrays(bool, shape), arrays(bool, shape))))
def test_dice_is_symmetric_and_a_share(masks):
    a, b = masks
    assert dice(a, b) == dice(b, a)
    assert 0 <= dice(a, b) <= 1
    assert dice(a, a) == 1
    assert (dice(a, b) == 1) == bool((a == b).all())
    assert dice(a, ~a) == 0


@given(SHAPES.flatmap(lambda shape: st.tuples(arrays(bool, shape), arrays(bool, shape))), st.integers(0, 2))
def test_dice_does_not_know_where_a_voxel_lies(masks, axis):
    a, b = masks
    assert dice(np.flip(a, axis), np.flip(b, axis)) == dice(a, b)
    assert dice(a.ravel(), b.ravel()) == dice(a, b)


# --- images -------------------------------------------------------------------------------------------------


@given(pairs(**LARGE))
def test_structural_similarity_is_symmetric_and_at_most_one(pair):
    a, b = pair
    assert structural_similarity(a, b) == pytest.approx(structural_similarity(b, a), abs=1e-12)
    assert -1 - 1e-12 <= structural_similarity(a, b) <= 1 + 1e-12
    assert structural_similarity(a, a) == pytest.approx(1.0, abs=1e-12)
    assert structural_similarity(a.T, b.T) == pytest.approx(structural_similarity(a, b), abs=1e-12)


@given(pairs(), numbers(0.1, 10.0))
def test_twenty_decibels_more_for_a_tenth_of_the_error(pair, part):
    a, b = pair
    assume(float(np.abs(a - b).max()) > 1e-6)
    assert peak_signal_to_noise(a, b) == pytest.approx(peak_signal_to_noise(b, a), abs=1e-9)
    near = peak_signal_to_noise(a, a + part * (b - a))
    assert near == pytest.approx(peak_signal_to_noise(a, b) - 20 * np.log10(part), abs=1e-6)


@given(pairs(**LARGE), numbers(0.01, 100.0), numbers(-10.0, 10.0))
def test_scores_do_not_know_the_unit_of_intensity(pair, scale, offset):
    """Nor its zero: only the data range does, which comes from frames in the same unit."""
    predicted, measured = (image[None] for image in pair)
    plain = image_scores(predicted, measured, (0.0, 2.0))
    other = image_scores(scale * predicted + offset, scale * measured + offset, (offset, 2 * scale + offset))
    for name in ("ssim", "l1", "frcm", "frc"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), rtol=0, atol=1e-7, err_msg=name)
    assume(np.all(np.isfinite(plain.psnr)) and float(plain.l1.min()) > 1e-4)
    np.testing.assert_allclose(other.psnr, plain.psnr, rtol=1e-6)


# --- correlation --------------------------------------------------------------------------------------------


@given(pairs())
def test_ring_correlation_is_a_correlation(pair):
    a, b = pair
    frequency, curve = fourier_ring_correlation(a, b)
    assert bool((np.abs(curve) <= 1 + 1e-9).all())
    np.testing.assert_allclose(fourier_ring_correlation(b, a)[1], curve, rtol=0, atol=1e-9)
    assert len(frequency) == len(curve) == len(ring_counts(a.shape))
    assert 0 < frequency[-1] <= 0.5 + 1e-12
    assert bool((np.diff(frequency) > 0).all())


@given(images(), numbers(0.1, 10.0), numbers(-5.0, 5.0))
def test_an_image_correlates_fully_with_itself_in_any_unit(image, scale, offset):
    curve = fourier_ring_correlation(image, image)[1]
    found = fourier_ring_correlation(image, scale * image + offset)[1]
    np.testing.assert_allclose(found, curve, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fourier_ring_correlation(image, -scale * image)[1], -curve, rtol=0, atol=1e-9)
    assert set(np.round(curve, 9)) <= {0.0, 1.0}  # 0 where a ring holds no power


@given(pairs(), st.integers(-9, 9), st.integers(-9, 9))
def test_moving_both_images_alike_changes_no_correlation(pair, rows, columns):
    a, b = pair
    moved = [np.roll(image, (rows, columns), (0, 1)) for image in (a, b)]
    np.testing.assert_allclose(
        fourier_ring_correlation(*moved)[1], fourier_ring_correlation(a, b)[1], rtol=0, atol=1e-8
    )


@given(volumes(), numbers(0.1, 10.0))
def test_shells_depend_on_relative_edges_only(volume, scale):
    edges = np.array([1.0, 0.7, 0.9])
    found, true = (v.delta for v in volume)
    plain, other = (fourier_shell_correlation(found, true, s * edges)[1] for s in (1.0, scale))
    np.testing.assert_allclose(other, plain, rtol=0, atol=1e-9)


@given(st.integers(1, 10**7), st.integers(1, 10**7))
def test_more_samples_lower_the_threshold(first, second):
    fewer, more = half_bit_threshold(np.sort([first, second]))
    assert 0.17 < more <= fewer <= 1 + 1e-12


# --- volumes ------------------------------------------------------------------------------------------------


@given(volumes(), numbers(0.01, 100.0), st.sampled_from([1.0, -1.0]))
def test_volume_scores_are_relative(pair, scale, sign):
    """To the material's δ and β, whatever these are: also those of a void, which are negative."""
    scaled = [Volume(sign * scale * v.delta, sign * scale * v.beta, v.grid) for v in pair]
    plain, other = volume_scores(*pair), volume_scores(*scaled)
    for name in ("dice", "relative_error_delta", "relative_error_beta", "delta_deviation", "ratio", "fsc"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), rtol=1e-5, atol=1e-6, err_msg=name)
    assert other.material_delta == pytest.approx(sign * scale * plain.material_delta, rel=1e-6, abs=0)


@given(volumes())
def test_the_truth_scores_best(pair):
    found, true = pair
    best, other = volume_scores(true, true), volume_scores(found, true)
    assert (best.dice, best.relative_error_delta, best.delta_deviation) == (1.0, 0.0, 0.0)
    assert best.resolution_fixed is None
    assert other.dice <= 1
    assert other.relative_error_delta >= 0
