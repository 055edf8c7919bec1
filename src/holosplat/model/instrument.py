"""The wave optics of some exposures: line integrals in, frames out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..backends import device, resolve
from ..checks import require
from ..optics.hologram import Refraction, hologram, optical_path
from ..optics.sampling import padding
from ..scan import Exposures, far_from_edges
from ..units import wavenumber
from ..volume import LineIntegrals, Object

MOST_SAMPLES = 1_000_000_000
"""Samples of all waves held at once, at most (16 GB as complex128)."""


class Instrument:
    """The wave optics of some exposures, made ready: line integrals in, frames out, differentiable.

    The line integrals live on `views`: the detector's raster, padded by the fringes' reach so that nothing
    wraps around, and `oversample` times finer than the detector. `backend`: `cpu`, `cuda`, `reference` or
    `auto` (see `backends`); float64 (`dtype`) is what only `reference` computes in, and stands for it.
    `dispersion`: factors [V, 2], or of each channel of matter [V, C, 2], of δ and β at the frames' energies over those
    at the reference energy (`materials.dispersion`; default: `scan.far_from_edges`, 1 where all energies are one).
    """

    def __init__(
        self,
        exposures: Exposures,
        oversample: int = 1,
        dtype: torch.dtype = torch.float32,
        backend: str = "cpu",
        dispersion: np.ndarray | None = None,
    ) -> None:
        require(oversample >= 1, f"oversample must be at least 1, but it is {oversample}.")
        known = dtype in (torch.float32, torch.float64)
        require(known, f"the wave optics computes in float32 or float64, but {dtype} is asked for.")
        self.exposures, self.oversample, self.dtype = exposures, int(oversample), dtype
        self.backend = resolve("reference" if dtype == torch.float64 else backend)
        self.device = device(self.backend)
        self.margin = padding(exposures, self.oversample)
        self.views = exposures.views.padded(self.margin).refined(self.oversample)
        rows, columns = self.views.shape
        require(
            len(self.views) * rows * columns <= MOST_SAMPLES,
            f"the waves of {len(self.views)} views would need {rows} × {columns} samples each, more than memory holds; "
            "use fewer or smaller frames.",
        )
        ratio = far_from_edges(exposures.energy_kev, exposures.reference_energy) if dispersion is None else dispersion
        self._factors = _factors(wavenumber(exposures.energy_kev), ratio, self.device)
        my, mx = (m * self.oversample for m in self.margin)
        self.path = optical_path(
            self.views.shape,
            self.views.pixel_size,
            exposures.energy_kev,
            exposures.distance,
            exposures.psf_sigma_px * self.oversample,
            (exposures.views.shape, (my, mx), self.oversample),
            dtype,
        ).to(self.device)

    def frames(self, lines: LineIntegrals, index: np.ndarray | Tensor | None = None) -> Tensor:
        """Frames [V, H, W] from line integrals on `self.views` (or its views `index`), in the instrument's type."""
        at = None if index is None else torch.as_tensor(index, device=self.device)
        path = self.path if at is None else self.path[at]
        refraction = self.refraction(lines.materials, at)
        return hologram(lines.channels.to(self.device, self.dtype), refraction, path, self.backend)

    def refraction(self, materials: Sequence[tuple[float, float]], index: Tensor | None = None) -> Refraction:
        """`(k δ, k β)` of each channel as `hologram` takes them: [C, 2], or [K, C, 2] where they differ between views.

        materials: (δ, β) of each channel at the reference energy; index: views [K] on the instrument's device.
        """
        channels = [min(c, self._factors.shape[1] - 1) for c in range(len(materials))]
        if isinstance(self._factors, np.ndarray):
            return [(f[0] * m[0], f[1] * m[1]) for f, m in zip(self._factors[0, channels].tolist(), materials)]
        factors = self._factors if index is None else self._factors.index_select(0, index)
        pairs = [factors[:, c].unbind(1) for c in channels]
        return torch.stack([torch.stack((f * d, g * b), dim=1) for (f, g), (d, b) in zip(pairs, materials)], dim=1)

    def image(self, B: Tensor, D: Tensor, index: np.ndarray | None = None) -> Tensor:
        """Frames [V, H, W] from line integrals B, D [V, H', W'] in metres on `self.views` (or its views `index`)."""
        return self.frames(LineIntegrals.of(B, D), index)

    def measure(self, obj: Object, index: np.ndarray | None = None) -> Tensor:
        """Frames [V, H, W] that `obj` would give in the exposures `index` (default: all)."""
        index = np.arange(len(self.views)) if index is None else np.asarray(index)
        times = self.exposures.time[index]
        frames = torch.empty(0)
        for time in np.unique(times):
            at = np.flatnonzero(times == time)
            lines = obj.at(float(time)).project(self.views[index[at]])
            part = self.frames(LineIntegrals.of_any(lines), index[at])
            if len(at) == len(index):
                return part
            frames = frames if len(frames) else part.new_empty((len(index), *part.shape[1:]))
            frames[at] = part
        return frames


def _factors(wavenumbers: np.ndarray, dispersion: np.ndarray, device: torch.device) -> np.ndarray | Tensor:
    """k [V] times the dispersion [V, 2] or [V, C, 2] of δ and β: [1, C, 2] if that is the same in all views.

    Else a tensor [V, C, 2] on `device`. C is 1 where all channels are alike.
    """
    factors = wavenumbers[:, None, None] * dispersion.reshape(len(wavenumbers), -1, 2)
    return factors[:1] if (factors == factors[:1]).all() else torch.from_numpy(factors).to(device)


def measure(obj: Object, exposures: Exposures, oversample: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Frames [N, H, W] (relative intensity) that `obj` gives in `exposures`, on waves `oversample` times finer."""
    return Instrument(exposures, oversample, dtype).measure(obj)
