"""The angular spectrum where Fresnel's kernel fails: closed forms, its order, the rule, backends and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.geometry import Views
from holosplat.optics.hologram import OpticalPath, hologram, optical_path
from holosplat.optics.propagation import (
    angular_spectrum_factor,
    beyond_paraxial,
    fresnel_factors,
    needs_angular_spectrum,
)
from holosplat.optics.retrieval.spectra import Raster, fresnel_phase
from holosplat.optics.sampling import padding
from holosplat.scan import Exposures
from holosplat.units import photon_energy

DOUBLE = torch.float64
LAMBDA = 0.4e-6
RASTER = (61, 75)


def one(value: float) -> Tensor:
    return torch.tensor([value], dtype=DOUBLE)


def transfer(raster: tuple[int, int], pitch: float, lam: float, z: float) -> Tensor:
    """The angular spectrum [H, W]."""
    rows, columns = fresnel_factors(raster, pitch, one(lam * z), torch.complex128)
    rest = angular_spectrum_factor(raster, pitch, one(lam), one(z), torch.complex128)
    return (rows[:, :, None] * columns[:, None] * rest)[0]


def test_a_wave_on_the_axis_is_that_of_rayleigh_and_sommerfeld():
    """Their first integral (Goodman 2005, eq. 3-40) of a round Gaussian is one over the radius; Fresnel's is not it."""
    w, z, pitch, k = 0.9 * LAMBDA, 8 * LAMBDA, LAMBDA / 3, 2 * np.pi / LAMBDA
    rho = np.linspace(0, 12 * w, 200_001)
    r = np.hypot(rho, z)
    kernel = z / r * (1 / r - 1j * k) * np.exp(1j * k * (r - z)) / r
    wanted = np.trapezoid(np.exp(-(rho**2) / (2 * w**2)) * kernel * rho, rho)
    raster = (301, 333)
    y, x = (pitch * (np.arange(n) - n // 2) for n in raster)
    wave = torch.fft.fft2(torch.from_numpy(np.exp(-(y[:, None] ** 2 + x**2) / (2 * w**2))))
    found = torch.fft.ifft2(wave * transfer(raster, pitch, LAMBDA, z))[raster[0] // 2, raster[1] // 2]
    rows, columns = fresnel_factors(raster, pitch, one(LAMBDA * z), torch.complex128)
    paraxial = torch.fft.ifft2(wave * rows[0][:, None] * columns[0])[raster[0] // 2, raster[1] // 2]
    assert abs(complex(found) - wanted) < 1e-6 * abs(wanted)
    assert abs(complex(paraxial) - wanted) > 0.01 * abs(wanted)


def test_the_phase_is_that_of_the_root_and_of_fourth_order():
    """Against extended precision; its leading term is πλ³z f⁴/4, and what follows falls by 16 as λ halves."""
    f2 = torch.tensor([[0.0, 1e10, 4e11], [1e12, 3e12, 5e12]], dtype=DOUBLE)
    rest = []
    for lam in (LAMBDA / 2, LAMBDA / 4, LAMBDA / 8):
        z = 1e-11 / lam
        s = np.longdouble(lam) ** 2 * f2.numpy().astype(np.longdouble)
        exact = -2 * np.longdouble(np.pi) * z / lam * (np.sqrt(1 - s) - 1 + s / 2)
        found = beyond_paraxial(f2, one(lam), one(z))[0]
        assert np.abs(found.numpy() - exact).max() < 1e-9
        rest.append((found - 0.25 * np.pi * lam**3 * z * f2**2)[1, 2])
    assert float(rest[0] / rest[1]) == pytest.approx(16, rel=0.12)
    assert float(rest[1] / rest[2]) == pytest.approx(16, rel=0.03)


def test_two_ways_are_one_and_back_again_is_none():
    pitch, forth = 0.5e-6, transfer(RASTER, 0.5e-6, LAMBDA, 3e-6)
    twice, back = transfer(RASTER, pitch, LAMBDA, 6e-6), transfer(RASTER, pitch, LAMBDA, -3e-6)
    assert torch.allclose(forth**2, twice, atol=1e-10)
    assert torch.allclose(forth * back, torch.ones_like(forth), atol=1e-10)


def test_waves_finer_than_the_wavelength_fade():
    found = transfer(RASTER, 0.1e-6, LAMBDA, 1e-6)
    fy, fx = (np.fft.fftfreq(n, 0.1e-6) for n in RASTER)
    fine = torch.from_numpy(fy[:, None] ** 2 + fx**2 > LAMBDA**-2)
    assert 0 < int(fine.sum()) < fine.numel()
    assert not found[fine].any()
    assert found.isfinite().all()


@pytest.mark.parametrize(
    ("lam", "pitch", "z", "needed"),
    [
        (6.2e-11, 1.6e-6, 0.1, False),  # 20 keV, pixels of 1.6 µm
        (7.3e-11, 25e-9, 5e-3, True),  # nano-holotomography at 17 keV
        (0.4e-6, 0.5e-6, 1e-4, True),  # cells in light
        (0.4e-6, 0.5e-6, 0.0, False),
    ],
)
def test_the_sampling_chooses_the_kernel(lam, pitch, z, needed):
    assert needs_angular_spectrum((300, 301), pitch, np.array([lam]), np.array([z])) is needed


def a_path(dtype: torch.dtype, distance: Tensor | np.ndarray, exact: bool | None = None) -> OpticalPath:
    """Four views of 9 × 13 pixels in an odd, rectangular raster, in light."""
    frame = ((9, 13), (7, 8), 1)
    return optical_path((23, 29), 0.5e-6, photon_energy(LAMBDA), distance, np.zeros(4), frame, dtype, exact=exact)


DISTANCES = np.array([3e-6, 5e-6, 3e-6, 4e-6])


@pytest.mark.parametrize("made", ["array", "tensor"])
@pytest.mark.parametrize("index", [[0, 1, 2, 3], [2, 1], [3]])
def test_frames_and_gradients_of_the_cpu_are_those_of_the_reference(made, index):
    draw, at = torch.Generator().manual_seed(0), torch.tensor(index)
    lines = torch.randn(4, 1, 23, 29, generator=draw, dtype=DOUBLE)[at]
    weights = torch.randn(len(index), 9, 13, generator=draw, dtype=DOUBLE)

    def found(backend: str, dtype: torch.dtype) -> tuple[Tensor, ...]:
        leaf = lines.to(dtype).requires_grad_()
        z = torch.from_numpy(DISTANCES).requires_grad_()
        path = a_path(dtype, z if made == "tensor" else DISTANCES)[at]
        frames = hologram(leaf, [(0.7, 0.02)], path, backend)
        wanted = [leaf, z] if made == "tensor" else [leaf]
        gradients = torch.autograd.grad((frames.double() * weights).sum(), wanted)
        return frames.detach(), *gradients

    for cpu, reference in zip(found("cpu", torch.float32), found("reference", DOUBLE)):
        assert (cpu.double() - reference).abs().max() < 5e-5 * reference.abs().max()


def test_gradients_of_the_gpu_are_those_of_the_reference(gpu):
    draw = torch.Generator().manual_seed(0)
    lines, weights = (torch.randn(2, *shape, generator=draw, dtype=DOUBLE) for shape in ((1, 5, 9), (3, 5)))

    def found(backend: str, dtype: torch.dtype) -> tuple[Tensor, ...]:
        leaf = lines.to(gpu, dtype).requires_grad_()
        z = torch.tensor([3e-6, 5e-6], dtype=DOUBLE, device=gpu).requires_grad_()
        frame = ((3, 5), (1, 2), 1)
        path = optical_path((5, 9), 0.5e-6, photon_energy(LAMBDA), z, np.zeros(2), frame, dtype)
        assert path.beyond is not None
        frames = hologram(leaf, [(0.7, 0.02)], path, backend)
        return frames.detach(), *torch.autograd.grad((frames.double() * weights.to(gpu)).sum(), [leaf, z])

    for cuda, reference in zip(found("cuda", torch.float32), found("reference", DOUBLE)):
        assert (cuda.double() - reference).abs().max() < 1e-4 * reference.abs().max()


def test_gradients_of_distances_are_differences():
    lines = torch.randn(4, 1, 23, 29, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    weights = torch.randn(4, 9, 13, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)

    def score(z: Tensor, corrected: bool = False) -> Tensor:
        path = a_path(DOUBLE, 2 * DISTANCES).corrected(z) if corrected else a_path(DOUBLE, z)
        return (hologram(lines, [(0.7, 0.02)], path, "reference") * weights).sum()

    z = torch.from_numpy(DISTANCES).requires_grad_()
    (gradient,) = torch.autograd.grad(score(z), z)
    step = 1e-11
    for view in range(4):
        ends = [float(score(z.detach() + sign * step * torch.eye(4, dtype=DOUBLE)[view])) for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float(gradient[view]), rel=1e-5)
    assert torch.allclose(score(z, corrected=True), score(z))
    plain = a_path(DOUBLE, DISTANCES, exact=False)
    assert (hologram(lines, [(0.7, 0.02)], plain, "reference") * weights).sum() != pytest.approx(
        float(score(z.detach())), rel=1e-3
    )


def test_retrieval_knows_the_phase_of_the_angular_spectrum():
    """`χ = k z (1 - √(1 - λ²f²))` of the contrast transfer function."""
    exposures = Exposures.of(Views.evenly_spaced(1, shape=(9, 13), pixel_size=0.5e-6), photon_energy(LAMBDA), 5e-5)
    raster = Raster((9, 13), 0.5e-6)
    fy, fx = raster.frequencies
    wanted = 2 * np.pi * 5e-5 / LAMBDA * (1 - np.sqrt(1 - LAMBDA**2 * (fy**2 + fx**2)))
    assert fresnel_phase(exposures, raster)[0].numpy() == pytest.approx(wanted, rel=1e-9)


def test_a_raster_holds_what_travels_at_steep_angles():
    """Pixels of λ/1.8: sin θ = 0.9, so that light goes twice as far as z sin θ."""
    views = Views.evenly_spaced(1, shape=(201, 301), pixel_size=LAMBDA / 1.8)
    margin = padding(Exposures.of(views, photon_energy(LAMBDA), 20 * LAMBDA / 1.8), 1)
    assert min(margin) >= 20 * 0.9 / np.sqrt(1 - 0.81)
