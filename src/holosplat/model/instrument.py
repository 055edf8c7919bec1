"""The wave optics of some exposures: line integrals in, frames out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..backends import device, resolve
from ..checks import require
from ..geometry import Poses
from ..optics.hologram import OpticalPath, Refraction, hologram, optical_path
from ..optics.retrieval.contact import beside_faces
from ..optics.sampling import padding
from ..scan import Exposures, far_from_edges
from ..units import wavenumber
from ..volume import LineIntegrals

MOST_SAMPLES = 1_000_000_000
"""Samples of all waves held at once, at most (16 GB as complex128)."""

MOST_CHANNELS = 2
"""Channels of matter that the kernels of the waves take; more are summed to δ and β first."""


class Instrument:
    """The wave optics of some exposures, made ready: line integrals in, frames out, differentiable.

    The line integrals [m] live on `views`: the detectors' rasters, padded by the fringes' reach so that nothing
    wraps around, and `oversample` times finer than the detector. `backend`: `cpu`, `cuda`, `reference` or
    `auto` (see `backends`); float64 (`dtype`) is what only `reference` computes in, and stands for it.
    `dispersion`: factors [V, 2], or of each channel of matter [V, C, 2], of δ and β at the frames' energies over those
    at the reference energy (`materials.dispersion`; default: `scan.far_from_edges`, 1 where all energies are one).
    `on`: the device (default: that of the backend; `reference` computes on any).
    """

    def __init__(
        self,
        exposures: Exposures,
        oversample: int = 1,
        dtype: torch.dtype = torch.float32,
        backend: str = "cpu",
        dispersion: np.ndarray | None = None,
        on: torch.device | None = None,
    ) -> None:
        require(oversample >= 1, f"oversample must be at least 1, but it is {oversample}.")
        known = dtype in (torch.float32, torch.float64)
        require(known, f"the wave optics computes in float32 or float64, but {dtype} is asked for.")
        self.exposures, self.oversample, self.dtype = exposures, int(oversample), dtype
        self._optical = exposures.optical
        self.backend = resolve("reference" if dtype == torch.float64 else backend)
        self.device = on or device(self.backend)
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
        one = None if self.views.has_one_pixel else False  # scaled distances are those of Fresnel's kernel alone
        self.path = self._path(None, None, None, one)
        wall, units = (
            exposures.wall,
            (wavenumber(exposures.energy_kev)[:, None, None] * ratio.reshape(len(exposures), -1, 2)),
        )
        known = None if wall is None else wall.behind(self.views, units[:, -1, 1], units[:, -1, 0])
        self._wall = None if known is None else known.to(self.device, dtype)
        """Line integrals [2, V, H or 1, W] of β and δ of the known wall; None without one."""
        self._more: Tensor | None = None
        if wall is not None:
            nothing = torch.zeros((2, len(self.views), *self.views.shape), dtype=dtype)
            self._more = beside_faces(exposures, self.frames(LineIntegrals.of(*nothing)))

    @cached_property
    def poses(self) -> Poses:
        """The views, ready for kernels on the instrument's device."""
        return Poses.of(self.views, self.device)

    @cached_property
    def detector(self) -> Poses:
        """The views on the detector's own pixels, for what is no wave."""
        return Poses.of(self.exposures.views, self.device)

    @cached_property
    def times(self) -> np.ndarray:
        """The distinct times of the exposures [s], in order."""
        return np.unique(self.exposures.time)

    def frames(
        self,
        lines: LineIntegrals,
        index: np.ndarray | Tensor | None = None,
        distance: Tensor | None = None,
        psf_sigma_px: Tensor | None = None,
    ) -> Tensor:
        """Frames [V, H, W] from line integrals on `self.views` (or its views `index`), in the instrument's type.

        distance, psf_sigma_px: other distances [V] [m], on pixels of the views' pitch (`Exposures.optical`), and
        point-spread functions [V] [pixels] than those of the exposures, float64, with gradients if they require them.
        """
        chosen = None if index is None else torch.as_tensor(index, device=self.device)
        if self._wall is not None:
            known = self._wall if chosen is None else self._wall[:, chosen]
            lines = LineIntegrals.of(*(known + torch.stack((lines[0], lines[1])).to(known)))
        if len(lines.materials) > MOST_CHANNELS:
            lines = LineIntegrals.of(*lines)
        if distance is None and psf_sigma_px is None:
            path = self.path if chosen is None else self.path[chosen]
        else:
            path = self._path(chosen, distance, psf_sigma_px, self.path.beyond is not None)
        refraction = self.refraction(lines.materials, chosen)
        found = hologram(lines.channels.to(self.device, self.dtype), refraction, path, self.backend)
        return found if self._more is None else found + (self._more if chosen is None else self._more[chosen])

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

    def _path(
        self, index: Tensor | None, distance: Tensor | None, psf_sigma_px: Tensor | None, exact: bool | None
    ) -> OpticalPath:
        """The path of the views `index` at other distances, or through other point-spread functions; exact: as of
        `optical_path`."""
        taken = self._optical if index is None else self._optical[index.cpu().numpy()]
        my, mx = (m * self.oversample for m in self.margin)
        sigma = taken.psf_sigma_px if psf_sigma_px is None else psf_sigma_px
        return optical_path(
            self.views.shape,
            self.views.pitch,
            taken.energy_kev,
            taken.distance if distance is None else distance,
            sigma * self.oversample,
            (taken.views.shape, (my, mx), self.oversample),
            self.dtype,
            exact=exact,
        ).to(self.device)

    def image(self, B: Tensor, D: Tensor, index: np.ndarray | None = None) -> Tensor:
        """Frames [V, H, W] from line integrals B, D [V, H', W'] in metres on `self.views` (or its views `index`)."""
        return self.frames(LineIntegrals.of(B, D), index)


def _factors(wavenumbers: np.ndarray, dispersion: np.ndarray, device: torch.device) -> np.ndarray | Tensor:
    """k [V] times the dispersion [V, 2] or [V, C, 2] of δ and β: [1, C, 2] if that is the same in all views.

    Else a tensor [V, C, 2] on `device`. C is 1 where all channels are alike.
    """
    factors = wavenumbers[:, None, None] * dispersion.reshape(len(wavenumbers), -1, 2)
    return factors[:1] if (factors == factors[:1]).all() else torch.from_numpy(factors).to(device)
