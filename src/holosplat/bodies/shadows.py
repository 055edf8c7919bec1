"""Thickness in frames of several times, and its residual after affine bodies on straight paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..matter import DeltaBeta
from ..optics.noise import noise_level, noise_levels
from ..optics.retrieval import FIXED, Tikhonov, tikhonov, without_halo
from ..projectors.surface import surface_thickness
from ..scan import Exposures, Scan
from ..units import wavelength, wavenumber

QUIETEST = 1e-4
"""Noise of frames that is assumed at least."""
AIR = 0.1
"""Thickness that passes for air, at least [pixels]."""
ALONG = 1e-9
"""By how much directions of rows may differ [1], and places of rows [m], for these to be the same."""
EVERYWHERE = 1e-3
"""Information at all frequencies beside that of phase contrast: frames in contact have that alone."""


@dataclass(frozen=True)
class Shadows:
    """Thickness of one material in N frames, lengths in pixels.

    thickness: [N, H, W] float64; rotations [N, 3, 3], shifts [N, 2] float64: as of `surface_thickness`; times: [N],
    from -1 to 1 over the whole scan; noise: standard deviation of the thickness; fringes: [N] λz/p², contrast: [N]
    2kδp over the noise of a frame's pixel, p the pixel size.
    """

    thickness: np.ndarray
    rotations: Tensor
    shifts: Tensor
    times: np.ndarray
    noise: float
    fringes: np.ndarray
    contrast: np.ndarray

    @classmethod
    def of(cls, scan: Scan, material: DeltaBeta, first: float, last: float) -> Shadows:
        """The shadows in the frames of `scan`, of pixels of one size; first, last: times [s] of the whole scan."""
        exposures, views, pitch = scan.exposures, scan.views.parallel("the search for bodies"), scan.views.pixel_size
        frames = torch.from_numpy(scan.frames)
        how = Tikhonov(prior=FIXED)  # bodies are cut by the frames' edges
        thickness = tikhonov(frames, exposures, *material, options=how, missing=scan.gaps).double() / pitch
        noise = noise_level(thickness.float())
        if np.ptp(exposures.time) == 0:  # a search of several times found fewer bodies so (docs/notebook/motion.md)
            thickness = _without_halos(thickness, exposures, noise)
        per_pixel = 2 * wavenumber(exposures.energy_kev) * exposures.refraction(*material)[0] * pitch
        return cls(
            thickness.numpy(),
            torch.from_numpy(np.ascontiguousarray(views.rotations)),
            torch.from_numpy(views.shifts / pitch),
            2 * (exposures.time - first) / (last - first) - 1,
            noise,
            wavelength(exposures.energy_kev) * exposures.distance / pitch**2,
            per_pixel / max(float(noise_levels(scan.measured).mean()), QUIETEST),
        )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.thickness.shape[1], self.thickness.shape[2]

    def binned(self, factor: int) -> Shadows:
        """The same on pixels `factor` times as large; rows and columns that are left over at the end are left out."""
        if factor == 1:
            return self
        n, (h, w) = len(self), (self.shape[0] // factor, self.shape[1] // factor)
        parts = self.thickness[:, : h * factor, : w * factor].reshape(n, h, factor, w, factor)
        moved = 0.5 * (np.array([w, h]) * factor - np.array(self.shape[::-1])) / factor
        return replace(
            self,
            thickness=parts.mean((2, 4)) / factor,
            shifts=self.shifts / factor + torch.from_numpy(moved),
            noise=self.noise / factor**2,
            fringes=self.fringes / factor**2,
            contrast=self.contrast * factor**2,
        )

    def without(self, images: np.ndarray) -> Shadows:
        """The same beside matter that has the thickness `images` [N, H, W]."""
        return replace(self, thickness=self.thickness - images)

    def at(self, numbers: Sequence[int] | np.ndarray) -> Shadows:
        """The frames `numbers`."""
        index = np.asarray(numbers)
        parts = {name: getattr(self, name)[index] for name in ("thickness", "rotations", "shifts", "times")}
        return replace(self, **parts, fringes=self.fringes[index], contrast=self.contrast[index])

    def information(self, n: int, size: tuple[int, int]) -> Tensor:
        """Fisher information |H|²/σ² of frame `n` on thickness at each frequency of `rfft2` on a raster of `size`."""
        fy, fx = np.fft.fftfreq(size[0]), np.fft.rfftfreq(size[1])
        chi = np.pi * self.fringes[n] * (fy[:, None] ** 2 + fx**2)
        return torch.from_numpy((self.contrast[n] * np.sin(chi)) ** 2 + EVERYWHERE).float()

    def project(self, nodes: Sequence[Tensor] | Tensor, faces: Tensor, lines: int = 1) -> Tensor:
        """Thickness [N, H, W] of a mesh with vertices `nodes` [N, P, 3] in each frame; differentiable."""
        images = []
        for time in np.unique(self.times):
            own = np.flatnonzero(self.times == time)
            found = surface_thickness(nodes[own[0]], faces, self.rotations[own], self.shifts[own], self.shape, lines)
            images.append((own, found))
        order = np.argsort(np.concatenate([own for own, _ in images]))
        return torch.cat([found for _, found in images])[torch.from_numpy(order)]


def _without_halos(thickness: Tensor, exposures: Exposures, noise: float) -> Tensor:
    """Thickness [N, H, W] [pixels] of one time without the halos of bodies that an edge cuts, where that is likelier.

    What is fitted for a halo may be matter, where bodies fill an edge. So it is taken out only if beams then agree
    better on how much matter each row holds (the moments of order zero: Helgason 1999, The Radon Transform, section
    1.2), or if more of the frames is air.
    """
    cleared, limit, views = without_halo(thickness, noise), max(AIR, 2 * noise), exposures.views
    alike = np.ptp(views.rotations[:, 1], axis=0).max() < ALONG and np.ptp(views.shifts[:, 1]) < ALONG
    agreed = alike and _disagreement(cleared) < _disagreement(thickness)
    return cleared if agreed or (cleared.abs() < limit).sum() > (thickness.abs() < limit).sum() else thickness


def _disagreement(thickness: Tensor) -> float:
    """Of frames [N, H, W] on how much matter each row holds, over how much that is: a root mean square."""
    rows = thickness.sum(2)
    return float((rows - rows.mean(0)).square().mean().sqrt() / rows.abs().mean().clamp_min(1e-12))
