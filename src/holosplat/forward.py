"""The spine: project → transmit → propagate → detect. Simulation and reconstruction both run it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from .backends import device, resolve
from .checks import in_range, require
from .optics.detector import poisson
from .optics.hologram import hologram, optical_path
from .optics.sampling import GUARD_PX as GUARD_PX
from .optics.sampling import padding, resolving_oversample
from .scan import Exposures, Scan, interleaved_split
from .units import wavenumber
from .volume import LineIntegrals, Object

SIMULATED_FRINGE_SAMPLES = 8
"""Samples on the first fringe in simulations: frames of rounded bodies are then right to 0.5 % of their contrast
(rms); faces exactly along the beam, where the phase jumps, converge more slowly (a few per cent)."""
MOST_SAMPLES = 1_000_000_000
"""Samples of all waves held at once, at most (16 GB as complex128)."""
PHOTON_RANGE = (1e-3, 1e15)


class Instrument:
    """The wave optics of some exposures, made ready: line integrals in, frames out, differentiable.

    The line integrals live on `views`: the detector's raster, padded by the fringes' reach so that nothing
    wraps around, and `oversample` times finer than the detector. `backend`: `cpu`, `cuda`, `reference` or
    `auto` (see `backends`); float64 (`dtype`) is what only `reference` computes in, and stands for it.
    """

    def __init__(
        self,
        exposures: Exposures,
        oversample: int = 1,
        dtype: torch.dtype = torch.float32,
        backend: str = "cpu",
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
        k = wavenumber(self.exposures.energy_kev)
        refraction = [(k * delta, k * beta) for delta, beta in lines.materials]
        path = self.path if index is None else self.path[torch.as_tensor(index, device=self.device)]
        return hologram(lines.channels.to(self.device, self.dtype), refraction, path, self.backend)

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
            lines = lines if isinstance(lines, LineIntegrals) else LineIntegrals.of(*lines)
            part = self.frames(lines, index[at])
            if len(at) == len(index):
                return part
            frames = frames if len(frames) else part.new_empty((len(index), *part.shape[1:]))
            frames[at] = part
        return frames


def measure(obj: Object, exposures: Exposures, oversample: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Frames [N, H, W] (relative intensity) that `obj` gives in `exposures`, on waves `oversample` times finer."""
    return Instrument(exposures, oversample, dtype).measure(obj)


def simulate(
    obj: Object,
    exposures: Exposures,
    *,
    photons_per_pixel: float | None = None,
    seed: int = 0,
    is_test: np.ndarray | None = None,
    oversample: int | None = None,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> Scan:
    """A scan of `obj`: float64 waves on a fine raster, integrated over pixels, then photon noise if asked for.

    is_test: [N] bool, default every fourth frame; oversample: samples per pixel, default from the fringe width;
    `on_progress(fraction)` is called after each view.
    """
    if photons_per_pixel is not None:
        in_range("photons_per_pixel", photons_per_pixel, *PHOTON_RANGE)
    require(seed >= 0, f"seed must be 0 or more, but it is {seed}.")
    fine = oversample or resolving_oversample(exposures, SIMULATED_FRINGE_SAMPLES, at_least=4)
    frames = np.empty((len(exposures), *exposures.views.shape))
    for i in range(len(exposures)):  # one at a time: a fine padded raster is large
        frames[i] = measure(obj, exposures[[i]], fine, torch.float64)[0].numpy()
        on_progress((i + 1) / len(exposures))
    if photons_per_pixel is not None:
        frames = poisson(frames, photons_per_pixel, seed)
    split = interleaved_split(len(exposures)) if is_test is None else is_test
    made_by = {
        "simulated_with_oversample": str(fine),
        "photons_per_pixel": str(photons_per_pixel or "none"),
        "seed": str(seed),
    }
    return Scan(frames.astype(np.float32), exposures, split, made_by)
