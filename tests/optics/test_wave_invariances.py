"""Properties of the waves and of the frames for whatever object: phase, steps, composition, energy and flux."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from helpers.strategies import images, numbers, vectors
from holosplat.optics.hologram import hologram, optical_path
from holosplat.optics.propagation import (
    bin_pixels,
    exit_wave,
    exit_wave_minus_one,
    fresnel_factors,
    fresnel_propagate,
    fresnel_transfer,
    gaussian_factors,
)
from holosplat.optics.resampling import Resampling, between
from holosplat.optics.sampling import smooth_margin
from holosplat.units import wavelength, wavenumber

ENERGY, PITCH = 20.0, 0.5e-6
SAMPLES = st.sampled_from([5, 6, 9, 12, 15, 20])
RASTERS = st.tuples(SAMPLES, SAMPLES)
SHARES = numbers(-1.0, 1.0)
"""Distances as a share of the longest one at which the raster keeps all frequencies."""


def longest(raster: tuple[int, int]) -> float:
    """The distance [m] at which the highest frequency travels half the shorter side: nothing is cut up to there."""
    return min(raster) * PITCH**2 / wavelength(ENERGY)


def at(raster: tuple[int, int], share: float) -> np.ndarray:
    return np.array([share * longest(raster)])


def wave_of(image: np.ndarray) -> Tensor:
    """A complex wave [1, H, W] whose phase goes all round."""
    return torch.from_numpy(image * np.exp(7j * np.roll(image, 1, axis=1)))[None]


def lines_of(loss: np.ndarray | float, phase: np.ndarray, dtype: torch.dtype = torch.float64) -> Tensor:
    """Two channels [1, 2, H, W]: of absorption and of phase, in nepers and radians."""
    return torch.from_numpy(np.stack([loss + 0 * phase, phase])[None]).to(dtype)


MATTER = ((0.0, 1.0), (1.0, 0.0))
"""`(k δ, k β)` of the channels of `lines_of`."""


@pytest.fixture(params=["cpu", "reference"])
def frames(request):
    """Frames of lines [1, 2, H, W] at a share of the longest distance: binned by `factor`, without a margin.

    Not by Triton, whose interpreter takes too long for so many; its frames are compared with the reference's elsewhere.
    """
    backend = request.param
    dtype = torch.float64 if backend == "reference" else torch.float32

    def act(lines: Tensor, share: float, factor: int = 1, blur: float = 0.0) -> Tensor:
        raster = (lines.shape[2], lines.shape[3])
        frame = ((raster[0] // factor, raster[1] // factor), (0, 0), factor)
        path = optical_path(raster, PITCH, ENERGY, at(raster, share), np.array([blur]), frame, dtype)
        return hologram(lines.to(dtype), MATTER, path, backend).double()

    act.tolerance = 1e-10 if backend == "reference" else 2e-5  # type: ignore[attr-defined]
    return act


# --- exit waves and free space ------------------------------------------------------------------------------


@given(images(), vectors(0.0, 1e-7, 4))
def test_the_wave_behind_two_objects_is_the_product(image, lengths):
    one, other = torch.from_numpy(image), torch.from_numpy(image[::-1].copy())
    (b, d), (c, e) = lengths.reshape(2, 2)
    together = exit_wave(b * one + c * other, d * one + e * other, ENERGY)
    product = exit_wave(b * one, d * one, ENERGY) * exit_wave(c * other, e * other, ENERGY)
    assert torch.allclose(together, product, rtol=0, atol=1e-9)


@given(images(high=1e-7))
def test_an_object_that_takes_no_light_turns_phases_only(image):
    """And the wave minus one is the wave, minus one."""
    D = torch.from_numpy(image)
    wave = exit_wave(torch.zeros_like(D), D, ENERGY)
    assert torch.allclose(wave.abs(), torch.ones_like(D), rtol=0, atol=1e-12)
    assert torch.allclose(wave, torch.exp(-1j * wavenumber(ENERGY) * D), rtol=0, atol=1e-9)
    assert torch.allclose(wave - 1, exit_wave_minus_one(torch.zeros_like(D), D, ENERGY), rtol=0, atol=1e-12)


@given(RASTERS, SHARES, SHARES)
def test_two_distances_add_up(raster, first, second):
    """Where neither way, nor the whole of it, cuts a frequency."""
    shares = np.array([first, second, first + second]) / 2
    one, other, both = fresnel_transfer(raster, PITCH, shares * longest(raster), ENERGY, torch.complex128)
    assert torch.allclose(one * other, both, rtol=0, atol=1e-9)


@given(images(least=5), SHARES)
def test_free_space_keeps_energy_and_leads_back(image, share):
    raster = image.shape
    wave = wave_of(image)
    there, back = (fresnel_transfer(raster, PITCH, at(raster, s), ENERGY, torch.complex128) for s in (share, -share))
    moved = fresnel_propagate(wave, there)
    energy = float(wave.abs().square().sum())
    assert float(moved.abs().square().sum()) == pytest.approx(energy, rel=1e-9, abs=1e-15)
    assert torch.allclose(fresnel_propagate(moved, back), wave, rtol=0, atol=1e-9)


@given(RASTERS, numbers(1.0, 40.0))
def test_a_longer_way_only_cuts(raster, share):
    """Transfer functions are phases, or nothing where the frequency would leave the raster; never at frequency 0."""
    lam_z = torch.from_numpy(wavelength(ENERGY) * at(raster, share))
    for factor in fresnel_factors(raster, PITCH, lam_z, torch.complex128):
        size = factor.abs()[0]
        assert bool((((size - 1).abs() < 1e-12) | (size == 0)).all())
        assert complex(factor[0, 0]) == 1


@given(RASTERS, numbers(0.0, 3.0), numbers(0.0, 3.0))
def test_blurs_add_in_squares(raster, first, second):
    sigmas = torch.tensor([first, second, np.hypot(first, second)], dtype=torch.float64)
    for factors in gaussian_factors(raster, sigmas, torch.float64):
        assert torch.allclose(factors[0] * factors[1], factors[2], rtol=0, atol=1e-12)
        assert factors[:, 0].tolist() == [1.0, 1.0, 1.0]


# --- frames -------------------------------------------------------------------------------------------------


@given(image=images(least=4, most=12), share=SHARES, phase=numbers(-3.0, 3.0))
def test_a_phase_all_over_is_not_seen(frames, image, share, phase):
    plain, turned = (frames(lines_of(0.1 * image, image + extra), share) for extra in (0.0, phase))
    assert float((plain - turned).abs().max()) < frames.tolerance * max(1.0, float(plain.max()))


@given(image=images(least=4, most=12), share=SHARES, loss=numbers(0.0, 1.0))
def test_absorption_all_over_darkens_evenly(frames, image, share, loss):
    plain, darker = (frames(lines_of(extra, image), share) for extra in (0.0, loss))
    assert float((darker - np.exp(-2 * loss) * plain).abs().max()) < 2 * frames.tolerance * float(plain.max())


@given(
    image=images(least=3, most=6),
    share=SHARES,
    factor=st.integers(1, 3),
    step=st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    blur=st.sampled_from([0.0, 0.7]),
)
def test_a_step_of_whole_pixels_moves_the_frame(frames, image, share, factor, step, blur):
    image = np.kron(image, np.ones((factor, factor))) * np.linspace(0.5, 1.0, image.shape[1] * factor)
    still = frames(lines_of(0.2 * image, image), share, factor, blur)
    moved_image = np.roll(image, (factor * step[0], factor * step[1]), (0, 1))
    moved = frames(lines_of(0.2 * moved_image, moved_image), share, factor, blur)
    wanted = torch.roll(still, step, (-2, -1))
    assert float((moved - wanted).abs().max()) < frames.tolerance * max(1.0, float(still.max()))


@given(image=images(least=3, most=6), share=SHARES, factor=st.integers(1, 3), blur=numbers(0.0, 2.0))
def test_where_nothing_is_absorbed_no_light_is_lost(frames, image, share, factor, blur):
    """The frame's mean is 1: at any distance, with any blur, on any pixels."""
    fine = np.kron(image, np.ones((factor, factor))) + 0.3 * np.arange(image.shape[0] * factor)[:, None]
    assert float(frames(lines_of(0.0, fine), share, factor, blur).mean()) == pytest.approx(1.0, abs=frames.tolerance)


@given(image=images(least=4, most=12), share=SHARES)
def test_an_image_turned_over_gives_the_frame_turned_over(frames, image, share):
    turned = np.ascontiguousarray(image[::-1, ::-1])
    plain, other = (frames(lines_of(0.1 * a, a), share) for a in (image, turned))
    wanted = plain.flip(-1, -2)
    assert float((other - wanted).abs().max()) < frames.tolerance * max(1.0, float(plain.max()))


# --- rasters ------------------------------------------------------------------------------------------------


@given(images(least=1, most=8), st.integers(1, 4))
def test_binning_keeps_the_mean(image, factor):
    fine = torch.from_numpy(np.kron(image, np.ones((factor, factor))))[None]
    assert torch.allclose(bin_pixels(fine, factor)[0], torch.from_numpy(image), rtol=0, atol=1e-12)


@given(images(least=1, most=8), st.integers(1, 4))
def test_denser_samples_keep_the_mean(image, factor):
    dense = between(torch.from_numpy(image), factor)
    assert float(dense.mean()) == pytest.approx(float(image.mean()), rel=0, abs=1e-12)


@given(st.integers(0, 4), st.integers(0, 6), st.integers(1, 4))
def test_denser_samples_show_a_cosine_as_it_is(down, across, factor):
    """Of a field of 5 × 7 pixels, with antinodes at its edges."""

    def sampled(finer: int) -> Tensor:
        y, x = ((torch.arange(n * finer, dtype=torch.float64) + 0.5) / (n * finer) for n in (5, 7))
        return torch.cos(np.pi * down * y)[:, None] * torch.cos(np.pi * across * x)

    assert torch.allclose(between(sampled(1), factor), sampled(factor), rtol=0, atol=1e-12)


@given(images(least=4), numbers(0.3, 3.0), numbers(-2.0, 2.0), numbers(-2.0, 2.0))
def test_resampling_is_linear_and_keeps_even_light(image, ratio, scale, offset):
    shape = (max(1, int(image.shape[0] / ratio)), max(1, int(image.shape[1] / ratio)))
    to = Resampling(image.shape, PITCH, shape, ratio * PITCH)
    np.testing.assert_allclose(to(scale * image + offset), scale * to(image) + offset, rtol=0, atol=1e-9)


@given(st.integers(1, 3000), st.integers(0, 500))
def test_a_margin_is_the_least_with_a_fast_length(length, margin):
    def fast(n: int) -> bool:
        for p in (2, 3, 5):
            while n % p == 0:
                n //= p
        return n == 1

    found = smooth_margin(length, margin)
    assert found >= margin
    assert fast(length + 2 * found)
    assert not any(fast(length + 2 * m) for m in range(margin, found))
