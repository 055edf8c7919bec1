"""Paganin's filter against other programs: hotopy, nabu, httomolib, and eq. 12 written out with numpy.

None of them is needed otherwise (two are under the GPL): install what is wanted beside the tests, or they are skipped.
Frames are periodic (bodies far from the border, filters without padding), so that padding is not what is compared.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.geometry import Grid, Views
from holosplat.model import measure
from holosplat.optics.retrieval import Linear, contrast_transfer, paganin, retrieve_thickness
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber
from holosplat.volume import Volume

ENERGY, PIXEL, DISTANCE = 20.0, 1e-6, 0.05  # keV, m, m
DELTA, BETA = 7.4e-7, 7.4e-9
SHAPE = (256, 256)
INNER = (slice(64, 192), slice(64, 192))
"""Where no filter feels the border."""


class Bump:
    """An object of Gaussian thickness, from every side."""

    def at(self, time: float) -> Bump:
        """Itself."""
        return self

    def project(self, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
        """β and δ times the thickness."""
        h, w = views.shape
        x, y = ((torch.arange(n, dtype=torch.float64) + 0.5 - n / 2) * views.pixel_size for n in (w, h))
        t = 20e-6 * torch.exp(-0.5 * ((x[None] - 7e-6) ** 2 + (y[:, None] + 4e-6) ** 2) / 6e-6**2)
        return (BETA * t)[None], (DELTA * t)[None]

    def voxelise(self, grid: Grid) -> Volume:
        """Never needed here."""
        raise NotImplementedError


@pytest.fixture(scope="module")
def taken() -> tuple[Exposures, torch.Tensor]:
    """One exposure of the bump and its frame [1, 256, 256], float64."""
    where = Exposures.of(Views.from_angles([0.0], SHAPE, PIXEL), ENERGY, DISTANCE)
    return where, measure(Bump(), where, 2, torch.float64)


def ours(taken: tuple[Exposures, torch.Tensor]) -> np.ndarray:
    """Thickness [m] by our plain filter, inside."""
    where, frames = taken
    found = paganin(frames, where, DELTA, BETA, options=Linear(noise=0.0))[0].numpy()
    same = retrieve_thickness(frames, PIXEL, where.distance, ENERGY, DELTA, BETA)[0].numpy()
    assert np.array_equal(found, same)
    assert found.max() > 15e-6
    return found[INNER]


def agree(mine: np.ndarray, theirs: np.ndarray, bound: float = 1e-3) -> None:
    """To `bound` of the largest value."""
    assert np.abs(mine - theirs).max() < bound * np.abs(mine).max()


def test_numpy(taken):
    """Paganin et al. (2002), eq. 12, as it stands there: `T = -1/μ ln F⁻¹[μ F[I] / (R₂ δ |k|² + μ)]`."""
    mu = 2 * wavenumber(ENERGY) * BETA
    k = 2 * np.pi * np.fft.fftfreq(SHAPE[0], PIXEL)
    k2 = k[:, None] ** 2 + k[None] ** 2
    frame = taken[1][0].numpy()
    theirs = -np.log(np.fft.ifft2(mu * np.fft.fft2(frame) / (DISTANCE * DELTA * k2 + mu)).real) / mu
    agree(ours(taken), theirs[INNER])


def test_hotopy(taken):
    """Its result is a phase, -kδT, for pixels of one Fresnel number."""
    holo = pytest.importorskip("hotopy.holo")
    fresnel = PIXEL**2 / (wavelength(ENERGY) * DISTANCE)
    phase = holo.Paganin(SHAPE, fresnel, BETA / DELTA)(taken[1][0].numpy())
    agree(ours(taken), -np.asarray(phase)[INNER] / (wavenumber(ENERGY) * DELTA))


def test_hotopy_contrast_transfer(taken):
    """Two-level regularisation off, noise off: the same linear inverse, of a bump too weak for the square to count."""
    holo = pytest.importorskip("hotopy.holo")
    where, frames = taken
    weak = 1 + 1e-4 * (frames - 1)
    fresnel = PIXEL**2 / (wavelength(ENERGY) * DISTANCE)
    phase = holo.CTF(SHAPE, fresnel, alpha=1e-12, betadelta=BETA / DELTA, dtype=torch.float64)(weak.numpy())
    theirs = np.asarray(phase).reshape(SHAPE)[INNER] / (wavenumber(ENERGY) * DELTA)
    options = Linear(noise=0.0, model_error=1e-6)
    mine = contrast_transfer(weak, where, DELTA, BETA, options=options)[0].numpy()[INNER]
    agree(mine, -theirs)


def test_nabu(taken):
    """Its result is the contact image."""
    phase = pytest.importorskip("nabu.preproc.phase")
    filtering = phase.PaganinPhaseRetrieval(
        SHAPE, distance=DISTANCE, energy=ENERGY, delta_beta=DELTA / BETA, pixel_size=PIXEL
    )
    contact = np.asarray(filtering.apply_filter(taken[1][0].numpy().astype(np.float32)))
    agree(ours(taken), -np.log(contact[INNER]) / (2 * wavenumber(ENERGY) * BETA))


def test_httomolib(taken):
    """After TomoPy's: centimetres, and a result of μT. Its frequencies run to twice Nyquist's, so its parameter is
    4β/δ; and none of them is zero (they are spread over N - 1), whence the wider bound."""
    prep = pytest.importorskip("httomolib.prep.phase")
    found = prep.paganin_filter(
        taken[1].numpy(),
        pixel_size=PIXEL * 1e2,
        dist=DISTANCE * 1e2,
        energy=ENERGY,
        alpha=4 * BETA / DELTA,
    )
    agree(ours(taken), np.asarray(found)[0][INNER] / (2 * wavenumber(ENERGY) * BETA), 1e-2)
