"""The smooth light factor of each frame, as parameters that can be fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..checks import require
from ..optics.background import DARKEST, Background, posterior_covariance


@dataclass(frozen=True)
class LightField:
    """A factor of each of V frames: `exp(Σ c_k m_k)`, above zero everywhere; coefficients of zero are even light.

    coefficients: [V, K] numbers c, those that can be fitted
    modes: [K, h, w] images m, the same for all frames

    Errors: `InputError` if the counts differ.
    """

    coefficients: Tensor
    modes: Tensor

    def __post_init__(self) -> None:
        fits = self.coefficients.ndim == 2 and self.modes.ndim == 3
        require(
            fits and self.coefficients.shape[1] == len(self.modes),
            f"a light field needs coefficients (V, K) and modes (K, h, w), but "
            f"has {tuple(self.coefficients.shape)} and "
            f"{tuple(self.modes.shape)}.",
        )

    @classmethod
    def even(cls, count: int, modes: Tensor) -> LightField:
        """Even light in `count` frames, which `modes` [K, h, w] can change."""
        return cls(modes.new_zeros(count, len(modes)), modes)

    def parameters(self) -> dict[str, Tensor]:
        """The coefficients, by name."""
        return {"coefficients": self.coefficients}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> LightField:
        """The same modes with other coefficients."""
        return replace(self, coefficients=parameters.get("coefficients", self.coefficients))

    def __len__(self) -> int:
        return len(self.coefficients)

    def factor(self, index: Tensor | None = None, images: Tensor | None = None) -> Tensor:
        """The factor [V, h, w] of all frames, or of those of `index`, whatever even light gives as `images`."""
        chosen = self.coefficients if index is None else self.coefficients.index_select(0, index)
        return torch.einsum("vk,khw->vhw", chosen, self.modes).exp()


class SolvedLight:
    """The factor of each of V frames that explains best what matter in even light does not: it has no parameters.

    In every step its coefficients c solve `(MᵀM/p + T⁻¹) c = Mᵀ log(measured / images) / p - T⁻¹ b`: a ridge regression
    on the modes M, for noise of power p at their frequencies, and a prior of variances T about -b where the frames were
    divided by `exp(Σ b m)` before. The light is thus eliminated ("variable projection", Golub & Pereyra 1973), and
    gradients by the matter are right without going through it, for c is at its optimum. Air shows the light whatever
    matter is predicted there: faint matter all over the field would otherwise pass for light, and light for it.
    """

    def __init__(self, background: Background, measured: Tensor, air: Tensor | None = None) -> None:
        """background: the light that the frames `measured` [V, h, w] were divided by, on whose device this computes;
        air: where they show no matter [V, h, w] bool (None: nowhere)."""
        on = measured.device
        modes = background.modes()
        flat = modes.double().flatten(1)
        gain = posterior_covariance((flat @ flat.T)[None], background.variances, background.powers)
        self._modes, self._measured = modes.to(on), measured
        self._air = torch.zeros_like(measured, dtype=torch.bool) if air is None else air.to(on)
        self._gain = (gain / background.powers[:, None, None]).float().to(on)
        pull = background.coefficients / background.variances.clamp_min(torch.finfo(torch.float64).tiny)
        self._before = torch.einsum("vkl,vl->vk", gain, pull).float().to(on)

    def __len__(self) -> int:
        return len(self._measured)

    def coefficients(self, images: Tensor, index: Tensor | None = None) -> Tensor:
        """The coefficients [V, K] beside `images` [V, h, w] of even light, of all frames or of those of `index`."""
        measured, air, gain, before = self._measured, self._air, self._gain, self._before
        if index is not None:
            measured, air, gain, before = (part.index_select(0, index) for part in (measured, air, gain, before))
        images = torch.where(air, 1.0, images.detach())
        seen = (measured > DARKEST) & (images > DARKEST)
        ratio = torch.where(seen, measured.clamp_min(DARKEST) / images.clamp_min(DARKEST), 1.0).log()
        right = torch.einsum("vhw,khw->vk", ratio, self._modes)
        return torch.einsum("vkl,vl->vk", gain, right) - before

    def settled(self, images: Tensor) -> LightField:
        """The light beside `images` [V, h, w] of even light, as numbers."""
        return LightField(self.coefficients(images).detach(), self._modes)

    def factor(self, index: Tensor | None = None, images: Tensor | None = None) -> Tensor:
        """The factor [V, h, w] beside `images` of even light; one without any."""
        if images is None:
            return torch.ones_like(self._measured if index is None else self._measured[index])
        return torch.einsum("vk,khw->vhw", self.coefficients(images, index), self._modes).exp()
