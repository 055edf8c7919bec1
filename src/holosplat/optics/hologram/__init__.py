"""From line integrals to frames in one differentiable operation: exit wave → Fresnel → intensity → PSF → pixels.

Backends: `cpu` (C++ between MKL's or scipy's transforms, float32), `cuda` (Triton and torch's transforms, float32) and
`reference` (plain torch, any float type and device), which is the specification of the others. All give gradients
of the line integrals, and of nothing else; those of `cpu` and `cuda` are written by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...backends import implementation
from ...checks import require
from ..detector import gaussian_factors
from ..propagation import fresnel_factors


@dataclass(frozen=True)
class OpticalPath:
    """What lies between an object and its frames, for V exposures on one raster [H, W] of samples.

    rows [V, H], columns [V, W]: complex factors of the Fresnel transfer functions; blur_rows [V, H],
    blur_columns [V, W]: real factors of the point-spread functions' transforms, None where there are none;
    alike: whether one point-spread function serves all views; shape: rows and columns (h, w) of a frame;
    margin: samples (y, x) between the raster's border and the frame's; factor: samples along a pixel's edge.
    """

    rows: Tensor
    columns: Tensor
    blur_rows: Tensor | None
    blur_columns: Tensor | None
    alike: bool
    shape: tuple[int, int]
    margin: tuple[int, int]
    factor: int

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Tensor) -> OpticalPath:
        """The path of the views `index` [K], an integer tensor on the path's device."""
        picked = [None if a is None else a.index_select(0, index) for a in self._arrays]
        return OpticalPath(*picked, self.alike, self.shape, self.margin, self.factor)  # type: ignore[arg-type]

    def to(self, device: torch.device | str) -> OpticalPath:
        """The same path with its factors on `device`."""
        moved = [None if a is None else a.to(device) for a in self._arrays]
        return OpticalPath(*moved, self.alike, self.shape, self.margin, self.factor)  # type: ignore[arg-type]

    @property
    def raster(self) -> tuple[int, int]:
        """Samples (H, W) of the raster on which the waves live."""
        return self.rows.shape[1], self.columns.shape[1]

    @property
    def _arrays(self) -> tuple[Tensor | None, ...]:
        return self.rows, self.columns, self.blur_rows, self.blur_columns


def optical_path(
    raster: tuple[int, int],
    pitch: float,
    energy_kev: float,
    distance: np.ndarray,
    psf_sigma: np.ndarray,
    frame: tuple[tuple[int, int], tuple[int, int], int],
    dtype: torch.dtype = torch.float32,
) -> OpticalPath:
    """The path of V exposures: distance [V] in metres, psf_sigma [V] in samples of `pitch` [m], on `raster` [H, W].

    frame: (rows, columns) of the frame, its margin (y, x) in samples, and the samples along a pixel's edge.
    """
    complex_dtype = torch.complex128 if dtype == torch.float64 else torch.complex64
    rows, columns = fresnel_factors(raster, pitch, distance, energy_kev, complex_dtype)
    sigma = np.asarray(psf_sigma, dtype=np.float64)
    blurs = gaussian_factors(raster, sigma, dtype) if np.any(sigma > 0) else (None, None)
    return OpticalPath(rows, columns, *blurs, bool(np.all(sigma == sigma.reshape(-1)[:1])), *frame)


def hologram(lines: Tensor, refraction: Sequence[tuple[float, float]], path: OpticalPath, backend: str) -> Tensor:
    """Frames [V, h, w] (relative intensity) from line integrals [V, C, H, W], C = 1 or 2 channels of matter.

    refraction: for each channel `(k δ, k β)` per unit of its line integral, so that the wave behind the object is
    `exp(-Σ (kβ + i kδ) T)`. Errors: `InputError` for shapes, types or devices that do not fit, or an unknown backend.
    """
    wanted = (len(path), len(refraction), *path.raster)
    require(
        tuple(lines.shape) == wanted and len(refraction) in (1, 2),
        f"line integrals must have the shape (views, channels, rows, columns) = {wanted} with 1 or 2 channels, "
        f"but they have {tuple(lines.shape)}.",
    )
    single = (lines.dtype, path.rows.dtype) == (torch.float32, torch.complex64) and lines.device == path.rows.device
    require(
        backend == "reference" or single,
        f"line integrals must be float32, beside a path of complex64, for the {backend} backend, but they are "
        f"{lines.dtype} on {lines.device}, beside {path.rows.dtype} on {path.rows.device}.",
    )
    return implementation(__name__, backend).hologram(lines, refraction, path)
