"""The wave optics on the GPU, in float32: Triton kernels between torch's Fourier transforms, with the adjoint by hand.

As `cpu.py`, whose docstring has the adjoint. The wave in the detector plane is kept for the backward pass, which uses
it up. Nothing waits for the device, and all of it can be captured in a CUDA graph (after a first call, which compiles
the kernels and plans the transforms).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import triton_waves

if TYPE_CHECKING:
    from . import OpticalPath


def hologram(lines: Tensor, refraction: Sequence[tuple[float, float]], path: OpticalPath) -> Tensor:
    """Frames [V, h, w]; arguments as the package's `hologram`, already checked."""
    matter = tuple((float(phase), float(loss)) for phase, loss in refraction)
    return _Hologram.apply(lines, matter, path)  # type: ignore[no-any-return]


class _Hologram(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, lines: Tensor, refraction: tuple[tuple[float, float], ...], path: OpticalPath
    ) -> Tensor:
        lines, crop = lines.contiguous(), (path.margin, path.factor)
        with _on(lines):
            wave = triton_waves.exit_wave(lines, refraction)
            wave = _filter(wave, path.rows, path.columns)
            if path.blur_rows is None:
                frames = triton_waves.intensity(wave, path.shape, *crop)
            else:
                frames = triton_waves.bin_samples(_blur(triton_waves.contrast(wave), path), path.shape, *crop)
        ctx.save_for_backward(lines)
        ctx.refraction, ctx.path, ctx.wave = refraction, path, wave
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (lines,), path, wave, gradient = ctx.saved_tensors, ctx.path, ctx.wave, gradient.contiguous()
        if wave is None:
            raise RuntimeError("the hologram's gradient can be taken once only; compute the frames anew.")
        ctx.wave, crop = None, (path.margin, path.factor)
        with _on(lines):
            if path.blur_rows is None:
                triton_waves.intensity_backward(gradient, wave, *crop)
            else:
                samples = triton_waves.bin_samples_backward(gradient, path.raster, *crop)
                triton_waves.contrast_backward(_blur(samples, path), wave)
            wave = _filter(wave, path.rows, path.columns, conjugate=True)
            return triton_waves.exit_wave_backward(lines, ctx.refraction, wave), None, None


def _filter(wave: Tensor, rows: Tensor, columns: Tensor, conjugate: bool = False) -> Tensor:
    """`wave` [V, H, W] with its Fourier transform times rows [V, H] and columns [V, W] (or their conjugates)."""
    spectrum = torch.fft.fft2(wave).contiguous()  # torch promises no order in memory; the kernels need one
    triton_waves.transfer(spectrum, rows.contiguous(), columns.contiguous(), conjugate)
    return torch.fft.ifft2(spectrum, norm="forward").contiguous()


def _blur(samples: Tensor, path: OpticalPath) -> Tensor:
    """Real images [V, H, W] blurred (periodically) by the path's point-spread functions; its own adjoint."""
    assert path.blur_rows is not None
    assert path.blur_columns is not None
    spectrum = torch.fft.rfft2(samples).contiguous()
    triton_waves.attenuate(spectrum, path.blur_rows.contiguous(), path.blur_columns.contiguous())
    return torch.fft.irfft2(spectrum, s=samples.shape[1:], norm="forward")


def _on(array: Tensor) -> AbstractContextManager[Any]:
    """The device of `array` made current: Triton launches on the current one."""
    return torch.cuda.device(array.device) if array.is_cuda else nullcontext()
