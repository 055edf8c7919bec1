"""The spine: project → transmit → propagate → detect. Simulation and reconstruction both run it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .backends import device, resolve
from .checks import in_range, require
from .memory import memory_kept
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
MOST_PULSES = 10_000


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
            part = self.frames(LineIntegrals.of_any(lines), index[at])
            if len(at) == len(index):
                return part
            frames = frames if len(frames) else part.new_empty((len(index), *part.shape[1:]))
            frames[at] = part
        return frames


def measure(obj: Object, exposures: Exposures, oversample: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Frames [N, H, W] (relative intensity) that `obj` gives in `exposures`, on waves `oversample` times finer."""
    return Instrument(exposures, oversample, dtype).measure(obj)


@dataclass(frozen=True)
class Shutter:
    """How long a frame gathers light, and when: a train of flashes, each shorter than any motion.

    exposure: its length [s], about the frame's time; pulses: flashes, each in the middle of an equal part of it. A
    steady beam is many pulses. Errors: `InputError` for a negative length, and for one without the other.
    """

    exposure: float = 0.0
    pulses: int = 1

    def __post_init__(self) -> None:
        require(
            math.isfinite(self.exposure) and self.exposure >= 0,
            f"exposure must be 0 seconds or more, but it is {self.exposure:g}; correct it.",
        )
        require(
            1 <= self.pulses <= MOST_PULSES, f"pulses must lie between 1 and {MOST_PULSES}, but it is {self.pulses}."
        )
        require(
            (self.exposure > 0) == (self.pulses > 1),
            f"motion blur needs both an exposure above 0 s and at least 2 pulses, but they are {self.exposure:g} s and "
            f"{self.pulses}; give both or neither.",
        )

    @property
    def offsets(self) -> np.ndarray:
        """When the pulses come, [pulses] seconds after the frame's time; their mean is 0."""
        return ((np.arange(self.pulses) + 0.5) / self.pulses - 0.5) * self.exposure


@dataclass(frozen=True)
class Simulation:
    """How frames are simulated: photons_per_pixel: mean counts of Poisson noise, or none; seed: of the noise;
    oversample: samples a pixel, or by default as many as the fringes need; shutter: when light is gathered.

    Errors: `InputError` for photons or a seed out of range.
    """

    photons_per_pixel: float | None = None
    seed: int = 0
    oversample: int | None = None
    shutter: Shutter = Shutter()

    def __post_init__(self) -> None:
        if self.photons_per_pixel is not None:
            in_range("photons_per_pixel", self.photons_per_pixel, *PHOTON_RANGE)
        require(self.seed >= 0, f"seed must be 0 or more, but it is {self.seed}.")

    def samples(self, exposures: Exposures) -> int:
        """Samples along a pixel's edge for `exposures`."""
        return self.oversample or resolving_oversample(exposures, SIMULATED_FRINGE_SAMPLES, at_least=4)

    def provenance(self, exposures: Exposures) -> dict[str, str]:
        """What a scan file says of how its frames were made."""
        made_by = {
            "simulated_with_oversample": str(self.samples(exposures)),
            "photons_per_pixel": str(self.photons_per_pixel or "none"),
            "seed": str(self.seed),
        }
        shutter = {"exposure_s": f"{self.shutter.exposure:g}", "pulses": str(self.shutter.pulses)}
        return made_by | (shutter if self.shutter.pulses > 1 else {})


def simulated_frames(obj: Object, exposures: Exposures, how: Simulation = Simulation()) -> Iterator[np.ndarray]:
    """Frames [H, W] float32 of `obj`, one after another: memory is that of one frame, however many there are.

    Plain torch (the `reference` of the optics, which no fit uses) on a fine raster in single precision, 1e-6 of the
    contrast from double precision. A frame is the mean of the intensities at its pulses, with noise if asked for.
    """
    fine, noise = how.samples(exposures), np.random.default_rng(how.seed)
    with memory_kept():
        for i, time in enumerate(exposures.time):
            instrument = Instrument(exposures[[i]], fine, torch.float32, "reference")
            frame = np.zeros(exposures.views.shape)
            for offset in how.shutter.offsets:
                lines = obj.at(float(time + offset)).project(instrument.views)
                frame += instrument.frames(LineIntegrals.of_any(lines))[0].numpy()
            frame /= how.shutter.pulses
            photons = how.photons_per_pixel
            yield (frame if photons is None else poisson(frame, photons, noise)).astype(np.float32)


def simulate(
    obj: Object,
    exposures: Exposures,
    *,
    photons_per_pixel: float | None = None,
    seed: int = 0,
    is_test: np.ndarray | None = None,
    oversample: int | None = None,
    shutter: Shutter = Shutter(),
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> Scan:
    """A scan of `obj`, held in memory (`simulated_frames` gives frame by frame): waves on a fine raster, integrated
    over pixels, then photon noise if asked for.

    is_test: [N] bool, default every fourth frame; oversample: samples per pixel, default from the fringe width;
    shutter: motion blur; `on_progress(fraction)` is called after each frame.
    """
    how = Simulation(photons_per_pixel, seed, oversample, shutter)
    frames = np.empty((len(exposures), *exposures.views.shape), dtype=np.float32)
    for i, frame in enumerate(simulated_frames(obj, exposures, how)):
        frames[i] = frame
        on_progress((i + 1) / len(exposures))
    split = interleaved_split(len(exposures)) if is_test is None else is_test
    return Scan(frames, exposures, split, how.provenance(exposures))
