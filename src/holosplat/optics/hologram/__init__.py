"""From line integrals to frames in one differentiable operation: exit wave → Fresnel → intensity → PSF → pixels.

Backends: `cpu` (C++ between MKL's or scipy's transforms, float32), `cuda` (Triton and torch's transforms, float32) and
`reference` (plain torch, any float type and device), which is the specification of the others. All give gradients of
the line integrals and, on request, of the distances and of the widths of the point-spread functions; the adjoints of
`cpu` and `cuda` are written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...backends import implementation
from ...checks import require
from ...units import wavelength
from ..propagation import angular_spectrum_factor, fresnel_factors, gaussian_factors, needs_angular_spectrum

SMALL, KEPT = 1 << 20, 8
"""Samples of factors that are kept, at most, and how many: the verdict's views share them, and times of a series."""
LARGE = 1 << 24
"""Samples of the latest factors (128 MB), at most, that are kept beside these: the views of a simulation share them."""

Refraction = Sequence[tuple[float, float]] | np.ndarray | Tensor
"""`(k δ, k β)` of each channel of matter per unit of its line integral: [C, 2] for all views, or [V, C, 2]."""


@dataclass(frozen=True)
class OpticalPath:
    """The optics between an object and its frames, for V exposures on one raster [H, W] of samples.

    rows [V, H], columns [V, W]: complex factors of the Fresnel transfer functions.
    blur_rows [V, H], blur_columns [V, W]: real factors of the point-spread functions' transforms, None where there are
        none.
    wavelength: [V] [m], float64.
    alike: whether one point-spread function serves all views.
    shape: rows and columns (h, w) of a frame.
    margin: samples (y, x) between the raster's border and the frame's.
    factor: samples along a pixel's edge.
    pitch: of the samples [m].
    beyond [U, H, W]: what the product of rows and columns lacks of the angular spectrum, of each of U pairs of
        wavelength and distance; which [V]: the pair of each view. Both None where Fresnel's kernel is exact to
        rounding (`propagation.needs_angular_spectrum`), which costs nothing.

    The factors may come from distances and widths that want gradients (`optical_path`, `corrected`).
    """

    rows: Tensor
    columns: Tensor
    blur_rows: Tensor | None
    blur_columns: Tensor | None
    wavelength: Tensor
    alike: bool
    shape: tuple[int, int]
    margin: tuple[int, int]
    factor: int
    pitch: float
    beyond: Tensor | None = None
    which: Tensor | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Tensor) -> OpticalPath:
        """The path of the views `index` [K], an integer tensor on the path's device."""
        picked = [None if a is None else a.index_select(0, index) for a in self._arrays]
        return self._of(picked, self.beyond, None if self.which is None else self.which.index_select(0, index))

    def to(self, device: torch.device | str) -> OpticalPath:
        """The same path with its factors on `device`."""
        moved = [None if a is None else a.to(device) for a in (*self._arrays, self.beyond, self.which)]
        return self._of(moved[:5], *moved[5:])

    def corrected(self, distance: Tensor | None = None, psf_sigma: Tensor | None = None) -> OpticalPath:
        """The same path at other distances [V] [m] and with other widths [V] of the point-spread function [samples].

        Float64 tensors on the path's device, whose gradients the frames give; None: as they are. A width's gradient is
        zero at 0 exactly, since frames depend on its square: start a fit of widths above 0. Nothing waits for the
        device. Errors: `InputError` if there are fewer or more numbers than views.
        """
        path, wanted = self, (len(self),)
        for name, given in (("distance", distance), ("psf_sigma", psf_sigma)):
            good = given is None or (tuple(given.shape) == wanted and given.dtype == torch.float64)
            require(
                good,
                f"{name} must be a float64 tensor with one number for each of the path's {wanted[0]} views, but it is "
                f"{None if given is None else (given.dtype, tuple(given.shape))}.",
            )
        if distance is not None:
            rows, columns = fresnel_factors(self.raster, self.pitch, self.wavelength * distance, self.rows.dtype)
            path = replace(path, rows=rows, columns=columns)
            if self.beyond is not None:
                full = angular_spectrum_factor(self.raster, self.pitch, self.wavelength, distance, self.rows.dtype)
                path = replace(path, beyond=full, which=torch.arange(len(self), device=full.device))
        if psf_sigma is not None:
            rows, columns = gaussian_factors(self.raster, psf_sigma, self.rows.dtype.to_real())
            path = replace(path, blur_rows=rows, blur_columns=columns, alike=False)
        return path

    @property
    def raster(self) -> tuple[int, int]:
        """Samples (H, W) of the raster on which the waves live."""
        return self.rows.shape[1], self.columns.shape[1]

    @property
    def correction(self) -> Tensor | None:
        """`beyond` of each view [V, H, W], a view of it where all have the same."""
        if self.beyond is None or self.which is None:
            return None
        if len(self.beyond) == 1:
            return self.beyond.expand(len(self), -1, -1)
        return self.beyond.index_select(0, self.which)

    @property
    def transfer(self) -> Tensor:
        """The transfer functions [V, H, W]."""
        return self.factors if self.correction is None else self.factors * self.correction

    @property
    def factors(self) -> Tensor:
        """The product of rows and columns [V, H, W]."""
        return self.rows[:, :, None] * self.columns[:, None]

    @property
    def _arrays(self) -> tuple[Tensor | None, ...]:
        return self.rows, self.columns, self.blur_rows, self.blur_columns, self.wavelength

    def _of(self, arrays: list[Tensor | None], beyond: Tensor | None, which: Tensor | None) -> OpticalPath:
        rest = (self.alike, self.shape, self.margin, self.factor, self.pitch)
        return OpticalPath(*arrays, *rest, beyond, which)  # type: ignore[arg-type]


def optical_path(
    raster: tuple[int, int],
    pitch: float,
    energy_kev: float | np.ndarray,
    distance: np.ndarray | Tensor,
    psf_sigma: np.ndarray | Tensor,
    frame: tuple[tuple[int, int], tuple[int, int], int],
    dtype: torch.dtype = torch.float32,
    *,
    exact: bool | None = None,
) -> OpticalPath:
    """The path of V exposures: distance [V] in metres, psf_sigma [V] in samples of `pitch` [m], on `raster` [H, W].

    energy_kev: photon energy [keV], one or [V]; frame: (rows, columns) of the frame, its margin (y, x) in samples, and
    the samples along a pixel's edge. Distances and widths that are tensors (float64, on the device of the path) pass
    gradients on, as `OpticalPath.corrected` says. Widths in an array that are all zero make a path without blur.
    exact: whether waves go by the angular spectrum (default: where `propagation.needs_angular_spectrum` says so).
    """
    tensors = [x for x in (distance, psf_sigma) if isinstance(x, Tensor)]
    on = tensors[0].device if tensors else torch.device("cpu")
    z, energies = _numbers(distance, on), np.asarray(energy_kev, dtype=np.float64)
    require(
        energies.shape in ((), (len(z),)),
        f"energy_kev must be one number, or one for each of {len(z)} distances, but it has the shape {energies.shape}.",
    )
    lam = torch.as_tensor(wavelength(energies), dtype=torch.float64, device=on).expand(len(z)).contiguous()
    complex_dtype = torch.complex128 if dtype == torch.float64 else torch.complex64
    rows, columns = fresnel_factors(raster, pitch, lam * z, complex_dtype)
    sigma, fixed = _numbers(psf_sigma, on), not isinstance(psf_sigma, Tensor)
    blurs = (None, None) if fixed and not bool((sigma > 0).any()) else gaussian_factors(raster, sigma, dtype)
    alike = fixed and bool((sigma == sigma[:1]).all())
    if exact is None:
        exact = needs_angular_spectrum(raster, pitch, lam.cpu().numpy(), z.detach().cpu().numpy())
    beyond = which = None
    if exact:
        if isinstance(distance, Tensor):
            which = torch.arange(len(z), device=on)
            beyond = angular_spectrum_factor(raster, pitch, lam, z, complex_dtype)
        else:
            pairs, which = torch.unique(torch.stack((lam, z), dim=1), dim=0, return_inverse=True)
            size = len(pairs) * math.prod(raster)
            known = _kept if size <= SMALL else _latest if size <= LARGE else _known_factor
            beyond = known(raster, pitch, tuple(map(tuple, pairs.tolist())), complex_dtype).to(on)
    return OpticalPath(rows, columns, *blurs, lam, alike, *frame, pitch, beyond, which)


def _known_factor(
    raster: tuple[int, int], pitch: float, pairs: tuple[tuple[float, float], ...], dtype: torch.dtype
) -> Tensor:
    """`angular_spectrum_factor` of pairs of wavelength and distance; nobody writes to it."""
    lam, z = torch.tensor(pairs, dtype=torch.float64).unbind(1)
    return angular_spectrum_factor(raster, pitch, lam, z, dtype)


_kept = lru_cache(maxsize=KEPT)(_known_factor)
_latest = lru_cache(maxsize=1)(_known_factor)


def _numbers(given: np.ndarray | Tensor, on: torch.device) -> Tensor:
    """[V] float64 on a device."""
    array = given if isinstance(given, Tensor) else np.asarray(given, dtype=np.float64)
    return torch.as_tensor(array, dtype=torch.float64, device=on).reshape(-1)


def hologram(lines: Tensor, refraction: Refraction, path: OpticalPath, backend: str) -> Tensor:
    """Frames [V, h, w] (relative intensity) from line integrals [V, C, H, W], C = 1 or 2 channels of matter.

    refraction: for each channel `(k δ, k β)` per unit of its line integral, so that the wave behind the object is
    `exp(-Σ (kβ + i kδ) T)`: [C, 2] for all views, or, where energies differ, [V, C, 2] (on a GPU best a tensor there:
    nothing waits for the device then). Gradients: of `lines`, and of distances and widths that `path` was made from.
    Errors: `InputError` for shapes, types or devices that do not fit, or an unknown backend.
    """
    table = _table(refraction, path)
    wanted = (len(path), table.shape[-2], *path.raster)
    require(
        tuple(lines.shape) == wanted and table.shape[-2] in (1, 2),
        f"line integrals must have the shape (views, channels, rows, columns) = {wanted} with 1 or 2 channels, "
        f"but they have {tuple(lines.shape)}.",
    )
    single = (lines.dtype, path.rows.dtype) == (torch.float32, torch.complex64) and lines.device == path.rows.device
    require(
        backend == "reference" or single,
        f"line integrals must be float32, beside a path of complex64, for the {backend} backend, but they are "
        f"{lines.dtype} on {lines.device}, beside {path.rows.dtype} on {path.rows.device}.",
    )
    return implementation(__name__, backend).hologram(lines, table, path)


def _table(refraction: Refraction, path: OpticalPath) -> np.ndarray | Tensor:
    """[C, 2] as an array, or [V, C, 2] as a tensor on the path's device, float64."""
    table = refraction if isinstance(refraction, Tensor) else np.asarray(refraction, dtype=np.float64)
    shape = tuple(table.shape)
    require(
        shape[-1:] == (2,) and (len(shape) == 2 or (len(shape) == 3 and shape[0] == len(path))),
        f"refraction must have the shape (channels, 2), or (views, channels, 2) of the path's {len(path)} views, but "
        f"it has {shape}.",
    )
    if isinstance(table, np.ndarray) and table.ndim == 2:
        return table
    per_view = torch.as_tensor(table, dtype=torch.float64, device=path.rows.device)
    require(not per_view.requires_grad, "refraction has no gradient, but it is a tensor that wants one; detach it.")
    return per_view.expand(len(path), -1, -1)
