"""How far predicted frames are from measured ones in pixels of thickness, with the low frequencies raised."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...checks import require
from ...matter import Matter
from ...model import Instrument
from ...optics.noise import noise_level
from ...optics.retrieval.spectra import sensitivity
from ...scan import Exposures, Scan
from ...units import wavelength, wavenumber

DARKEST = 1e-12
"""Smallest intensity whose root is taken: the slope of √I has a pole at zero."""
NOISE_FLOOR = 5.0
"""What the floor rises by for every pixel of thickness that the noise amounts to."""


class SpectralMisfit:
    """½ Σ (r, W r) over the pixels of each view, with `r = (√I - √I₀) / (k p |δ| s)` and I from the full wave model.

    Amplitudes √I have the same noise everywhere (Godard et al. 2012, eq. 9). A pixel of thickness p of the material
    changes them by up to k p |δ| s, so r is a thickness in pixels; δ, β: of the first material of `matter`; s: 1 where
    fringes are seen, else less (`optics.retrieval.spectra.sensitivity`). W divides the spectrum by `H² + f²`: H s =
    sin χ + (β/δ) cos χ is the linear response of single views (Cloetens et al. 1999, eq. 3; χ = πλz f²) up to its first
    maximum, and H = 1/s beyond. Without W, shapes larger than some fringes hardly count. The smaller f, the larger the
    shapes that are fitted, and the more of the noise: f is `floor` and more where frames are noisy. Errors:
    `InputError` for matter whose δ is zero.
    """

    def __init__(self, train: Scan, instrument: Instrument, matter: Matter, floor: float) -> None:
        require(matter.delta != 0, "a spectral misfit needs a material with a δ, but it is 0.")
        on, exposures = instrument.device, train.exposures
        ratio = matter.beta / matter.delta
        strongest = sensitivity(exposures, ratio)
        delta = exposures.refraction(abs(matter.delta), 0.0)[0]
        phase = wavenumber(exposures.energy_kev) * delta * train.views.finest
        unit = phase * strongest
        self._unit = torch.from_numpy(unit).float()[:, None, None].to(on)
        self._amplitudes = torch.from_numpy(train.frames).clamp_min(0).sqrt().to(on)
        response = linear_response(exposures, ratio) / torch.from_numpy(strongest)[:, None, None]
        self.noise = noise_level(self._amplitudes) / float(unit.mean())
        """Standard deviation of r that the noise of the measured frames gives [pixels of thickness]."""
        self.floor = floor + NOISE_FLOOR * self.noise
        """f, which noise has raised."""
        self._weights = (1 / (response**2 + self.floor**2)).float().to(on)

    def __call__(self, frames: Tensor, index: Tensor | None = None) -> Tensor:
        """Misfits [V] of predicted frames [V, H, W] of all views, or of the views `index` [V]."""
        measured, weights, unit = self._amplitudes, self._weights, self._unit
        if index is not None:
            measured, weights, unit = measured[index], weights[index], unit[index]
        residual = (frames.clamp_min(DARKEST).sqrt() - measured) / unit
        shape = (residual.shape[-2], residual.shape[-1])
        weighted = torch.fft.irfft2(torch.fft.rfft2(residual) * weights, s=shape)
        return 0.5 * (residual * weighted).sum(dim=(1, 2))


def linear_response(exposures: Exposures, absorption: float) -> Tensor:
    """|H| [V, H, W//2 + 1] for `rfft2`, float64, of a thin object with β/δ = `absorption` at the reference energy;
    1 beyond its maximum."""
    exposures = exposures.optical
    views = exposures.views
    fy, fx = np.fft.fftfreq(views.shape[0], views.pixel_size), np.fft.rfftfreq(views.shape[1], views.pixel_size)
    reach = (wavelength(exposures.energy_kev) * exposures.distance)[:, None, None]
    chi = np.pi * reach * (fy[:, None] ** 2 + fx**2)
    delta, beta = (values[:, None, None] for values in exposures.refraction(1.0, absorption))
    response = np.abs(np.sin(chi) + beta / delta * np.cos(chi))
    return torch.from_numpy(np.where(chi < 0.5 * np.pi, response, 1.0))
