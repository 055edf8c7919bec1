"""Uneven light: a smooth factor of each frame, found in air, and from what frames and matter disagree on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from ..checks import InputError
from ..divided_light import DividedLight
from ..ranges import checked_dataclass
from .air import Box, air_in_boxes, find_air, has_air
from .noise import NoiseModel
from .patterns import cosines, half_waves, posterior, smooth_modes, sums

ORDER = 8
"""Half waves across a frame up to which light changes."""
LOWEST = 2
"""Half waves up to which air is tested for unevenness."""
ROUNDS = 30
"""Rounds in which the strengths of the modes and their coefficients are found from each other."""
UNEVEN, SEEN = 6.0, 0.07
"""Light is uneven if the squares of its lowest modes in air exceed those of noise by so many of their deviations, and
it is so large a part of the frames' contrast."""
SURE, FAINT = 60.0, 0.03
"""The same of light that is faint beside the contrast: far fringes that pass for air leave as much, but less surely."""
FAINTEST = 1e-4
"""Noise [relative intensity] assumed at least: light is not known better."""
FINER = 0.15
"""Part of the light's unevenness in air that counts as noise at least: the modes do not describe the rest of it, and
fitted to that as if it were known they run away where there is no air (measured by benchmarks/air_light.py)."""
OUTER = 0.1
"""Part of the columns at either side in which light must be uneven, too."""
DARKEST = 0.05
"""Relative intensity below which a frame does not constrain the light."""
FLUX = "unequal flux"
"""What light is called that differs between frames by a factor alone."""


Kind = Literal["auto", "even", "smooth"]
Still = Literal["auto", "none"]
Noise = Literal["auto", "white", "correlated"]


@checked_dataclass
class LightOptions:
    """Assumptions about the light beyond the flat fields."""

    kind: Kind = "auto"
    """auto: smooth where evidence is for it, else even; even: none; smooth: in any case."""
    air: tuple[Box, ...] = ()
    """Boxes without matter or fringes in any frame: first row, end row, first column, end column (default: found)."""
    still: Still = "auto"
    """auto: a pattern that all frames have in common, pixel by pixel, is divided out where evidence is for it; none:
    there is none. Where `kind` is even, there is none either."""
    noise: Noise = "auto"
    """auto: correlated where evidence is for it, else white; white; correlated: in any case."""

    def air_of(self, frames: Tensor) -> Tensor:
        """The air [V, H, W] bool of frames [V, H, W]; pixels that are NaN, which have no value, are none."""
        if not self.air:
            return find_air(frames)
        return air_in_boxes(self.air, len(frames), (frames.shape[-2], frames.shape[-1])) & ~frames.isnan()


@dataclass(frozen=True)
class Light:
    """The estimated light of frames: air [V, H, W] bool; noise; background, None where light is even;
    still [H, W], the factor that all frames have beside that, None where there is none."""

    air: Tensor
    noise: NoiseModel
    background: Background | None
    still: Tensor | None = None

    @classmethod
    def of(cls, frames: Tensor, options: LightOptions = LightOptions()) -> Light:
        """By frames [V, H, W], NaN in missing pixels; errors: `InputError` for smooth light where no frame has air."""
        air = options.air_of(frames)
        noise = NoiseModel.of_frames(frames, air)
        background = _found(frames, noise, air, options.kind)
        if background is not None:  # without steep light, more is seen to be air, and what is left of it is noise
            even = frames / background.factor()
            air = find_air(even) | air
            noise = NoiseModel.of_frames(even, air, correlated=True)
            background = Background.of_air(frames, air, noise)
        return cls(air, noise, background)

    @classmethod
    def handed(cls, frames: Tensor, options: LightOptions, known: DividedLight) -> Light:
        """Of frames [V, H, W] that were divided by smooth light, of which this is known."""
        air = options.air_of(frames)
        background = Background.handed(known, (frames.shape[-2], frames.shape[-1]))
        return cls(air, NoiseModel.of_frames(frames, air), background)

    @property
    def in_words(self) -> str:
        """The estimated light in words, with root mean square deviations from one."""
        said = []
        if self.background is not None and self.background.is_handed:
            said.append(f"divided out before, {self.background.size_of_doubt:.2%} of it in doubt")
        elif self.background is not None and self.background.is_flux:
            said.append(f"{FLUX} of frames, by {_deviation(self.background.factor()):.2%}")
        elif self.background is not None:
            said.append(f"uneven by {_deviation(self.background.factor()):.2%}")
        if self.still is not None:
            said.append(f"the same {_deviation(self.still):.2%} in all frames")
        return " and ".join(said) or "even"

    def factor(self) -> Tensor:
        """The light [V, H, W] of all frames, float64."""
        one = torch.ones(self.air.shape, dtype=torch.float64) if self.background is None else self.background.factor()
        return one if self.still is None else one * self.still

    def evened(self, frames: Tensor) -> Tensor:
        """Frames [V, H, W] as they would be in even light."""
        known = self.background is not None or self.still is not None
        return (frames / self.factor()).to(frames.dtype) if known else frames

    @property
    def doubt(self) -> NoiseModel:
        """The noise of the evened frames, and with it what is not known of the light."""
        return self.noise if self.background is None else self.noise.with_more(self.background.doubt(self.air))

    def settled(self, frames: Tensor, predicted: Tensor) -> Light:
        """The same where matter predicts these frames [V, H, W] in even light, and `frames` were measured.

        In air no matter is believed: faint matter all over the field, which light has become, is not matter.
        """
        known = self.background
        if known is None:
            return self
        frames = frames if self.still is None else frames / self.still
        return replace(self, background=known.seen_beside(frames, torch.where(self.air, 1.0, predicted)))

    def part(self, index: Tensor, factor: int = 1) -> Light:
        """The light of frames number `index`, and on pixels `factor` times larger, cut as `Scan.binned` cuts them."""
        air, known = self.air[index], self.background
        rows, columns = (slice((n % factor) // 2, (n % factor) // 2 + n // factor * factor) for n in air.shape[1:])
        coarse = air[:, rows, columns].unflatten(2, (-1, factor)).unflatten(1, (-1, factor)).all(dim=4).all(dim=2)
        if known is not None:
            known = known[index] if factor == 1 else known[index].binned(rows, columns, factor)
        still = self.still
        if still is not None and factor > 1:
            still = torch.nn.functional.avg_pool2d(still[None, rows, columns], factor)[0]
        return Light(coarse, self.noise[index].binned(factor), known, still)

    def misfit(self, frames: Tensor, predicted: Tensor) -> float:
        """χ² of measured frames [V, H, W] beside those predicted in even light, and of the light for its prior."""
        known = self.background
        left = (frames - predicted * self.factor()).double().square().nansum(dim=(1, 2)) / _lowest_power(self.noise)
        of_light = 0.0 if known is None else float((known.coefficients.square() / known.variances).sum())
        return float(left.sum()) + of_light


@dataclass(frozen=True)
class Background:
    """The light of V frames, `exp(Σ c_k m_k)`, and how sure it is.

    coefficients: [V, K] c, float64
    covariances: [V, K, K] of c, float64
    variances: [K] expected squares of c, float64, by which c is regularised
    powers: [V] power of the frames' noise at the modes' frequencies, float64
    shape: (H, W) of the frames
    """

    coefficients: Tensor
    covariances: Tensor
    variances: Tensor
    powers: Tensor
    shape: tuple[int, int]

    @classmethod
    def of_air(cls, frames: Tensor, air: Tensor, noise: NoiseModel) -> Background:
        """The light of frames [V, H, W] by their air [V, H, W] bool; that of frames without air is even, and unsure.

        The modes are those of `smooth_modes`. All of one number of half waves are expected to be equally strong, in all
        frames; how strong, the frames decide: by expectation and maximisation (Dempster et al. 1977), whose maximum is
        that of the marginal likelihood ("empirical Bayes", MacKay 1992).
        """
        shape = (frames.shape[-2], frames.shape[-1])
        modes, bands = _modes(shape), _bands()
        seen = air & (frames > DARKEST)
        values = torch.where(seen, frames.double(), 1.0).log().flatten(1)
        powers = torch.maximum(_lowest_power(noise), FINER**2 * _unevenness(values, seen.flatten(1)))
        normal, right = sums(values, seen.double().flatten(1), modes)
        variances = torch.full((len(modes),), 1e-2, dtype=torch.float64)
        usable = has_air(air)
        count = torch.zeros(int(bands.max()) + 1, dtype=torch.float64).index_add(
            0, bands, torch.ones(len(modes)).double()
        )
        for _ in range(ROUNDS):
            mean, covariance = posterior(normal, right, variances, powers)
            squares = (mean.square() + covariance.diagonal(dim1=1, dim2=2))[usable].mean(dim=0)
            variances = (torch.zeros_like(count).index_add(0, bands, squares) / count)[bands].clamp_min(1e-12)
        mean, covariance = posterior(normal, right, variances, powers)
        return cls(mean, covariance, variances, powers, shape)

    @classmethod
    def of_flux(cls, frames: Tensor, predicted: Tensor) -> Background:
        """Light that differs between frames [V, H, W] by a factor alone, by their means beside those `predicted` by a
        volume, which have one flux; even where these differ no more than by noise.

        What they have in common, a volume takes for absorption: the mean flux is as unsure as V draws leave it.
        """
        shape, count = (frames.shape[-2], frames.shape[-1]), len(frames)
        seen = torch.where(frames.isnan(), 0.0, predicted.double())
        ratio = frames.double().nansum(dim=(1, 2)) / seen.sum(dim=(1, 2))
        rest = frames.double() / ratio[:, None, None] - predicted.double()
        powers = rest.square().nanmean(dim=(1, 2)).clamp_min(FAINTEST**2)
        flux = ratio.log() - ratio.log().mean()
        variance = max(0.0, float(flux.square().sum() / max(count - 1, 1) - powers.mean() / math.prod(shape)))
        level = torch.zeros((ORDER + 1) ** 2, dtype=torch.float64)
        level[0] = 1.0
        doubt = torch.diag(level * variance / count).expand(count, -1, -1)
        return cls(flux[:, None] * level * (variance > 0), doubt, level * variance, powers, shape)

    @classmethod
    def unknown_flux(cls, frames: Tensor) -> Background:
        """Light of frames [V, H, W] that differs by a factor alone, before anything is known of their matter: all that
        their means differ by may be flux."""
        found = cls.of_flux(frames, torch.ones_like(frames))
        doubt = torch.diag(found.variances).expand(len(frames), -1, -1)
        return replace(found, coefficients=torch.zeros_like(found.coefficients), covariances=doubt)

    @classmethod
    def handed(cls, known: DividedLight, shape: tuple[int, int]) -> Background:
        """What may be left of light that frames of `shape` (H, W) were divided by: no more, as far as is known."""
        size, corner = known.binning, known.corner
        parts = [
            cosines(n, known.half_waves, "cpu")[:, at : at + size * count].unflatten(1, (count, size)).mean(dim=2)
            for n, at, count in zip(known.whole, corner, shape)
        ]
        old = (parts[0][:, None, :, None] * parts[1][None, :, None, :]).flatten(2).flatten(0, 1)
        change = _modes(shape) @ old.T / old.shape[1]
        variances = change.square() @ torch.from_numpy(known.variances).mean(dim=0)
        covariances = change @ torch.from_numpy(known.covariances) @ change.T
        none = torch.zeros(len(known), len(change), dtype=torch.float64)
        return cls(none, covariances, variances, torch.from_numpy(known.powers) / size**2, shape)

    @property
    def is_handed(self) -> bool:
        """Whether the frames were divided by all light that is known of, before it was looked for."""
        return not bool(self.coefficients.any())

    @property
    def is_flux(self) -> bool:
        """Whether frames differ by a factor alone."""
        return not bool(self.variances[..., 1:].any())

    @property
    def size_of_doubt(self) -> float:
        """Root mean square of what is not known of the light, relative to it."""
        return float(self.covariances.diagonal(dim1=1, dim2=2).sum(dim=1).mean().sqrt())

    def __len__(self) -> int:
        return len(self.coefficients)

    def __getitem__(self, index: Tensor) -> Background:
        """The light of some of the frames."""
        return replace(
            self,
            coefficients=self.coefficients[index],
            covariances=self.covariances[index],
            powers=self.powers[index],
        )

    def binned(self, rows: slice, columns: slice, factor: int) -> Background:
        """The light of these rows and columns on pixels `factor` times larger, as modes of the coarse frames.

        Modes are orthonormal there, so that `c' = M' B Mᵀ c`, B the mean over pixels.
        """
        old = smooth_modes(self.shape, ORDER).double()[:, rows, columns]
        coarse = torch.nn.functional.avg_pool2d(old, factor)
        shape = (coarse.shape[-2], coarse.shape[-1])
        change = _modes(shape) @ coarse.flatten(1).T / coarse[0].numel()
        covariances = change @ self.covariances @ change.T
        return Background(self.coefficients @ change.T, covariances, self.variances, self.powers / factor**2, shape)

    def modes(self, device: torch.device | str = "cpu") -> Tensor:
        """The modes [K, H, W], float32."""
        return smooth_modes(self.shape, ORDER, device)

    def factor(self) -> Tensor:
        """The light [V, H, W], float64."""
        return (self.coefficients @ _modes(self.shape)).exp().reshape(-1, *self.shape)

    def seen_beside(self, measured: Tensor, predicted: Tensor, where: Tensor | None = None) -> Background:
        """The light that measured frames [V, H, W] have beside those that matter predicts in even light.

        where: pixels [H, W] bool that are looked at (default: all).
        """
        modes = _modes(self.shape)
        seen = (measured > DARKEST) & (predicted > DARKEST)
        seen = seen if where is None else seen & where
        ratio = torch.where(seen, measured.double() / predicted.double().clamp_min(DARKEST), 1.0).log()
        normal, right = sums(ratio.flatten(1), seen.double().flatten(1), modes)
        mean, covariance = posterior(normal, right, self.variances, self.powers)
        return replace(self, coefficients=mean, covariances=covariance)

    def doubt(self, air: Tensor) -> Tensor:
        """Power [H, W//2 + 1] of what is not known of the light where there is no air [V, H, W], mean of all frames."""
        h, w = self.shape
        strength, vectors = torch.linalg.eigh(self.covariances.mean(dim=0))
        fields = (vectors * strength.clamp_min(0).sqrt()).T @ _modes(self.shape)
        power = torch.fft.rfft2(fields.reshape(-1, h, w), norm="ortho").abs().square().sum(dim=0)
        return power / (1 - air.double().mean()).clamp_min(0.1)


def is_uneven(frames: Tensor, air: Tensor, noise: NoiseModel) -> bool:
    """Whether the light of relative frames [V, H, W] is uneven in their air [V, H, W] bool, beyond their noise.

    The level of the frames counts as light; it is even where it is one. Without air there is no saying: False. Noise as
    strong as the contrast hides the edge of a body, whose shadow then passes for air: bodies are in the middle, and so
    light must be uneven in the air of the outer columns, too, where there is such air.
    """
    usable, width = has_air(air), frames.shape[-1]
    rim, outer = torch.zeros(width, dtype=torch.bool), max(1, round(OUTER * width))
    rim[:outer] = rim[-outer:] = True
    beside = usable & (air & rim).any(dim=2).any(dim=1)
    sure = bool(usable.any()) and _surely_uneven(frames, air, noise, usable)
    return sure and (not bool(beside.any()) or _surely_uneven(frames, air & rim, noise, beside))


def _surely_uneven(frames: Tensor, air: Tensor, noise: NoiseModel, usable: Tensor) -> bool:
    """The same of the frames that are usable [V] bool, some at least; noise counts by the modes' degrees of freedom."""
    lit, seen = frames[usable].double(), air[usable].double()
    modes = smooth_modes((frames.shape[1], frames.shape[2]), LOWEST).double().flatten(1)
    normal, right = sums((lit - 1).flatten(1), seen.flatten(1), modes)
    ridge = 1e-6 * normal.diagonal(dim1=1, dim2=2).mean(dim=1)[:, None, None] * torch.eye(len(modes)).double()
    found = torch.linalg.solve(normal + ridge, right)
    power = _lowest_power(noise)[usable]
    squares = float(((found * right).sum(dim=1) / power.clamp_min(1e-30)).sum())
    freedom = float(right.numel())
    size = float((((found @ modes).reshape(lit.shape) * seen).square().sum() - len(modes) * power.sum()) / seen.sum())
    contrast = float((lit - 1).square().nanmean())
    deviations = (squares - freedom) / (2 * freedom) ** 0.5
    return any(deviations > most and size > least**2 * contrast for most, least in ((UNEVEN, SEEN), (SURE, FAINT)))


def _deviation(factor: Tensor) -> float:
    return float((factor - 1).square().mean().sqrt())


def _found(frames: Tensor, noise: NoiseModel, air: Tensor, kind: Kind) -> Background | None:
    """The uneven light, None where it is even."""
    if kind == "even" or (kind == "auto" and not is_uneven(frames, air, noise)):
        return None
    if not bool(has_air(air).any()):
        raise InputError(
            "no frame shows air, by which smooth light could be told from matter; give boxes of it by --air, or take "
            "--light even."
        )
    return Background.of_air(frames, air, noise)


def _unevenness(values: Tensor, seen: Tensor) -> Tensor:
    """Mean square deviation of values [V, P] from each frame's own mean, where they are seen [V, P] bool; a scalar."""
    count = seen.sum(dim=1, keepdim=True).clamp_min(1)
    mean = (values * seen).sum(dim=1, keepdim=True) / count
    return ((values - mean).square() * seen).sum() / count.sum()


def _modes(shape: tuple[int, int]) -> Tensor:
    return smooth_modes(shape, ORDER).double().flatten(1)


def _bands() -> Tensor:
    """The band [K] of each mode: modes of about as many half waves."""
    return half_waves(ORDER).round().long()


def _lowest_power(noise: NoiseModel) -> Tensor:
    """Power [V] of the noise at the lowest frequencies."""
    few = max(2, ORDER // 2)
    return noise.power()[:, : few + 1, : few + 1].mean(dim=(1, 2)).clamp_min(FAINTEST**2)
