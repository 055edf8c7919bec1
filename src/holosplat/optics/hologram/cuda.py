"""The wave optics on the GPU, in float32: Triton kernels between torch's Fourier transforms, with the adjoint by hand.

As `cpu.py`, whose docstring has the adjoint. The wave in the detector plane is kept for the backward pass, which uses
it up. Nothing waits for the device, and all of it can be captured in a CUDA graph (after a first call, which compiles
the kernels and plans the transforms).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...launch import launching
from . import triton_waves
from .factors import factor_gradients, through_correction

if TYPE_CHECKING:
    from . import OpticalPath


def hologram(lines: Tensor, refraction: np.ndarray | Tensor, path: OpticalPath) -> Tensor:
    """Frames [V, h, w]; arguments as the package's `hologram`, already checked."""
    matter = refraction.float() if isinstance(refraction, Tensor) else refraction.tolist()
    factors = (path.rows, path.columns, path.correction, path.blur_rows, path.blur_columns)
    return _Hologram.apply(lines, matter, path, *factors)  # type: ignore[no-any-return]


class _Hologram(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, lines: Tensor, matter: triton_waves.Refraction, path: OpticalPath, *factors: Tensor | None
    ) -> Tensor:
        lines, correction, crop = lines.contiguous(), factors[2], (path.margin, path.factor)
        with launching(lines):
            wave = triton_waves.exit_wave(lines, matter)
            wave = _inverse(_transfer(_forward(wave), path, correction))
            if path.blur_rows is None:
                frames = triton_waves.intensity(wave, path.shape, *crop)
            else:
                samples = _blurred(_real_spectrum(triton_waves.contrast(wave)), path)
                frames = triton_waves.bin_samples(samples, path.shape, *crop)
        ctx.save_for_backward(lines)
        ctx.matter, ctx.path, ctx.wave, ctx.correction = matter, path, wave, correction
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (lines,), path, wave, gradient = ctx.saved_tensors, ctx.path, ctx.wave, gradient.contiguous()
        if wave is None:
            raise RuntimeError("the hologram's gradient can be taken once only; compute the frames anew.")
        ctx.wave, needs = None, ctx.needs_input_grad
        way: tuple[Tensor | None, ...] = (None, None, None)
        with launching(lines):
            blur_gradients = _detected_backward(gradient, wave, path, any(needs[6:]))
            spectrum = _forward(wave)
            if any(needs[3:6]):
                passed = _forward(triton_waves.exit_wave(lines, ctx.matter))
                passed, of_correction = through_correction(spectrum, passed, path.factors, ctx.correction)
                way = (*factor_gradients(spectrum, passed, path.rows, path.columns), of_correction)
            if not needs[0]:
                return None, None, None, *way, *blur_gradients
            wave = _inverse(_transfer(spectrum, path, ctx.correction, conjugate=True))
            out = triton_waves.exit_wave_backward(lines, ctx.matter, wave)
        return out, None, None, *way, *blur_gradients


def _detected_backward(
    gradient: Tensor, wave: Tensor, path: OpticalPath, of_blur: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Overwrites `wave` in the detector plane by its gradient; returns the gradients of the blur's factors on
    request."""
    gradients, crop = (None, None), (path.margin, path.factor)
    if path.blur_rows is None or path.blur_columns is None:
        triton_waves.intensity_backward(gradient, wave, *crop)
        return gradients
    spectrum = _real_spectrum(triton_waves.bin_samples_backward(gradient, path.raster, *crop))
    if of_blur:
        passed = _real_spectrum(triton_waves.contrast(wave))
        gradients = factor_gradients(spectrum, passed, path.blur_rows, path.blur_columns)
    triton_waves.contrast_backward(_blurred(spectrum, path), wave)
    return gradients


def _forward(wave: Tensor) -> Tensor:
    """The spectrum of `wave` [V, H, W]; torch promises no order in memory, but the kernels need one."""
    return torch.fft.fft2(wave).contiguous()


def _transfer(spectrum: Tensor, path: OpticalPath, correction: Tensor | None, conjugate: bool = False) -> Tensor:
    """`spectrum` [V, H, W] times the path's transfer functions (or their conjugates) over H·W, in place."""
    triton_waves.transfer(spectrum, path.rows.contiguous(), path.columns.contiguous(), conjugate)
    return spectrum if correction is None else spectrum.mul_(correction.conj() if conjugate else correction)


def _inverse(spectrum: Tensor) -> Tensor:
    """The way back, not divided by the number of samples."""
    return torch.fft.ifft2(spectrum, norm="forward").contiguous()


def _real_spectrum(samples: Tensor) -> Tensor:
    """The spectrum [V, H, W // 2 + 1] of real images [V, H, W]."""
    return torch.fft.rfft2(samples).contiguous()


def _blurred(spectrum: Tensor, path: OpticalPath) -> Tensor:
    """Real images blurred (periodically) by the path's point-spread functions, from their spectrum, which it uses up.

    The blur is its own adjoint."""
    assert path.blur_rows is not None
    assert path.blur_columns is not None
    triton_waves.attenuate(spectrum, path.blur_rows.contiguous(), path.blur_columns.contiguous())
    return torch.fft.irfft2(spectrum, s=path.raster, norm="forward")
