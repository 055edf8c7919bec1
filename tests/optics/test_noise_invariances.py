"""The estimates of noise in other units, and on images turned over: they are a standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers.strategies import images, numbers
from holosplat.optics.noise import noise_level, noise_levels, noise_share, wavelet_noise

FRAMES = images(least=6, most=40)
PER_FRAME = [noise_levels, wavelet_noise, lambda frames: torch.tensor([noise_level(frames)])]


@pytest.mark.parametrize("estimate", PER_FRAME, ids=["noise_levels", "wavelet_noise", "noise_level"])
@given(image=FRAMES, scale=numbers(0.01, 100.0), offset=numbers(-10.0, 10.0))
def test_noise_has_the_unit_of_the_frame(estimate, image, scale, offset):
    frames = torch.from_numpy(image)[None]
    plain, other = estimate(frames), estimate(scale * frames + offset)
    assert float(other[0]) == pytest.approx(scale * float(plain[0]), rel=1e-5, abs=1e-6)
    assert float(estimate(-frames)[0]) == pytest.approx(float(plain[0]), rel=1e-6, abs=1e-9)


@given(FRAMES)
def test_wavelets_do_not_know_which_way_up_a_frame_is(image):
    turned = [image, image[::-1], image[:, ::-1], image.T]
    levels = [float(wavelet_noise(torch.from_numpy(np.ascontiguousarray(a))[None])[0]) for a in turned]
    assert levels == pytest.approx([levels[0]] * 4, rel=1e-9, abs=1e-12)


@given(FRAMES, numbers(0.1, 10.0))
def test_the_share_of_noise_has_no_unit(image, scale):
    """It is that of the contrast about 1, of which it cannot be more than all."""
    frames = torch.from_numpy(image)[None]
    share = noise_share(frames)
    assert 0 <= share <= 1
    assert noise_share(1 + scale * (frames - 1)) == pytest.approx(share, rel=1e-5, abs=1e-6)


@given(st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_each_frame_has_its_own_noise(count, seed):
    frames = torch.from_numpy(np.random.default_rng(seed).normal(1, 0.1, (count, 20, 24)))
    together = noise_levels(frames)
    assert together.tolist() == [float(noise_levels(frame[None])[0]) for frame in frames]
