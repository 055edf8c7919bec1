"""The wave optics of some exposures: line integrals in, frames out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..backends import device, resolve
from ..checks import require
from ..geometry import Poses
from ..optics.coherence import quadrature
from ..optics.hologram import OpticalPath, Refraction, hologram, optical_path
from ..optics.retrieval.contact import beside_faces
from ..optics.sampling import padding
from ..scan import Exposures, far_from_edges
from ..units import wavenumber
from ..volume import LineIntegrals

MOST_SAMPLES = 1_000_000_000
"""Samples of all waves held at once, at most (16 GB as complex128)."""

Light = tuple[Tensor | None, Tensor | None]
"""Energies over the planned ones [V], and bandwidths [V], float64; None: as planned."""

MOST_CHANNELS = 2
"""Channels of matter that the kernels of the waves take; more are summed to δ and β first."""


@dataclass(frozen=True)
class _Colour:
    """One energy of the light: its node of the quadrature and weight, the frames' energies [V] [keV], their waves, and
    k times the dispersion of matter."""

    node: float
    weight: float
    energies: np.ndarray
    path: OpticalPath
    factors: np.ndarray | Tensor


class Instrument:
    """The wave optics of some exposures, made ready: line integrals in, frames out, differentiable.

    The line integrals [m] live on `views`: the detectors' rasters, padded by the fringes' reach so that nothing
    wraps around, and `oversample` times finer than the detector. `backend`: `cpu`, `cuda`, `reference` or
    `auto` (see `backends`); float64 (`dtype`) is what only `reference` computes in, and stands for it.
    `dispersion`: factors [V, 2], or of each channel of matter [V, C, 2], of δ and β at the frames' energies over those
    at the reference energy (`materials.dispersion`; default: `scan.far_from_edges`, 1 where all energies are one).
    `on`: the device (default: that of the backend; `reference` computes on any).
    Frames of light with a bandwidth are the incoherent sum over a few energies (`optics.coherence.quadrature`), with
    `δ ∝ E⁻²`, `β ∝ E⁻⁴` within it; frames of one energy cost what they did.
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
        one = None if self.views.has_one_pixel else False  # scaled distances are those of Fresnel's kernel alone
        self._colours = [self._colour(*each, ratio, one) for each in zip(*quadrature(exposures))]
        self.path = self._colours[len(self._colours) // 2].path
        """The waves' path at the energy nearest to the middle of the spectrum."""
        wall = exposures.wall
        units = wavenumber(exposures.energy_kev)[:, None, None] * ratio.reshape(len(exposures), -1, 2)
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
        light: Light | None = None,
    ) -> Tensor:
        """Frames [V, H, W] from line integrals on `self.views` (or its views `index`), in the instrument's type.

        distance, psf_sigma_px: other distances [V] [m], on pixels of the views' pitch (`Exposures.optical`), and
        point-spread functions [V] [pixels] than those of the exposures, float64, with gradients if they require them.
        light: likewise, energies over the planned ones [V], and bandwidths [V]. A spectrum has as many energies as the
        planned bandwidth needs, so that a fit of bandwidths starts from one above 0; else `InputError`.
        """
        chosen = None if index is None else torch.as_tensor(index, device=self.device)
        if self._wall is not None:
            known = self._wall if chosen is None else self._wall[:, chosen]
            lines = LineIntegrals.of(*(known + torch.stack((lines[0], lines[1])).to(known)))
        if len(lines.materials) > MOST_CHANNELS:
            lines = LineIntegrals.of(*lines)
        parts = [self._of_one(colour, lines, chosen, distance, psf_sigma_px, light) for colour in self._colours]
        found = parts[0]
        if len(parts) > 1:
            found = sum((colour.weight * part for colour, part in zip(self._colours, parts)), torch.zeros_like(found))
        return found if self._more is None else found + (self._more if chosen is None else self._more[chosen])

    def _of_one(
        self,
        colour: _Colour,
        lines: LineIntegrals,
        chosen: Tensor | None,
        distance: Tensor | None,
        psf_sigma_px: Tensor | None,
        light: Light | None,
    ) -> Tensor:
        """Frames [V, H, W] of one energy of the light."""
        channels = lines.channels.to(self.device, self.dtype)
        if light is not None:
            one = not isinstance(colour.factors, Tensor) or colour.factors.shape[1] == 1
            require(one, "an energy or bandwidth that is fitted needs matter of one dispersion, but it has several.")
            ratio = self._relative(colour, chosen, light)
            lines = LineIntegrals.of(*lines)
            scale = torch.stack((1 / ratio, ratio**-3), dim=1).to(self.dtype)  # of kδ and kβ
            channels = lines.channels.to(self.device, self.dtype) * scale[:, :, None, None]
            planned = self._optical.distance if chosen is None else self._optical.distance[chosen.cpu().numpy()]
            distance = (torch.from_numpy(planned).to(ratio) if distance is None else distance) / ratio
        if distance is None:
            path = colour.path if chosen is None else colour.path[chosen]
            path = path if psf_sigma_px is None else path.corrected(psf_sigma=psf_sigma_px * self.oversample)
        else:
            path = self._path(colour.energies, chosen, distance, psf_sigma_px, self.path.beyond is not None)
        return hologram(channels, _refraction(colour.factors, lines.materials, chosen), path, self.backend)

    def _relative(self, colour: _Colour, chosen: Tensor | None, light: Light) -> Tensor:
        """Energies [V] of `light` over those of the `colour`."""
        energy, bandwidth = light
        alone = len(self._colours) == 1 and bandwidth is not None
        require(not alone, "a fit of the bandwidth needs a planned one above 0, but it is 0; give one (--bandwidth).")
        planned = torch.from_numpy(self.exposures.bandwidth).to(self.device)
        planned = planned if chosen is None else planned.index_select(0, chosen)
        width = planned if bandwidth is None else bandwidth
        ratio = (1 + colour.node * width) / (1 + colour.node * planned)
        return ratio if energy is None else ratio * energy

    def refraction(self, materials: Sequence[tuple[float, float]], index: Tensor | None = None) -> Refraction:
        """`(k δ, k β)` of each channel as `hologram` takes them, at `path`'s energy: see `_refraction`."""
        return _refraction(self._colours[len(self._colours) // 2].factors, materials, index)

    def _colour(self, node: float, weight: float, dispersion: np.ndarray, exact: bool | None) -> _Colour:
        shift = 1 + node * self._optical.bandwidth
        energies = self._optical.energy_kev * shift
        within = np.stack((shift**-2, shift**-4), axis=-1).reshape(-1, 1, 2)
        factors = _factors(wavenumber(energies), dispersion.reshape(len(shift), -1, 2) * within, self.device)
        return _Colour(node, weight, energies, self._path(energies, None, None, None, exact), factors)

    def _path(
        self,
        energies: np.ndarray,
        index: Tensor | None,
        distance: Tensor | None,
        psf_sigma_px: Tensor | None,
        exact: bool | None,
    ) -> OpticalPath:
        """The path of the views `index` at `energies` of all views [V] [keV], at other distances, or through other
        point-spread functions; exact: as of `optical_path`."""
        taken = self._optical if index is None else self._optical[index.cpu().numpy()]
        my, mx = (m * self.oversample for m in self.margin)
        sigma = taken.psf_sigma_px if psf_sigma_px is None else psf_sigma_px
        return optical_path(
            self.views.shape,
            self.views.pitch,
            energies if index is None else energies[index.cpu().numpy()],
            taken.distance if distance is None else distance,
            sigma * self.oversample,
            (taken.views.shape, (my, mx), self.oversample),
            self.dtype,
            exact=exact,
        ).to(self.device)

    def image(self, B: Tensor, D: Tensor, index: np.ndarray | None = None) -> Tensor:
        """Frames [V, H, W] from line integrals B, D [V, H', W'] in metres on `self.views` (or its views `index`)."""
        return self.frames(LineIntegrals.of(B, D), index)


def _refraction(
    factors: np.ndarray | Tensor, materials: Sequence[tuple[float, float]], index: Tensor | None
) -> Refraction:
    """`(k δ, k β)` of each channel as `hologram` takes them: [C, 2], or [K, C, 2] where they differ between views.

    factors: as of `_factors`; materials: (δ, β) of each channel at the reference energy; index: views [K] on the
    instrument's device.
    """
    channels = [min(c, factors.shape[1] - 1) for c in range(len(materials))]
    if isinstance(factors, np.ndarray):
        return [(f[0] * m[0], f[1] * m[1]) for f, m in zip(factors[0, channels].tolist(), materials)]
    factors = factors if index is None else factors.index_select(0, index)
    pairs = [factors[:, c].unbind(1) for c in channels]
    return torch.stack([torch.stack((f * d, g * b), dim=1) for (f, g), (d, b) in zip(pairs, materials)], dim=1)


def _factors(wavenumbers: np.ndarray, dispersion: np.ndarray, device: torch.device) -> np.ndarray | Tensor:
    """k [V] times the dispersion [V, 2] or [V, C, 2] of δ and β: [1, C, 2] if that is the same in all views.

    Else a tensor [V, C, 2] on `device`. C is 1 where all channels are alike.
    """
    factors = wavenumbers[:, None, None] * dispersion.reshape(len(wavenumbers), -1, 2)
    return factors[:1] if (factors == factors[:1]).all() else torch.from_numpy(factors).to(device)
