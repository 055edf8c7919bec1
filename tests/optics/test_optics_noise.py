"""How noisy frames are, by the frames alone."""

from __future__ import annotations

import pytest
import torch

from holosplat.optics.noise import noise_level, noise_levels, noise_share, sure_noise, wavelet_noise


def noise(shape: tuple[int, int, int], sigma: float, seed: int = 0) -> torch.Tensor:
    return sigma * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def stripes(shape: tuple[int, int, int], period: float) -> torch.Tensor:
    """Fringes that fill the frames."""
    return torch.sin(2 * torch.pi * torch.arange(shape[2]) / period).expand(shape)


@pytest.mark.parametrize("shape", [(2, 96, 96), (2, 81, 117)])
def test_the_noise_of_each_frame_is_found_beside_an_object(shape):
    frames = torch.ones(shape)
    frames[:, 20:60, 30:70] += 0.2 * stripes((2, 40, 40), 6)
    sigmas = torch.tensor([0.01, 0.04])
    found = noise_levels(frames + sigmas[:, None, None] * noise(shape, 1.0))
    assert found.dtype == torch.float64
    assert found.numpy() == pytest.approx(sigmas.numpy(), rel=0.12)


def test_of_two_estimates_the_lesser_is_taken():
    """Fine fringes over most of a frame mislead the wavelets, small frames without a quiet tile the tiles."""
    crowded = torch.ones(1, 96, 96)
    crowded[:, :, :70] += 0.1 * stripes((1, 96, 70), 3.3) * stripes((1, 70, 96), 3.7).mT
    assert float(noise_levels(crowded)) < 0.1 * float(wavelet_noise(crowded))
    small = 1 + 0.1 * stripes((1, 13, 12), 2.2) * stripes((1, 12, 13), 2.2).mT
    assert float(noise_levels(small)) == float(wavelet_noise(small)) < noise_level(small)


@pytest.mark.parametrize("shape", [(2, 96, 96), (2, 81, 117)])
def test_what_is_surely_noise_is_noise_and_never_fringes(shape):
    fringes = torch.ones(shape)
    fringes[:, :, :70] += 0.1 * stripes((2, shape[1], 70), 3.3) * stripes((2, 70, shape[1]), 3.7).mT
    assert float(sure_noise(fringes).max()) == 0
    assert float(wavelet_noise(fringes).min()) > 0.01
    for sigma in (0.01, 0.04):
        found = sure_noise(1 + noise(shape, sigma)).numpy()
        assert found == pytest.approx(sigma, rel=0.2)
        assert (found <= noise_levels(1 + noise(shape, sigma)).numpy()).all()


def test_noise_is_surely_there_as_far_as_both_estimates_agree():
    """Faint fine fringes beside it leave less of it, strong ones nothing, although the quiet part is as noisy."""
    shape, sigma = (1, 96, 128), 0.02
    fringes = stripes(shape, 2.0 * (1 + 5**0.5)) * stripes((1, shape[2], shape[1]), 5.3).mT
    fringes[:, :, :40] = 0
    found = []
    for height in (0.0, 0.06, 0.3):
        frames = 1 + noise(shape, sigma) + height * fringes
        found.append(float(sure_noise(frames)))
        assert float(noise_levels(frames)) == pytest.approx(sigma, rel=0.2)
    assert 0.2 * found[0] < found[1] < 0.9 * found[0]
    assert found[2] == 0


def test_the_share_of_the_contrast_that_is_noise():
    assert noise_share(torch.ones(2, 20, 24)) == 0
    assert noise_share(1 + noise((3, 64, 70), 0.02)) == pytest.approx(1.0, abs=0.15)
    smooth = 1 + 0.1 * stripes((2, 64, 70), 40) * stripes((2, 70, 64), 40).mT
    assert noise_share(smooth) < 0.05
    half = float((smooth - 1).square().mean().sqrt())
    assert noise_share(smooth + noise(smooth.shape, half)) == pytest.approx(2**-0.5, rel=0.15)
