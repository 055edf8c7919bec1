"""Pixel-aligned networks: what each view shows in front of a point, encoded by shared weights, and what that makes.

Images are encoded one by one (a small U-Net), their features looked up where a point's shadow falls, and made into
numbers by a perceptron that is shared by all views; mean, maximum and variance of these over the views decide what is
at the point (pixelNeRF, Yu et al. 2021; ONIX, Zhang et al. 2023). So any number of views will do, in any order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import embedding_bag, grid_sample, interpolate, leaky_relu

from holosplat.checks import require
from holosplat.ranges import Natural, checked_dataclass

MOST_LEVELS = 10
"""Levels of the encoder, at most: the coarsest of eleven is of one pixel where the finest has a thousand."""
INPUTS = 3
"""Channels of an image: contrast, retrieved thickness, noise, as `learning.images` makes them."""
SLOPE = 0.1
"""Of the leaky rectifiers."""
CHUNK = 1 << 12
"""Points that are evaluated at once: what is made of them stays in the cache."""
FIRST_LOGIT = -2.0
"""Output of an untrained network everywhere, before its bound; low, so that a fit raises it."""


@checked_dataclass
class AlignedNetwork:
    """How large a pixel-aligned network is."""

    image: tuple[Natural, ...] = (16, 32, 32)
    """Channels of the views' encoder, from whole pixels to its coarsest level."""
    hidden: Natural = 32
    """Units of each layer of the perceptrons, and features of a pixel."""
    octaves: int = 4
    """Waves that say how deep in a view a point lies (0: nothing does): their periods halve from the field's width."""

    def __post_init__(self) -> None:
        count = len(self.image)
        require(1 < count <= MOST_LEVELS, f"image must have 2 to {MOST_LEVELS} levels, but it has {count}.")


class PixelAligned(nn.Module):
    """The network: images and where points lie in them → `channels` numbers at every point."""

    def __init__(self, size: AlignedNetwork = AlignedNetwork(), seed: int = 0, channels: int = 2) -> None:
        super().__init__()
        self.size, widths, hidden = size, size.image, size.hidden
        self.first = nn.Conv2d(INPUTS, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(a + b, a, 3, padding=1) for a, b in pairwise(widths))
        self.features = nn.Conv2d(widths[0], hidden, 1)
        self.depth = nn.Linear(max(1, 2 * size.octaves), hidden, bias=False)
        self.each = nn.Linear(hidden, hidden)
        self.all = nn.Linear(3 * hidden, hidden)
        self.output = nn.Linear(hidden, channels)
        self._start(torch.Generator().manual_seed(seed))

    def _start(self, generator: torch.Generator) -> None:
        """Weights after He et al. (2015), drawn from `generator`; an output that is small everywhere, whose second
        channel, what β has beyond δ, begins with nothing."""
        with torch.no_grad():
            for name, weight in self.named_parameters():
                fan_in = weight[0].numel()
                drawn = torch.randn(weight.shape, generator=generator) * math.sqrt(2 / fan_in)
                weight.copy_(drawn if name.endswith("weight") else torch.zeros_like(weight))
            self.output.weight.mul_(0.1)
            self.output.weight[1:].zero_()
            self.output.bias[0] = FIRST_LOGIT

    def encoded(self, images: Tensor) -> Tensor:
        """Features [V, F, H, W] of images [V, 3, H, W]."""
        levels = [leaky_relu(self.first(images), SLOPE)]
        for down in self.down:
            levels.append(leaky_relu(down(levels[-1]), SLOPE))
        found = levels.pop()
        for up in reversed(list(self.up)):
            level = levels.pop()
            larger = interpolate(found, level.shape[2:], mode="nearest")
            found = leaky_relu(up(torch.cat([level, larger], 1)), SLOPE)
        return self.features(found)

    def forward(self, features: Tensor, places: Tensor) -> Tensor:
        """Numbers [N, C] at N points.

        features: [V, F, H, W] of `encoded`; places: [V, N, 3], column and row of each point's shadow, from -1 to 1
        between the outer edges of the image, and its depth in half widths of the field.
        """
        seen = grid_sample(features, places[:, :, None, :2], align_corners=False)[..., 0].transpose(1, 2)
        if self.size.octaves:
            seen = seen + self.depth(self._waves(places[..., 2]))
        of_views = leaky_relu(self.each(leaky_relu(seen, SLOPE)), SLOPE)
        mean = of_views.mean(0)
        pooled = torch.cat([mean, of_views.amax(0), (of_views - mean).square().mean(0)], 1)
        return self.output(leaky_relu(self.all(pooled), SLOPE))

    def told(self, features: Tensor, places: Tensor) -> Tensor:
        """What `forward` gives, but for rounding, without gradients and several times faster: few points at a time,
        whose features are rows of a table. `InParts` has gradients as well."""
        table = features.permute(0, 2, 3, 1).flatten(0, 2).contiguous()
        shape = (features.shape[0], features.shape[2], features.shape[3])
        with torch.no_grad():
            return torch.cat([self._told(table, shape, part) for part in places.split(CHUNK, dim=1)])

    def _told(self, table: Tensor, shape: tuple[int, int, int], places: Tensor) -> Tensor:
        """Numbers [N, C], by features [V·H·W, F] of images of the `shape` [V, H, W]."""
        rows, weights = _corners(places, shape)
        seen = embedding_bag(rows, table, per_sample_weights=weights.to(table), mode="sum")
        if self.size.octaves:
            seen.addmm_(self._waves(places[..., 2]).flatten(0, 1), self.depth.weight.T)
        of_views = leaky_relu(self.each(leaky_relu(seen, SLOPE, inplace=True)), SLOPE, inplace=True)
        of_views = of_views.unflatten(0, places.shape[:2])
        mean = of_views.mean(0)
        pooled = torch.cat([mean, of_views.amax(0), (of_views - mean).square_().mean(0)], 1)
        return self.output(leaky_relu(self.all(pooled), SLOPE, inplace=True))

    def _waves(self, depth: Tensor) -> Tensor:
        """Sines and cosines [V, N, 2K] of depths [V, N]."""
        rates = math.pi * 2.0 ** torch.arange(self.size.octaves, device=depth.device)
        phase = depth[..., None] * rates.to(depth)
        return torch.cat([phase.sin(), phase.cos()], -1)


class InParts(torch.autograd.Function):
    """`PixelAligned.told` with gradients for features and weights, which are made for few points at a time.

    On the way back the numbers of these points are made once more by `forward`: that takes the memory of few points
    instead of all, and less time, for what is made of them stays in the cache.
    """

    @staticmethod
    def forward(ctx: Any, net: PixelAligned, places: Tensor, features: Tensor, *weights: Tensor) -> Tensor:
        """Numbers [N, C] at `places` [V, N, 3], by `features` [V, F, H, W] and the weights of `net` in its order."""
        ctx.net, ctx.places = net, places
        ctx.save_for_backward(features, *weights)
        return called(net, "told", _by_name(net, weights), features, places)

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of features and weights, by those of the numbers [N, C]."""
        leaves = [tensor.detach().requires_grad_() for tensor in ctx.saved_tensors]
        weights = _by_name(ctx.net, leaves[1:])
        total = [torch.zeros_like(leaf) for leaf in leaves]
        for places, grad in zip(ctx.places.split(CHUNK, dim=1), given[0].split(CHUNK)):
            with torch.enable_grad():
                found = called(ctx.net, "forward", weights, leaves[0], places)
            for sum_, part in zip(total, torch.autograd.grad(found, leaves, grad, allow_unused=True)):
                if part is not None:
                    sum_ += part
        return None, None, *total


def called(net: PixelAligned, name: str, weights: Mapping[str, Tensor], *arguments: Tensor) -> Tensor:
    """Call the method `name` of `net` with other weights, by their names."""
    return functional_call(_Calling(net, name), {f"net.{key}": weight for key, weight in weights.items()}, arguments)


def _by_name(net: PixelAligned, weights: Sequence[Tensor]) -> dict[str, Tensor]:
    return {name: weight for (name, _), weight in zip(net.named_parameters(), weights)}


class _Calling(nn.Module):
    """A network one of whose methods is called, so that `functional_call` can give it other weights."""

    def __init__(self, net: PixelAligned, name: str) -> None:
        super().__init__()
        self.net, self._name = net, name

    def forward(self, *arguments: Tensor) -> Tensor:
        """What the method returns."""
        return getattr(self.net, self._name)(*arguments)


def _corners(places: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """The four pixels about each shadow of `places` [V, N, 3] in images of `shape` [V, H, W], as rows [V·N, 4] of a
    table of all pixels, and their bilinear weights; those beyond the image have the weight 0."""
    views, h, w = shape
    column, row = (0.5 * (n * (places[..., axis] + 1) - 1) for axis, n in ((0, w), (1, h)))
    left, upper = column.floor(), row.floor()
    right_share, lower_share = column - left, row - upper
    of_columns = _inside(left, 1 - right_share, w), _inside(left + 1, right_share, w)
    of_rows = _inside(upper, 1 - lower_share, h), _inside(upper + 1, lower_share, h)
    first = torch.arange(views, device=places.device)[:, None] * h
    pairs = [((first + y) * w + x, v * u) for y, v in of_rows for x, u in of_columns]
    rows, weights = (torch.stack(parts, -1).flatten(0, 1) for parts in zip(*pairs))
    return rows, weights


def _inside(pixel: Tensor, share: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Whole numbers of pixels from 0 to `count` - 1, and the shares of those within."""
    there = (pixel >= 0) & (pixel < count)
    return pixel.clamp(0, count - 1).long(), share * there
