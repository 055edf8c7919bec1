"""How noisy frames are, by the frames alone; pixels that are NaN have no value, and no weight. `NoiseModel`: the noise
of each frame, white and correlated, as power at every spatial frequency."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from ..checks import require
from ..frames import rfft_weights
from .air import find_air, has_air
from .patterns import smooth_modes

TILE, QUIET = 16, 0.05
"""Edge of the tiles in which the noise is measured [pixels], and the quantile of the tiles' values that is believed."""
NORMAL_MEDIAN = 0.6745
"""The median of |x| for a standard normal x."""
NORMS = (1.0, math.sqrt(2), math.sqrt(6))
"""Of the differences of order 0, 1 and 2: roots of the summed squares of 1; 1, -1; 1, -2, 1."""
QUIET_TILE = 0.86
"""Ratio of the estimate from quiet tiles to the standard deviation, in pure noise (measured on frames of about 96²
pixels)."""

PHOTON_RANGE = (1e-3, 1e15)
"""Photons a pixel that noise can be simulated for."""


def with_gaps(frames: Tensor, missing: Tensor | None) -> Tensor:
    """Frames [V, H, W] that are NaN where they are `missing` [V, H, W] bool (None: nowhere)."""
    return frames if missing is None else frames.masked_fill(missing.to(frames.device), torch.nan)


def left_of(measured: Tensor, predicted: Tensor) -> Tensor:
    """Frames [V, H, W] less those predicted, 0 where they are NaN; what is predicted without a value stays NaN."""
    return (measured - predicted).masked_fill(measured.isnan(), 0.0)


def noise_level(images: Tensor) -> float:
    """Standard deviation of white noise on images [V, H, W].

    The estimate uses the medians of |second differences along both axes| (the mask of Immerkær 1996, eq. 2, of norm 6)
    in the quiet tiles. Fringes that fill a tile count as noise. The estimate is some per cent too low. Images of one or
    two rows, or columns, have differences of lower order across them; tiles of few rows are longer.
    """
    differences, norm = _rough(images)
    rows, columns = differences.shape[1:]
    h = min(TILE, rows)
    w = min(TILE if rows >= TILE // 2 else TILE**2 // h, columns)
    tiles = differences.unfold(1, h, h).unfold(2, w, w).flatten(3).nanmedian(dim=-1).values
    return float(tiles.flatten().nanquantile(QUIET)) / (norm * NORMAL_MEDIAN)


def _rough(images: Tensor) -> tuple[Tensor, float]:
    """|Differences| of images [V, H, W] along both axes, of second order where there are three samples, and their norm:
    what they make of the standard deviation of white noise."""
    norm = 1.0
    for axis in (1, 2):
        order = min(2, images.shape[axis] - 1)
        images, norm = images.diff(n=order, dim=axis), norm * NORMS[order]
    return images.abs(), norm


def wavelet_noise(frames: Tensor) -> Tensor:
    """Standard deviation [V] of the noise, float64: median absolute deviation of the finest diagonal Haar wavelets.

    Donoho & Johnstone (1994), section 4.2. Fringes of the finest pitch pass for noise. Frames of one row, or one
    column, have no diagonal; second differences along them take its place.
    """
    i = frames.detach().double()
    if min(i.shape[1:]) < 2:
        differences, norm = _rough(i)
        return differences.flatten(1).nanmedian(1).values / (norm * NORMAL_MEDIAN)
    diagonal = 0.5 * (i[:, :-1, :-1] + i[:, 1:, 1:] - i[:, :-1, 1:] - i[:, 1:, :-1])
    return diagonal.abs().flatten(1).nanmedian(1).values / NORMAL_MEDIAN


def noise_levels(frames: Tensor) -> Tensor:
    """Standard deviation [V] of the white noise on each of frames [V, H, W], float64.

    The lesser of two estimates, for each takes some signal for noise: `noise_level`, its bias mended, where fringes
    fill all tiles (small frames), and `wavelet_noise` where they fill most of the frame (crowded ones).
    """
    return torch.minimum(_of_quiet_tiles(frames), wavelet_noise(frames).cpu())


def sure_noise(frames: Tensor) -> Tensor:
    """The part of `noise_levels` that is surely noise, [V], float64: zero where fringes fill the frames.

    Both estimates agree on white noise, but not on fringes. If the quiet tiles hold fringes of variance a, and all
    wavelets fringes of at least twice that variance, then `σ² ≥ 2 t² - w²`.
    """
    tiles, wavelets = _of_quiet_tiles(frames), wavelet_noise(frames).cpu()
    surely = (2 * tiles.square() - wavelets.square()).clamp_min(0).sqrt()
    return torch.minimum(surely, torch.minimum(tiles, wavelets))


def _of_quiet_tiles(frames: Tensor) -> Tensor:
    return torch.tensor([noise_level(frame[None]) / QUIET_TILE for frame in frames], dtype=torch.float64)


def noise_share(frames: Tensor) -> float:
    """Noise as a share of the contrast of relative frames [V, H, W]: 0 for frames without, about 1 for noise alone."""
    contrast = float((frames.double() - 1).square().nanmean().sqrt())
    return min(1.0, float(noise_levels(frames).mean()) / contrast) if contrast > 0 else 0.0


DETREND = 3
"""Half waves across a frame up to which light, and not grain, changes."""
RIDGE = 1e-3
"""Of the fit of these modes to air, relative to the information of a frame that is all air."""
LAGS = 4
"""Correlations are believed up to a distance of this part of a frame's shorter side."""
DARKEST = 0.05
"""Predicted intensity below which frames are not compared with it relative to it."""
PLATEAU = 0.35
"""Spatial frequency [cycles per pixel] from which on along both axes noise passes for white."""


@dataclass(frozen=True)
class NoiseModel:
    """The noise of V frames of relative intensity, where that is about 1.

    white: [V] standard deviation of the white noise, float64
    grain: [V, H, W//2 + 1] power spectrum of the correlated noise beside it, float64, at the frequencies of `rfft2`
        and in its unitary convention: white noise of variance s² has the power s² at every frequency

    width: W; 0 stands for an even one

    The noise of amplitudes √I is half of it. Errors: `InputError` if the shapes do not match.
    """

    white: Tensor
    grain: Tensor
    width: int = 0

    def __post_init__(self) -> None:
        require(
            self.grain.ndim == 3 and self.white.shape == self.grain.shape[:1],
            f"a noise model needs white noise [V] and grain [V, H, W//2 + 1], but they have the shapes "
            f"{tuple(self.white.shape)} and {tuple(self.grain.shape)}.",
        )

    def __len__(self) -> int:
        return len(self.white)

    def __getitem__(self, index: Tensor | np.ndarray | slice) -> NoiseModel:
        """The noise of some of the frames."""
        return NoiseModel(self.white[index], self.grain[index], self.width)

    def at_least(self, level: Tensor) -> NoiseModel:
        """The noise with white noise of at least the standard deviations `level` [V]."""
        return replace(self, white=torch.maximum(self.white, level))

    def binned(self, factor: int) -> NoiseModel:
        """The noise of frames whose pixels are means of `factor` × `factor`, by that of the frames.

        Grain is taken to be smooth: what binning folds back of it counts as none.
        """
        if factor == 1:
            return self
        h, w = self.shape
        rows, columns = h // factor, w // factor
        at_rows = torch.round(torch.fft.fftfreq(rows, 1 / rows) * h / (rows * factor)).long()
        at_columns = torch.round(torch.arange(columns // 2 + 1) * w / (columns * factor)).long()
        grain = self.grain[:, at_rows][:, :, at_columns.clamp_max(self.grain.shape[2] - 1)] / factor**2
        return NoiseModel(self.white / factor, grain, columns)

    @classmethod
    def white_only(cls, white: Tensor, shape: tuple[int, int]) -> NoiseModel:
        """White noise [V] on frames of `shape` (H, W), without grain."""
        grain = torch.zeros(len(white), shape[0], shape[1] // 2 + 1, dtype=torch.float64)
        return cls(white.double(), grain, shape[1])

    @classmethod
    def of_frames(cls, frames: Tensor, air: Tensor | None = None, correlated: bool = False) -> NoiseModel:
        """The noise of relative frames [V, H, W], by their air [V, H, W] bool, or by air that they show themselves.

        Pixels that are NaN have no value, and are no air. The white noise is that of the highest frequencies in each
        frame's air; of a frame without air it is what both estimates of `noise.sure_noise` agree on: fringes that fill
        a frame are not noise. correlated: whether what correlates neighbours in air, beyond what slow light does
        (`DETREND`), is noise, too; else there is none such.
        """
        air = find_air(frames) if air is None else air
        usable = has_air(air)
        shape = (frames.shape[-2], frames.shape[-1])
        white = torch.where(usable, torch.zeros(len(frames), dtype=torch.float64), sure_noise(frames))
        if not bool(usable.any()):
            return cls.white_only(white, shape)
        rest = _without_light(frames[usable].double().nan_to_num(), air[usable])
        white[usable] = _finest(rest, air[usable])
        if not correlated:
            return cls.white_only(white, shape)
        return cls(white, _grain(rest, air[usable], white[usable])[None].expand(len(frames), -1, -1), shape[1])

    @classmethod
    def of_residuals(cls, frames: Tensor, predicted: Tensor) -> NoiseModel:
        """The noise, white and correlated, that frames [V, H, W] have beside those `predicted` by a first volume;
        pixels that are NaN have no weight."""
        rest = frames.double() / predicted.double().clamp_min(DARKEST) - 1
        known, rest = ~rest.isnan(), rest.nan_to_num()
        white = _finest(rest, known)
        return cls(white, _grain(rest, known, white)[None].expand(len(frames), -1, -1), frames.shape[-1])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames."""
        return self.grain.shape[1], self.width or 2 * (self.grain.shape[2] - 1)

    @property
    def has_grain(self) -> bool:
        """Whether any of the noise is correlated."""
        return bool((self.grain > 0).any())

    @property
    def grain_level(self) -> float:
        """Standard deviation of the grain, the mean of all frames."""
        return float(_mean_power(self.grain, self.shape).mean().sqrt())

    @property
    def level(self) -> Tensor:
        """Standard deviation [V] of all noise, float64."""
        return (self.white.square() + _mean_power(self.grain, self.shape)).sqrt()

    def with_more(self, power: Tensor) -> NoiseModel:
        """The same noise and more of the correlated kind, of `power` [H, W//2 + 1] or [V, H, W//2 + 1]."""
        return NoiseModel(self.white, self.grain + power, self.width)

    def power(self) -> Tensor:
        """Power [V, H, W//2 + 1] of all noise at the frequencies of `rfft2`, float64."""
        return self.white.square()[:, None, None] + self.grain

    def drawn(self, seed: int) -> Tensor:
        """One draw of the noise [V, H, W], float64."""
        draw = torch.Generator().manual_seed(seed)
        white = torch.randn(len(self), *self.shape, generator=draw, dtype=torch.float64)
        spectra = torch.fft.rfft2(white, norm="ortho") * self.power().sqrt()
        return torch.fft.irfft2(spectra, s=self.shape, norm="ortho")

    def power_on(self, shape: tuple[int, int], oversample: int = 1) -> Tensor:
        """The same [V, H', W'//2 + 1] at the frequencies of a raster of `shape` with pixels divided by `oversample`.

        Beyond the frequencies that pixels see there is white noise alone.
        """
        (h, w), (k, n) = self.shape, self.grain.shape[1:]
        rows, columns = np.fft.fftfreq(shape[0]) * oversample * h, np.fft.rfftfreq(shape[1]) * oversample * w
        white = self.white.square()[:, None, None].expand(-1, len(rows), len(columns))
        if not self.has_grain:
            return white
        centred = torch.fft.fftshift(self.grain, dim=1).numpy()
        at = np.stack(np.meshgrid(rows + k // 2, columns, indexing="ij"))
        inside = np.stack([map_coordinates(image, at, order=1, mode="nearest") for image in centred])
        beyond = (np.abs(rows) > k / 2)[:, None] | (columns > n)
        return white + torch.from_numpy(np.where(beyond, 0.0, inside))


def _without_light(frames: Tensor, air: Tensor) -> Tensor:
    """Residuals of frames [V, H, W] in air, relative to their slow light; zero elsewhere."""
    modes = smooth_modes((frames.shape[1], frames.shape[2]), DETREND).double().flatten(1)
    seen = air.double().flatten(1)
    normal = torch.einsum("vp,kp,lp->vkl", seen, modes, modes) / seen.shape[1]
    right = torch.einsum("vp,kp->vk", seen * frames.flatten(1), modes) / seen.shape[1]
    ridge = RIDGE * torch.eye(len(modes), dtype=torch.float64)
    ridge[0, 0] = 0.0  # the level itself costs nothing
    light = (torch.linalg.solve(normal + ridge, right) @ modes).reshape(frames.shape)
    return torch.where(air, frames / torch.where(air, light, 1.0) - 1, 0.0)


def _finest(rest: Tensor, air: Tensor) -> Tensor:
    """Standard deviation [V] of white noise by the diagonal wavelets that lie in air [V, H, W]."""
    diagonal = 0.5 * (rest[:, :-1, :-1] + rest[:, 1:, 1:] - rest[:, :-1, 1:] - rest[:, 1:, :-1])
    whole = air[:, :-1, :-1] & air[:, 1:, 1:] & air[:, :-1, 1:] & air[:, 1:, :-1]
    power = (diagonal.square() * whole).sum(dim=(1, 2)) / whole.sum(dim=(1, 2)).clamp_min(1)
    return power.sqrt()


def _grain(rest: Tensor, air: Tensor, white: Tensor) -> Tensor:
    """Power spectrum [H, W//2 + 1] of correlated noise [V, H, W] in air, that of the mean of all frames' correlations
    (Blackman & Tukey 1958, with Parzen's window) without the white noise."""
    h, w = rest.shape[1:]
    reach = max(2, min(h, w) // LAGS)
    rows, columns = (torch.fft.fftfreq(2 * n, 1 / (2 * n), dtype=torch.float64).abs() / reach for n in (h, w))
    tapered = _correlation(rest, air) * _parzen((rows[:, None].square() + columns.square()).sqrt())
    within = tapered[torch.fft.fftfreq(h, 1 / h).long()][:, torch.fft.fftfreq(w, 1 / w).long()]
    power = torch.fft.rfft2(within).real
    fy, fx = torch.fft.fftfreq(h).abs(), torch.fft.rfftfreq(w)
    high = (fy[:, None] > PLATEAU) & (fx > PLATEAU)
    plateau = float(power[high].mean()) if bool(high.any()) else float(white.square().mean())
    return (power - plateau).clamp_min(0)


def _correlation(rest: Tensor, air: Tensor) -> Tensor:
    """Mean products [2H, 2W] of noise [V, H, W] with itself at all distances in air."""
    twice = (2 * rest.shape[1], 2 * rest.shape[2])
    sums, counts = (
        torch.fft.irfft2(torch.fft.rfft2(images, s=twice).abs().square().sum(dim=0), s=twice)
        for images in (rest, air.double())
    )
    return sums / counts.clamp_min(1.0)


def _parzen(distance: Tensor) -> Tensor:
    """Parzen's (1961) window of a distance relative to its reach; its transform has no negative value."""
    near = 1 - 6 * distance.square() * (1 - distance)
    return torch.where(distance < 0.5, near, 2 * (1 - distance).clamp_min(0).pow(3))


def _mean_power(power: Tensor, shape: tuple[int, int]) -> Tensor:
    """Mean [V] over all frequencies of a spectrum [V, H, W//2 + 1] of real images of `shape` (H, W)."""
    rows, columns = shape
    return (power * torch.from_numpy(rfft_weights(columns)).to(power.dtype)).sum(dim=(1, 2)) / (rows * columns)
