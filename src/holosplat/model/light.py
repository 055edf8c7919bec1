"""What the light adds to each frame: a smooth factor, as numbers that can be fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..checks import require


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

    def factor(self, index: Tensor | None = None) -> Tensor:
        """The factor [V, h, w] of all frames, or of those of `index`."""
        chosen = self.coefficients if index is None else self.coefficients.index_select(0, index)
        return torch.einsum("vk,khw->vhw", chosen, self.modes).exp()


def smooth_modes(shape: tuple[int, int], order: int, device: torch.device | str = "cpu") -> Tensor:
    """Products of cosines [K, h, w] up to `order` half waves along each side, `(order + 1)²` of them, float32.

    The first is constant one; they are those of the discrete cosine transform, of rms one.
    """
    require(order >= 0, f"the order of smooth modes must be 0 or more, but it is {order}.")
    rows, columns = (_cosines(n, order, device) for n in shape)
    modes = rows[:, None, :, None] * columns[None, :, None, :]
    return modes.reshape(-1, *shape).float()


def _cosines(count: int, order: int, device: torch.device | str) -> Tensor:
    place = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count
    waves = torch.cos(torch.pi * torch.arange(order + 1, dtype=torch.float64, device=device)[:, None] * place)
    return waves / waves.square().mean(dim=1, keepdim=True).sqrt().clamp_min(1e-12)
