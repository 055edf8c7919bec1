"""Objects that take holograms for photographs: splats laid over each other, and a radiance field. No waves.

Their frames are composited front to back (`opponents.compositing`), whatever the distance, the energy and the blur of
an exposure are. As matter they are what makes them opaque: a Gaussian's opacity is its peak value (the density of
Guédon & Lepetit 2024, SuGaR, eq. 1), a field's density its value, in the unit of `matter`.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.checks import require
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.model import Model
from holosplat.model.scene import frames_of
from holosplat.projectors.splat.reference import boxes, pairs, rotation_matrices
from holosplat.representations.gaussians import PARAMETERS, GaussianCloud, raw_of
from holosplat.representations.initialise import random_cloud

from .fields.neural_field import CHUNK, Network, NeuralField, uniform

DILATION = 0.3
"""Variance [pixels²] that is added to every projected Gaussian, its peak kept, so that none falls between pixels (as in
the published program of Kerbl et al. 2023)."""
LEAST_OPACITY, MOST_OPACITY = 1 / 255, 0.99
"""What is less opaque at a pixel is left out there, and nothing is more opaque (Kerbl et al. 2023, appendix C)."""


def composite(thickness: Tensor, greys: Tensor, pixel: Tensor, count: int) -> Tensor:
    """Intensities [count] of pixels `I = Σ T_i (1 - exp(-τ_i)) g_i + T_end`, `T_i = exp(-Σ_{j<i} τ_j)`.

    The quadrature of Max (1995), as Mildenhall et al. (2020, eq. 3) have it. thickness [P]: optical thickness τ, zero
    or more; greys [P]: what shines from there; pixel [P]: whose, ascending, and those of a pixel from front to back.
    """
    summed = thickness.double().cumsum(0)  # over all pixels: single precision would lose the last ones
    before = summed - thickness
    first = torch.searchsorted(pixel, torch.arange(count, device=pixel.device))
    offset = torch.cat([before, before.new_zeros(1)])[first]
    seen = torch.exp(offset[pixel] - before).to(thickness)
    total = thickness.new_zeros(count).index_add(0, pixel, thickness)
    return torch.exp(-total).index_add(0, pixel, -seen * torch.expm1(-thickness) * greys)


def photograph(
    centres: Tensor, scales: Tensor, quaternions: Tensor, values: Tensor, matrix: Tensor, shift: Tensor, shape: tuple
) -> Tensor:
    """The photograph [H, W] of Gaussians, one after another by the depth of their centres (Kerbl et al. 2023, eq. 3).

    centres, scales [N, 3], quaternions [N, 4] as for `splat`, in pixels; values [N, 2]: opacity in [0, 1) at the middle
    of a Gaussian, from wherever it is seen, and its grey value. matrix [3, 3], shift [2]: of the view, as for `splat`.
    """
    turn = matrix.to(centres)
    lab = centres @ turn.mT
    order = lab[:, 2].detach().argsort(stable=True)
    axes = turn[:2] @ (rotation_matrices(quaternions) * scales[:, None])[order]
    mean, covariance = lab[order, :2] - shift.to(centres), axes @ axes.mT + DILATION * torch.eye(2).to(centres)
    opacity, grey = values[order].unbind(1)
    with torch.no_grad():
        reach = (2 * (opacity / LEAST_OPACITY).clamp_min(1).log()).sqrt()[:, None]
        low, high = boxes(mean, covariance, shape, reach, 0.0)
        owner, pixel, _ = pairs(mean, low, high, shape)
        pixel, sorting = pixel.sort(stable=True)
        owner = owner[sorting]
        column, row = (
            (n + 0.5 - 0.5 * m).to(mean) for n, m in ((pixel % shape[1], shape[1]), (pixel // shape[1], shape[0]))
        )
    conic = torch.linalg.inv(covariance)
    each = torch.stack((*mean.unbind(1), conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1], opacity, grey))
    mx, my, xx, xy, yy, opacity, grey = each.index_select(1, owner)
    x, y = column - mx, row - my
    alpha = (opacity * torch.exp(-0.5 * (xx * x * x + yy * y * y) - xy * x * y)).clamp_max(MOST_OPACITY)
    alpha = torch.where(alpha < LEAST_OPACITY, 0.0, alpha)
    return composite(-torch.log1p(-alpha), grey, pixel, shape[0] * shape[1]).reshape(shape)


FIRST_OPACITY = 0.1
"""Of every Gaussian at a random start (as in the published program of Kerbl et al. 2023)."""
FIRST_THICKNESS = 0.1
"""Optical thickness of a radiance field's box at its start: what frames do not ask for is then hardly there."""


class AlphaCloud(GaussianCloud):
    """Gaussians with an opacity and a grey value each, which hide what is behind them (Kerbl et al. 2023).

    raw_amplitudes, raw_greys [N, 1]: opacities, and grey values between the two of `greys`, before the logistic
    function; the others are those of `GaussianCloud`. `matter` is one: its δ and β are those of a value of one of `Σ
    opacity exp(-½ (x-c)ᵀ Σ⁻¹ (x-c))`. Errors: `InputError` if the arrays do not fit together.
    """

    kind: ClassVar[str] = "alpha-gaussians"
    names = (*PARAMETERS, "raw_greys")

    def __init__(self, parameters: Iterable[Tensor], unit_length: float, matter: Matter) -> None:
        *shared, self.raw_greys = parameters
        super().__init__(shared, unit_length, matter)
        self.greys = (0.0, 1.0)
        """The darkest and the brightest grey value, relative to the flat field."""
        shape = tuple(self.raw_greys.shape)
        require(shape == (len(self), 1), f"raw_greys must have the shape ({len(self)}, 1), but they have {shape}.")
        require(matter.single, f"splats with opacities are of one material, but matter has {len(matter)} channels.")

    @classmethod
    def random(cls, count: int, views: Views, frames: Tensor, matter: Matter, seed: int) -> AlphaCloud:
        """`count` Gaussians, uniform in the ball that every view sees, of grey values that random pixels of `frames`
        have; the darkest and the brightest of these bound all grey values."""
        start = random_cloud(count, views, matter, 0.0, seed)
        chosen = torch.randint(frames.numel(), (count, 1), generator=torch.Generator().manual_seed(seed))
        low, high = range_of(frames)
        raw = torch.logit((frames.flatten()[chosen] - low) / (high - low), 0.01)
        opacities = torch.full((count, 1), FIRST_OPACITY).logit()
        cloud = cls((start.centres, start.log_scales, start.quaternions, opacities, raw), start.unit_length, matter)
        cloud.greys = low, high
        return cloud

    def replaced(self, parameters: Iterable[Tensor], matter: Matter | None = None) -> AlphaCloud:
        """A cloud of other tensors in the same units."""
        cloud = super().replaced(parameters, matter)
        cloud.greys = self.greys
        return cloud

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same cloud of."""
        return {**super().state(), "greys": list(self.greys)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> AlphaCloud:
        """The cloud that `state` described; `InputError` where it does not fit together."""
        cloud = super().from_state(state)
        assert isinstance(cloud, AlphaCloud)
        cloud.greys = checked_range(state["greys"])
        return cloud

    @property
    def amplitudes(self) -> Tensor:
        """Opacities [N, 1] at the middle of each Gaussian."""
        return torch.sigmoid(self.raw_amplitudes)

    def values_times(self, factor: float, index: Tensor) -> dict[str, Tensor]:
        """Opacities and grey values of the Gaussians `index`: children keep those of their parent, as published."""
        return {name: getattr(self, name).detach()[index] for name in ("raw_amplitudes", "raw_greys")}

    def made_of(self, matter: Matter) -> AlphaCloud:
        """The same cloud, whose values stand for other matter."""
        return self.replaced(self.parameters().values(), matter)

    def photographs(self, views: Views | Poses) -> Tensor:
        """Photographs [V, H, W], differentiable in the parameters and in the rotations and shifts of poses."""
        poses = Poses.of(views, self.centres.device) if isinstance(views, Views) else views
        scale = self.unit_length / poses.pitch
        values = torch.cat((self.amplitudes, between(self.greys, self.raw_greys)), dim=1)
        cloud = (*self._scaled(scale), values)
        views_px = zip(poses.matrices, poses.offsets / poses.pitch)
        return torch.stack([photograph(*cloud, matrix, shift, poses.shape) for matrix, shift in views_px])


class RadianceField(NeuralField):
    """A field of density and grey value that shines and hides what is behind it (NeRF, Mildenhall et al. 2020).

    It is a `NeuralField` whose network says a grey value, too. The density [1 / voxel edge] is what `project` and
    `voxelise` see, in the unit of `matter`. The grey value does not depend on the direction of view, and there is one
    network, without a second, finer sampling. A sample in every depth step of a voxel edge, jittered while gradients
    are taken.
    """

    kind: ClassVar[str] = "radiance-field"
    beside: ClassVar[int] = 1

    def __init__(
        self,
        grid: Grid,
        matter: Matter,
        network: Network,
        mask: Tensor,
        seed: int = 0,
        upper: float = 0.0,
        *,
        lower: float = 0.0,
    ) -> None:
        super().__init__(grid, matter, network, mask, seed, upper, lower=lower)
        self.greys = (0.0, 1.0)
        """The darkest and the brightest grey value, relative to the flat field."""
        require(matter.single, f"a radiance field is of one material, but matter has {len(matter)} channels.")
        density = raw_of(torch.tensor([FIRST_THICKNESS / max(grid.shape)]))
        self._weights["output.bias"] = torch.cat((density, torch.zeros(1)))

    @classmethod
    def filling(cls, grid: Grid, frames: Tensor, matter: Matter, network: Network, seed: int) -> RadianceField:
        """A random field everywhere on `grid`; the darkest and brightest of `frames` bound its grey values."""
        field = cls(grid, matter, network, torch.ones(grid.shape, dtype=torch.bool), seed)
        field.greys = range_of(frames)
        return field

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same field of."""
        return {**super().state(), "greys": list(self.greys)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RadianceField:
        """The field that `state` described; `InputError` where it does not fit together."""
        field = super().from_state(state)
        assert isinstance(field, RadianceField)
        field.greys = checked_range(state["greys"])
        return field

    def __call__(self, positions: Tensor) -> Tensor:
        """Densities [N, 1] at positions [N, 3], as `NeuralField` has them."""
        return self.shining(positions)[:, :1]

    def shining(self, positions: Tensor) -> Tensor:
        """Densities and grey values [N, 2]."""
        density, grey = self.raw(positions).split(1, dim=1)
        return torch.cat((softplus(density), between(self.greys, grey)), dim=1)

    def made_of(self, matter: Matter) -> RadianceField:
        """The same field, whose values stand for other matter."""
        field = copy.copy(self)
        field.matter = matter
        return field

    def photographs(self, views: Views | Poses) -> Tensor:
        """Photographs [V, H, W], differentiable in the weights and in the rotations and shifts of poses."""
        count = views.shape[0] * views.shape[1]
        most = count if torch.is_grad_enabled() else max(1, CHUNK // (2 * self._reach()))
        parts = torch.arange(count, device=self._like.device).split(most)
        rays = ((self.along(views, v, part), len(part)) for v in range(len(views)) for part in parts)
        return torch.cat([self.intensities(*at, number) for at, number in rays]).reshape(-1, *views.shape)

    def along(
        self, views: Views | Poses, v: int, chosen: Tensor, jitter: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Positions [S, 3] on rays of the flat pixels `chosen` [R], ascending, of view `v`, and the ray [S] of each.

        jitter: draws where in its depth step each lies (None: in the middle).
        """
        samples = self.samples(views, v, chosen)
        offset = 0.5 if jitter is None else uniform(jitter, len(samples.pixel))
        ray = torch.searchsorted(chosen, samples.pixel)
        return self._positions(views, v, samples.pixel, samples.depth + offset), ray

    def intensities(self, positions: Tensor, ray: Tensor, count: int) -> Tensor:
        """Intensities [count] of rays by what `along` says of them."""
        density, grey = self.shining(positions).unbind(1)
        return composite(density, grey, ray, count)


def between(greys: tuple[float, float], raw: Tensor) -> Tensor:
    """Numbers between the two of `greys`: all of a photograph's range, however small the contrast of the frames is."""
    low, high = greys
    return low + (high - low) * torch.sigmoid(raw)


def range_of(frames: Tensor) -> tuple[float, float]:
    """The darkest and the brightest pixel."""
    return float(frames.min()), float(frames.max())


def checked_range(greys: Any) -> tuple[float, float]:
    """`greys` of a file; `InputError` for what is no range."""
    low, high = (float(value) for value in greys)
    require(low < high, f"greys must be the darkest and the brightest grey value, but they are {low:g} and {high:g}.")
    return low, high


@frames_of.register(AlphaCloud)
@frames_of.register(RadianceField)
def photographed(matter: AlphaCloud | RadianceField, model: Model, index: Tensor | None) -> Tensor:
    """Frames [K, H, W] of the exposures `index`: photographs at the beams' poses, whatever the waves would do."""
    return matter.photographs(model.pixels(index))
