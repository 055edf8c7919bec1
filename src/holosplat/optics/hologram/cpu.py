"""The wave optics on the CPU, in float32: C++ between Fourier transforms, with the adjoint written by hand.

The transforms are MKL's where torch has it, else scipy's. The wave in the detector plane is kept for the backward
pass, which uses it up.

Adjoint: with `ψ = 1 + F⁻¹ H F (U - 1)` and `I = |ψ|²`, a gradient G of I becomes `2 G ψ` (of real and imaginary
part), then `F⁻¹ H* F (2 G ψ)`, then `Re(conj(-(kβ + i kδ) U) ·)` of the line integrals. The blur is its own adjoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import c_void_p
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ... import native

if TYPE_CHECKING:
    from . import OpticalPath


def hologram(lines: Tensor, refraction: Sequence[tuple[float, float]], path: OpticalPath) -> Tensor:
    """Frames [V, h, w]; arguments as the package's `hologram`, already checked."""
    return _Hologram.apply(lines, np.array(refraction, dtype=np.float64), path)  # type: ignore[no-any-return]


class _Hologram(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lines: Tensor, refraction: np.ndarray, path: OpticalPath) -> Tensor:  # type: ignore[override]
        lines = lines.contiguous()
        views, _, height, width = lines.shape
        wave = torch.empty(views, height, width, dtype=torch.complex64)
        _call("exit_wave", _raster(lines), c_void_p(refraction.ctypes.data), lines, wave)
        wave = _filter(wave, path.rows, path.columns)
        frames = torch.empty(views, *path.shape)
        if path.blur_rows is None:
            _call("intensity", _detector(path), wave, frames)
        else:
            images = _images(path)
            _call("contrast", _detector(path), wave, images)
            images = _blur(images, path)
            _call("bin", _detector(path), images, frames)
        ctx.save_for_backward(lines)
        ctx.refraction, ctx.path, ctx.wave = refraction, path, wave
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (lines,), path, wave, gradient = ctx.saved_tensors, ctx.path, ctx.wave, gradient.contiguous()
        if wave is None:
            raise RuntimeError("the hologram's gradient can be taken once only; compute the frames anew.")
        ctx.wave = None
        if path.blur_rows is None:
            _call("intensity_backward", _detector(path), gradient, wave)
        else:
            images = _images(path)
            _call("bin_backward", _detector(path), gradient, images)
            images = _blur(images, path)
            _call("contrast_backward", _detector(path), images, wave)
        wave = _filter(wave, path.rows, path.columns, conjugate=True)
        out = torch.empty_like(lines)
        _call("exit_wave_backward", _raster(lines), c_void_p(ctx.refraction.ctypes.data), lines, wave, out)
        return out, None, None


def _filter(wave: Tensor, rows: Tensor, columns: Tensor, conjugate: bool = False) -> Tensor:
    """`wave` [K, H, W] with its Fourier transform times rows [K, H] and columns [K, W] (or their conjugates)."""
    count, height, width = wave.shape
    raster, scale = native.Raster(count, 1, height, width), 1 / (height * width)
    spectrum = _forward(wave)
    factors = (c_void_p(rows.data_ptr()), c_void_p(columns.data_ptr()))
    threads = torch.get_num_threads()
    native.call("holosplat_transfer", raster, *factors, scale, int(conjugate), c_void_p(spectrum.data_ptr()), threads)
    return _inverse(spectrum)


def _forward(wave: Tensor) -> Tensor:
    """Fourier transform of the last two dimensions; may use up its argument."""
    return torch.fft.fft2(wave) if torch.backends.mkl.is_available() else _by_scipy(scipy.fft.fft2, wave, "backward")


def _inverse(spectrum: Tensor) -> Tensor:
    """The way back, not divided by the number of samples; may use up its argument."""
    if torch.backends.mkl.is_available():
        return torch.fft.ifft2(spectrum, norm="forward")
    return _by_scipy(scipy.fft.ifft2, spectrum, "forward")


def _by_scipy(function: Callable[..., Any], wave: Tensor, norm: str) -> Tensor:
    """In place and on several threads: where torch has no MKL, its own transforms have one thread."""
    workers = torch.get_num_threads()
    return torch.from_numpy(function(wave.numpy(), axes=(1, 2), norm=norm, overwrite_x=True, workers=workers))


def _images(path: OpticalPath) -> Tensor:
    """Room for the blur of real images, two of them in each complex one if they are blurred alike."""
    return torch.empty((len(path) + _lanes(path) - 1) // _lanes(path), *path.raster, dtype=torch.complex64)


def _blur(images: Tensor, path: OpticalPath) -> Tensor:
    assert path.blur_rows is not None
    assert path.blur_columns is not None
    lanes = _lanes(path)
    # A real filter acts on real and imaginary part alike, so two images pass as one complex one.
    rows, columns = (f[::lanes].to(torch.complex64).contiguous() for f in (path.blur_rows, path.blur_columns))
    return _filter(images, rows, columns)


def _lanes(path: OpticalPath) -> int:
    return 2 if path.alike else 1


def _raster(lines: Tensor) -> native.Raster:
    return native.Raster(*lines.shape)


def _detector(path: OpticalPath) -> native.Detector:
    return native.Detector(len(path), *path.raster, *path.shape, *path.margin, path.factor, _lanes(path))


def _call(name: str, structure: native.Raster | native.Detector, *arrays: Tensor | c_void_p) -> None:
    pointers = [a if isinstance(a, c_void_p) else c_void_p(a.data_ptr()) for a in arrays]
    native.call(f"holosplat_{name}", structure, *pointers, torch.get_num_threads())
