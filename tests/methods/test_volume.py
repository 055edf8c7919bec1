"""A smooth volume of continuous matter: better than its start, in noise and without, and the mass that frames know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import HolographicVoxels, SmoothVolume, Task, solve
from holosplat.methods.volume import binning, noise_of_binned
from holosplat.optics.noise_model import NoiseModel
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.soft_matter import soft_cells

PIXEL, SHAPE = 1e-6, (41, 45)
MATERIAL = DeltaBeta(6e-7, 4e-10)
RATIO = MaterialPrior.of_ratio(1500.0)


def cells() -> ContinuousScene:
    """Two soft cells that fit the detector in every view."""
    return soft_cells(2, (15 * PIXEL, 18 * PIXEL), (40e-6, 38e-6, 40e-6), MATERIAL, seed=3, edge=3 * PIXEL)


@pytest.fixture(scope="module")
def quiet() -> Scan:
    """Eight views without noise."""
    exposures = Exposures.of(Views.evenly_spaced(8, SHAPE, PIXEL), 20.0, 0.05)
    return simulate(cells(), exposures, is_test=np.zeros(8, dtype=bool))


def noisy(scan: Scan, sigma: float, seed: int) -> Scan:
    """The scan with photon noise of relative standard deviation `sigma`."""
    counts = np.random.default_rng(seed).poisson(scan.frames / sigma**2)
    return replace(scan, frames=(counts * sigma**2).astype(np.float32))


def judged(found, scan: Scan) -> tuple[float, float]:
    """Relative error of δ, and the total over the true one."""
    grid = Grid.of_views(scan.views)
    true, delta = (np.asarray(o.voxelise(grid).delta, dtype=np.float64) for o in (cells(), found))
    return float(np.linalg.norm(delta - true) / np.linalg.norm(true)), float(delta.sum() / true.sum())


def test_it_is_better_than_the_start_without_noise(quiet):
    task = Task(quiet, RATIO)
    error, total = judged(solve(SmoothVolume(), task), quiet)
    start, _ = judged(solve(HolographicVoxels(), task), quiet)
    assert error < min(0.05, start)
    assert total == pytest.approx(1.0, abs=0.05)


def test_noise_of_half_the_contrast_keeps_the_mass(quiet):
    """Of eight small views, to 15 %."""
    contrast = float(np.sqrt(np.square(quiet.frames - 1).mean()))
    scan = noisy(quiet, 0.5 * contrast, 1)
    error, total = judged(solve(SmoothVolume(), Task(scan, RATIO)), scan)
    start, _ = judged(solve(HolographicVoxels(), Task(scan, RATIO)), scan)
    assert error < min(0.15, 0.5 * start)
    assert total == pytest.approx(1.0, abs=0.15)


def test_large_frames_are_binned(quiet):
    assert binning(quiet, 10**9) == 1
    assert quiet.binned(binning(quiet, 20_000)).views.shape == (20, 22)


def test_effort_is_a_share_of_the_iterations():
    assert SmoothVolume().with_effort(0.5).iterations == SmoothVolume().iterations // 2
    with pytest.raises(InputError, match="coarser must be"):
        SmoothVolume(coarser=(2, 4))
    with pytest.raises(InputError, match="rounds must"):
        SmoothVolume(rounds=-1)


def test_noise_of_binned_frames_is_that_of_their_means():
    """White noise and grain of two pixels: the spectra agree with those of binned noise."""
    generator = torch.Generator().manual_seed(5)
    white = torch.randn(400, 24, 30, generator=generator, dtype=torch.float64)
    fy, fx = torch.fft.fftfreq(24).double()[:, None], torch.fft.rfftfreq(30).double()
    shape = torch.exp(-80 * (fy**2 + fx**2))
    grain = torch.fft.irfft2(
        torch.fft.rfft2(torch.randn(400, 24, 30, generator=generator).double()) * shape, s=(24, 30)
    )
    frames = 0.3 * white + grain
    noise = NoiseModel(torch.full((1,), 0.3, dtype=torch.float64), (shape**2)[None], 30)
    binned = frames.reshape(400, 12, 2, 15, 2).mean(dim=(2, 4))
    power = torch.fft.rfft2(binned, norm="ortho").abs().square().mean(dim=0)
    found = noise_of_binned(noise, 2)
    assert found.shape == (12, 15)
    low = (slice(0, 3), slice(0, 3))
    np.testing.assert_allclose(found.power()[0][low].numpy(), power[low].numpy(), rtol=0.3)
    assert float(found.power().mean()) == pytest.approx(float(power.mean()), rel=0.15)
