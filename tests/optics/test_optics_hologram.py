"""The wave optics in one operation: the hand-written adjoint against autograd in float64, on every path through it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat import native
from holosplat.checks import InputError
from holosplat.optics.hologram import OpticalPath, hologram, optical_path
from holosplat.optics.propagation import exit_wave_minus_one, fresnel_propagate, fresnel_transfer, gaussian_transfer
from holosplat.units import wavelength, wavenumber

ENERGY, PITCH = 20.0, 0.5e-6
DOUBLE = torch.float64
FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-5


def a_path(
    views: int = 3, psf: float | list[float] = 0.0, factor: int = 1, dtype: torch.dtype = torch.float32
) -> OpticalPath:
    """An odd, rectangular frame of 11 × 14 pixels in a raster with margins of 3 and 4 pixels, at unequal distances."""
    (h, w), (my, mx) = (11, 14), (3, 4)
    raster = ((h + 2 * my) * factor, (w + 2 * mx) * factor)
    distance = np.linspace(2, 6, views) * PITCH**2 / wavelength(ENERGY)
    sigma = np.full(views, psf) if np.isscalar(psf) else np.array(psf)
    frame = ((h, w), (my * factor, mx * factor), factor)
    return optical_path(raster, PITCH / factor, ENERGY, distance, sigma * factor, frame, dtype)


def some_lines(path: OpticalPath, channels: int = 1, strength: float = 1.0) -> Tensor:
    """Random line integrals [V, C, H, W] of order `strength`."""
    generator = torch.Generator().manual_seed(0)
    return strength * torch.randn(len(path), channels, *path.raster, generator=generator)


def frames_and_gradient(lines: Tensor, refraction: list, path: OpticalPath, backend: str) -> tuple[Tensor, Tensor]:
    """Frames, and the gradient of a fixed random sum over them."""
    leaf = lines.clone().requires_grad_()
    frames = hologram(leaf, refraction, path, backend)
    weights = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    (gradient,) = torch.autograd.grad(frames, leaf, weights.to(frames.dtype))
    return frames.detach(), gradient


def error(found: Tensor, true: Tensor) -> float:
    """Largest difference over largest true value."""
    return float((found.double() - true).abs().max() / true.abs().max())


MATTER = {"one": [(0.7, 0.02)], "signed": [(0.5, -0.3)], "strong": [(40.0, 0.1)], "free": [(0.6, 0.0), (0.0, 0.2)]}
PATHS = {
    "plain": {},
    "blurred": {"psf": 0.8},
    "even number of views": {"psf": 0.8, "views": 4},
    "one view": {"psf": 0.8, "views": 1},
    "unequal blurs": {"psf": [0.0, 0.5, 1.5]},
    "oversampled": {"factor": 2},
    "oversampled and blurred": {"factor": 3, "psf": 0.7},
}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("matter", MATTER)
def test_frames_and_gradients_are_those_of_the_reference(matter, path):
    refraction = MATTER[matter]
    lines = some_lines(a_path(**PATHS[path]), len(refraction))
    frames, gradient = frames_and_gradient(lines, refraction, a_path(**PATHS[path]), "cpu")
    exact = a_path(**PATHS[path], dtype=DOUBLE)
    true, true_gradient = frames_and_gradient(lines.double(), refraction, exact, "reference")
    assert error(frames, true) < FORWARD_TOLERANCE
    assert error(gradient, true_gradient) < GRADIENT_TOLERANCE


@pytest.mark.parametrize("path", ["plain", "oversampled and blurred"])
@pytest.mark.parametrize("mkl", [True, False])
def test_either_library_transforms_alike(path, mkl, monkeypatch):
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: mkl)
    test_frames_and_gradients_are_those_of_the_reference("free", path)


@pytest.mark.parametrize("isa", native.available_isas())
def test_every_build_gives_the_same(isa, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    test_frames_and_gradients_are_those_of_the_reference("one", "blurred")


@pytest.mark.parametrize("name", ["refraction", "distance", "blur"])
def test_the_gradient_check_would_catch_a_biased_term(name):
    """One part in a thousand in any of the things a gradient depends on is more than the check lets pass."""
    lines, refraction = some_lines(a_path(psf=0.8)), [(0.7, 0.02)]
    exact = a_path(psf=0.8, dtype=DOUBLE)
    _, true = frames_and_gradient(lines.double(), refraction, exact, "reference")
    off = {
        "refraction": (a_path(psf=0.8), [(0.7007, 0.02)]),
        "distance": (a_path(psf=0.8)[torch.tensor([0, 0, 2])], refraction),
        "blur": (a_path(psf=0.801), refraction),
    }
    path, matter = off[name]
    _, gradient = frames_and_gradient(lines, matter, path, "cpu")
    assert error(gradient, true) > GRADIENT_TOLERANCE


def test_the_reference_is_the_chain_of_its_steps():
    path, lines = a_path(psf=0.8, factor=2, dtype=DOUBLE), some_lines(a_path(factor=2)).double() * 1e-7
    k, (delta, beta) = wavenumber(ENERGY), (5e-7, 2e-9)
    distance = np.linspace(2, 6, 3) * PITCH**2 / wavelength(ENERGY)
    transfer = fresnel_transfer(path.raster, PITCH / 2, distance, ENERGY, torch.complex128)
    wave = 1 + fresnel_propagate(exit_wave_minus_one(lines[:, 0] * beta, lines[:, 0] * delta, ENERGY), transfer)
    blurred = torch.fft.irfft2(
        torch.fft.rfft2(wave.abs() ** 2) * gaussian_transfer(path.raster, np.full(3, 1.6), DOUBLE), s=path.raster
    )
    wanted = blurred[:, 6:28, 8:36].unflatten(1, (11, 2)).unflatten(3, (14, 2)).mean(dim=(2, 4))
    found = hologram(lines, [(k * delta, k * beta)], path, "reference")
    assert torch.allclose(found, wanted, atol=1e-12)


def test_gradients_of_the_reference_by_finite_differences():
    path = a_path(2, psf=0.8, factor=1, dtype=DOUBLE)
    lines = some_lines(path, 2, 0.5).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: hologram(x, MATTER["free"], path, "reference"), lines, fast_mode=True)


@pytest.mark.parametrize("psf", [0.0, 0.8])
def test_the_adjoint_is_the_adjoint_of_the_derivative(psf):
    """`<G, dI> = <gradient, dT>` for a small step dT, whose image is taken by differences in float64."""
    path, exact = a_path(psf=psf, factor=2), a_path(psf=psf, factor=2, dtype=DOUBLE)
    lines, refraction = some_lines(path), MATTER["one"]
    step = torch.randn(lines.shape, generator=torch.Generator().manual_seed(5), dtype=DOUBLE)
    ends = [hologram(lines.double() + sign * 1e-5 * step, refraction, exact, "reference") for sign in (1, -1)]
    weights = torch.randn(ends[0].shape, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    _, gradient = frames_and_gradient(lines, refraction, path, "cpu")
    along = float(((ends[0] - ends[1]) / 2e-5 * weights).sum())
    assert float((gradient.double() * step).sum()) == pytest.approx(along, rel=1e-4)


def test_weak_objects_keep_their_digits():
    """A contrast of 1e-5 is right to 1e-2 of itself in float32: 1 is added last."""
    path, lines = a_path(), some_lines(a_path(), strength=1e-5)
    found = hologram(lines, [(0.5, 0.02)], path, "cpu")
    true = hologram(lines.double(), [(0.5, 0.02)], a_path(dtype=DOUBLE), "reference")
    assert error(found - 1, true - 1) < 1e-2


def test_views_are_picked_by_index():
    path, lines = a_path(psf=[0.0, 0.5, 1.5]), some_lines(a_path())
    index = torch.tensor([2, 0])
    all_of_them = hologram(lines, MATTER["one"], path, "cpu")
    assert torch.equal(hologram(lines[index], MATTER["one"], path[index], "cpu"), all_of_them[index])


def test_the_same_on_every_run_and_for_every_number_of_threads():
    before = torch.get_num_threads()
    path, lines = a_path(psf=0.8, views=4), some_lines(a_path(views=4))
    results = []
    try:
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            results.append(frames_and_gradient(lines, MATTER["one"], path, "cpu"))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(other, results[0]))


def test_lines_may_lie_anyhow_in_memory():
    path, lines = a_path(), some_lines(a_path())
    turned = lines.transpose(2, 3).contiguous().transpose(2, 3)
    for found, wanted in zip(*(frames_and_gradient(x, MATTER["one"], path, "cpu") for x in (turned, lines))):
        assert torch.equal(found, wanted)


def test_a_second_gradient_is_refused():
    leaf = some_lines(a_path()).requires_grad_()
    total = hologram(leaf, MATTER["one"], a_path(), "cpu").sum()
    total.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="once only"):
        total.backward()


def test_bad_input_is_named():
    path = a_path()
    with pytest.raises(InputError, match="shape"):
        hologram(some_lines(path)[:, :, 1:], MATTER["one"], path, "cpu")
    with pytest.raises(InputError, match="1 or 2 channels"):
        hologram(some_lines(path, 3), [(1.0, 0.0)] * 3, path, "cpu")
    with pytest.raises(InputError, match="backend must be one of"):
        hologram(some_lines(path), MATTER["one"], path, "quick")


@pytest.mark.parametrize("isa", native.available_isas())
@pytest.mark.parametrize("strength", [1e6, 1e9, 1e13, 1e30])
def test_senseless_phases_stay_bounded(strength, isa, monkeypatch):
    """A Gaussian gone astray must not turn the frames into something no fit comes back from."""
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    path = a_path()
    frames, gradient = frames_and_gradient(some_lines(path).abs() * strength, [(1.0, 1e-12)], path, "cpu")
    assert float(frames.abs().max()) < 100
    assert bool(gradient.isfinite().all())


def test_types_that_kernels_do_not_compute_in_are_refused():
    path = a_path()
    with pytest.raises(InputError, match="must be float32"):
        hologram(some_lines(path).double(), MATTER["one"], path, "cpu")
    with pytest.raises(InputError, match="complex64"):
        hologram(some_lines(path), MATTER["one"], a_path(dtype=DOUBLE), "cpu")
