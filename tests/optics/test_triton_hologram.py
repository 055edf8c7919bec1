"""The GPU's wave optics against the float64 reference: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.watch import Watch
from holosplat.optics.hologram import OpticalPath, hologram, optical_path
from holosplat.units import wavelength

ENERGY, PITCH = 20.0, 0.5e-6
FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-5
MATTER = {"one": [(0.7, 0.02)], "strong": [(40.0, -0.3)], "two": [(0.6, 0.0), (0.0, 0.2)]}
PATHS = {
    "plain": {},
    "blurred": {"psf": [0.8, 0.8]},
    "unequal blurs": {"psf": [0.0, 1.5]},
    "oversampled": {"factor": 2},
    "oversampled and blurred": {"factor": 2, "psf": [0.7, 0.7]},
}


def a_path(psf: list[float] | None = None, factor: int = 1, dtype: torch.dtype = torch.float32) -> OpticalPath:
    """Two views of 3 × 6 pixels, at unequal distances, in a raster with unequal margins; small: rows are programs."""
    frame, margin = (3, 6), (1, 2)
    raster = tuple((n + 2 * m) * factor for n, m in zip(frame, margin))
    distance = np.array([2.0, 5.0]) * PITCH**2 / wavelength(ENERGY)
    sigma = factor * np.array(psf or [0.0, 0.0])
    corner = tuple(m * factor for m in margin)
    return optical_path(raster, PITCH / factor, ENERGY, distance, sigma, (frame, corner, factor), dtype)


def some_lines(path: OpticalPath, channels: int, strength: float = 1.0) -> Tensor:
    """Random line integrals [V, C, H, W] of order `strength`."""
    return strength * torch.randn(len(path), channels, *path.raster, generator=torch.Generator().manual_seed(0))


def frames_and_gradient(lines: Tensor, refraction: list, path: OpticalPath, backend: str) -> tuple[Tensor, Tensor]:
    """Frames, and the gradient of a fixed random sum over them."""
    leaf = lines.clone().requires_grad_()
    frames = hologram(leaf, refraction, path, backend)
    weights = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return frames.detach(), torch.autograd.grad(frames, leaf, weights.to(frames))[0]


def error(found: Tensor, true: Tensor) -> float:
    """Largest difference over largest true value."""
    return float((found.double() - true).abs().max() / true.abs().max())


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("matter", MATTER)
def test_frames_and_gradients_are_those_of_the_reference(matter, path, gpu):
    refraction, single = MATTER[matter], a_path(**PATHS[path]).to(gpu)
    lines = some_lines(single, len(refraction)).to(gpu)
    frames, gradient = frames_and_gradient(lines, refraction, single, "cuda")
    exact = a_path(**PATHS[path], dtype=torch.float64).to(gpu)
    true, true_gradient = frames_and_gradient(lines.double(), refraction, exact, "reference")
    assert error(frames, true) < FORWARD_TOLERANCE
    assert error(gradient, true_gradient) < GRADIENT_TOLERANCE


def test_weak_objects_keep_their_digits(gpu):
    """A contrast of 1e-5 is right to 1e-2 of itself in float32: 1 is added last."""
    lines = some_lines(a_path(), 1, 1e-5).to(gpu)
    found = hologram(lines, MATTER["one"], a_path().to(gpu), "cuda")
    true = hologram(lines.double(), MATTER["one"], a_path(dtype=torch.float64).to(gpu), "reference")
    assert error(found - 1, true - 1) < 1e-2


@pytest.mark.parametrize("loss", [1e-6, -3.0, 12.0])
def test_phases_and_losses_of_any_size(loss, gpu):
    """Without free space between, a frame is exp(-2 loss), and its gradient that of it, whatever the phase."""
    path = a_path()[torch.tensor([0])]
    path = replace(path, margin=(0, 0), shape=path.raster)
    path = replace(path, rows=torch.ones_like(path.rows), columns=torch.ones_like(path.columns)).to(gpu)
    lines = torch.linspace(0.5, 1.5, math.prod(path.raster)).reshape(1, 1, *path.raster).to(gpu)
    for phase in (1e-4, 3.0, 500.0):
        leaf = lines.clone().requires_grad_()
        frames = hologram(leaf, [(phase, loss)], path, "cuda")
        (gradient,) = torch.autograd.grad(frames.sum(), leaf)
        true = torch.exp(-2 * loss * lines.double())
        assert torch.allclose(frames.detach().double(), true[:, 0], rtol=1e-5, atol=1e-6)
        slack = 2e-6 * (1 + phase + abs(loss)) * max(1.0, float(true.max()))  # U is what is left of U - 1
        assert torch.allclose(gradient.double(), -2 * loss * true, rtol=1e-5, atol=slack)


def test_a_second_gradient_is_refused(gpu):
    leaf = some_lines(a_path(), 1).to(gpu).requires_grad_()
    total = hologram(leaf, MATTER["one"], a_path().to(gpu), "cuda").sum()
    total.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="once only"):
        total.backward()


@pytest.mark.parametrize("path", ["plain", "oversampled and blurred"])
def test_nothing_waits_for_the_device(path, gpu):
    path, index = a_path(**PATHS[path]).to(gpu), torch.tensor([1, 0], device=gpu)
    leaf = some_lines(path, 2).to(gpu).requires_grad_()
    with Watch():
        hologram(leaf, MATTER["two"], path[index], "cuda").sum().backward()
    assert leaf.grad is not None
