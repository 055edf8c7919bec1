"""The wave optics on the CPU, in float32: C++ between Fourier transforms, with the adjoint written by hand.

The transforms are MKL's where torch has it, else scipy's. The wave in the detector plane is kept for the backward
pass, which uses it up.

Adjoint: with `ψ = 1 + F⁻¹ H F (U - 1)` and `I = |ψ|²`, a gradient G of I becomes `2 G ψ` (of real and imaginary
part), then `F⁻¹ H* F (2 G ψ)`, then `Re(conj(-(kβ + i kδ) U) ·)` of the line integrals. The blur is its own adjoint.
Where the path's factors want gradients (of distance, of blur), each pair costs one more transform: `factors.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import c_void_p
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ... import native
from .factors import factor_gradients, through_correction

if TYPE_CHECKING:
    from . import OpticalPath


def hologram(lines: Tensor, refraction: np.ndarray | Tensor, path: OpticalPath) -> Tensor:
    """Frames [V, h, w]; arguments as the package's `hologram`, already checked."""
    table = torch.as_tensor(refraction).expand(len(path), -1, -1).contiguous()
    factors = (path.rows, path.columns, path.correction, path.blur_rows, path.blur_columns)
    return _Hologram.apply(lines, table, path, *factors)  # type: ignore[no-any-return]


class _Hologram(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lines: Tensor, table: Tensor, path: OpticalPath, *factors: Tensor | None) -> Tensor:  # type: ignore[override]
        lines, correction = lines.contiguous(), factors[2]
        wave = _inverse(_transfer(_forward(_exit_wave(lines, table)), path.rows, path.columns, correction))
        frames = torch.empty(len(lines), *path.shape)
        if path.blur_rows is None:
            _call("intensity", _detector(path), wave, frames)
        else:
            images = _filter(_contrast(wave, path), *_blur(path))
            _call("bin", _detector(path), images, frames)
        ctx.save_for_backward(lines)
        ctx.table, ctx.path, ctx.wave, ctx.correction = table, path, wave, correction
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (lines,), path, wave, gradient = ctx.saved_tensors, ctx.path, ctx.wave, gradient.contiguous()
        if wave is None:
            raise RuntimeError("the hologram's gradient can be taken once only; compute the frames anew.")
        ctx.wave = None
        of_lines, of_path, of_blur = _asked(ctx.needs_input_grad)
        way: tuple[Tensor | None, ...] = (None, None, None)
        wave, blur_gradients = _detected_backward(gradient, wave, path, of_blur)
        spectrum = _forward(wave)
        if of_path:
            passed = _forward(_exit_wave(lines, ctx.table))
            passed, of_correction = through_correction(spectrum, passed, path.factors, ctx.correction)
            way = (*factor_gradients(spectrum, passed, path.rows, path.columns), of_correction)
        if not of_lines:
            return None, None, None, *way, *blur_gradients
        wave = _inverse(_transfer(spectrum, path.rows, path.columns, ctx.correction, conjugate=True))
        del spectrum  # a wave's worth of memory, before the next array is made
        out = torch.empty_like(lines)
        _call("exit_wave_backward", _raster(lines), ctx.table, lines, wave, out)
        return out, None, None, *way, *blur_gradients


def _asked(needs: tuple[bool, ...]) -> tuple[bool, bool, bool]:
    """Whether gradients of the line integrals, of the transfer functions, of the point-spread functions are wanted."""
    return needs[0], any(needs[3:6]), any(needs[6:])


def _detected_backward(
    gradient: Tensor, wave: Tensor, path: OpticalPath, of_blur: bool
) -> tuple[Tensor, tuple[Tensor | None, Tensor | None]]:
    """The gradient of the wave in the detector plane, in its memory, and the gradients of the blur's factors on
    request."""
    if path.blur_rows is None or path.blur_columns is None:
        _call("intensity_backward", _detector(path), gradient, wave)
        return wave, (None, None)
    images, gradients = _images(path), (None, None)
    _call("bin_backward", _detector(path), gradient, images)
    spectrum, blur = _forward(images), _blur(path)
    if of_blur:
        gradients = factor_gradients(spectrum, _forward(_contrast(wave, path)), path.blur_rows, path.blur_columns)
    _call("contrast_backward", _detector(path), _inverse(_transfer(spectrum, *blur)), wave)
    return wave, gradients


def _exit_wave(lines: Tensor, table: Tensor) -> Tensor:
    """The wave behind the object, less one, complex64 [V, H, W]; table: refraction [V, C, 2]."""
    wave = torch.empty(len(lines), *lines.shape[2:], dtype=torch.complex64)
    _call("exit_wave", _raster(lines), table, lines, wave)
    return wave


def _contrast(wave: Tensor, path: OpticalPath) -> Tensor:
    """`|1 + wave|² - 1` in complex images, as the blur takes them."""
    images = _images(path)
    _call("contrast", _detector(path), wave, images)
    return images


def _filter(wave: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """`wave` [K, H, W] with its Fourier transform times rows [K, H] and columns [K, W]; may use up its argument."""
    return _inverse(_transfer(_forward(wave), rows, columns))


def _transfer(
    spectrum: Tensor, rows: Tensor, columns: Tensor, correction: Tensor | None = None, conjugate: bool = False
) -> Tensor:
    """`spectrum` [K, H, W] times rows [K, H], columns [K, W] and correction [K, H, W] (or their conjugates) over H·W,
    in place."""
    count, height, width = spectrum.shape
    raster, scale = native.Raster(count, 1, height, width), 1 / (height * width)
    factors = (c_void_p(rows.data_ptr()), c_void_p(columns.data_ptr()))
    threads = torch.get_num_threads()
    native.call("holosplat_transfer", raster, *factors, scale, int(conjugate), c_void_p(spectrum.data_ptr()), threads)
    return spectrum if correction is None else spectrum.mul_(correction.conj() if conjugate else correction)


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


def _blur(path: OpticalPath) -> tuple[Tensor, Tensor]:
    """The blur's factors for the images of `_images`: a real filter acts on real and imaginary part alike."""
    assert path.blur_rows is not None
    assert path.blur_columns is not None
    rows, columns = (f[:: _lanes(path)].to(torch.complex64).contiguous() for f in (path.blur_rows, path.blur_columns))
    return rows, columns


def _lanes(path: OpticalPath) -> int:
    return 2 if path.alike else 1


def _raster(lines: Tensor) -> native.Raster:
    return native.Raster(*lines.shape)


def _detector(path: OpticalPath) -> native.Detector:
    return native.Detector(len(path), *path.raster, *path.shape, *path.margin, path.factor, _lanes(path))


def _call(name: str, structure: native.Raster | native.Detector, *arrays: Tensor) -> None:
    pointers = [c_void_p(a.data_ptr()) for a in arrays]
    native.call(f"holosplat_{name}", structure, *pointers, torch.get_num_threads())
