"""Neural fields fitted to holograms: first to retrieved thickness on random rays, then through the full wave model."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ..checks import at_least, require
from ..geometry import Grid, Views
from ..memory import memory_kept
from ..representations.neural_field import Matter, Network, NeuralField, Samples, grown, spread
from ..scan import Scan
from ..volume import LineIntegrals
from .waves import WaveMisfit

WARM_UP, THROUGH_WAVES = "field for the retrieved thickness", "field through the waves"
BETAS, EPSILON = (0.9, 0.99), 1e-15
"""Adam's constants (Müller et al. 2022, section 4)."""
PEAK = 0.995
"""Quantile of the retrieved thickness that counts as its largest value: single pixels may be artefacts."""

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""


@dataclass(frozen=True)
class NeuralFit:
    """Options of `fit_neural`.

    warmup_steps, warmup_rays: steps towards the retrieved thickness, and rays of all views in each; steps: through the
    waves, each on `views_per_step` whole views; rate: Adam's first rate, of which `rate_left` is left at the end of
    either stage (exponential in between); shrinkage: weight decay of the encoding; weight, noise_weight: of total
    variation, as in `VoxelFit`, measured on `probes` random pairs of points half a pixel apart; floor: see
    `WaveMisfit`; hull: share of the largest retrieved thickness that counts as matter in a view (the field lives where
    all views show matter, and `margin` pixels around that); prune_every: steps between updates of where the field is
    looked at, to what exceeds `empty`, and `margin` pixels around it, within the first hull (0: never); seconds: each
    stage stops after half of them, its rates in step with that (0: by steps alone, and then reproducible by the seed);
    device: torch's name of where it runs.
    """

    network: Network = field(default_factory=Network)
    warmup_steps: int = 80
    warmup_rays: int = 4096
    steps: int = 250
    views_per_step: int = 1
    rate: float = 0.02
    rate_left: float = 0.05
    shrinkage: float = 0.01
    weight: float = 0.01
    noise_weight: float = 0.1
    probes: int = 4096
    floor: float = 0.1
    hull: float = 0.1
    prune_every: int = 75
    empty: float = 0.1
    margin: int = 2
    seconds: float = 0.0
    device: str = "cpu"

    def __post_init__(self) -> None:
        at_least(
            self, 0, "warmup_steps", "steps", "shrinkage", "weight", "noise_weight", "hull", "prune_every", "empty"
        )
        at_least(self, 0, "margin", "seconds")
        at_least(self, 1, "warmup_rays", "views_per_step", "probes")
        require(self.rate > 0, f"rate must be positive, but it is {self.rate:g}.")
        require(0 < self.rate_left <= 1, f"rate_left must lie in (0, 1], but it is {self.rate_left:g}.")
        require(self.warmup_steps + self.steps > 0, "a fit needs steps: warmup_steps or steps must be positive.")


def fit_neural(
    scan: Scan, matter: Matter, thickness: Tensor, options: NeuralFit, seed: int, on_progress: Progress
) -> NeuralField:
    """The field that explains the training frames of `scan`, on the voxels of its field of view.

    thickness: [V, H, W] retrieved thickness [m] of `matter` in the training views (or the line integrals of any
    volume), for the warm-up and the hull. `on_progress(stage, fraction)`.
    """
    train = scan.train()
    wanted = (len(train), *train.views.shape)
    shape = tuple(thickness.shape)
    require(shape == wanted, f"thickness must have the shape of the training frames {wanted}, but it has {shape}.")
    with memory_kept():
        fit = _NeuralFit(train, matter, thickness, options, seed)
        fit.warm_up(on_progress)
        fit.through_waves(on_progress)
    return fit.field.cpu().eval().requires_grad_(False)


def visual_hull(thickness: Tensor, views: Views, grid: Grid, share: float) -> Tensor:
    """Voxels [Z, Y, X] of `grid` in front of pixels with matter in all views; a pixel's neighbours count with it.

    thickness: [V, H, W]; matter is what exceeds `share` of its largest value. Voxels that a view misses do not count.
    """
    level = share * float(np.quantile(thickness.cpu().numpy(), PEAK))
    shown = max_pool2d((thickness > level)[:, None].float(), 3, stride=1, padding=1)[:, 0] > 0
    x, y, z = (torch.from_numpy(axis / views.pixel_size) for axis in grid.axes())
    hull = torch.ones(grid.shape, dtype=torch.bool)
    h, w = views.shape
    for image, rotation, shift in zip(shown, views.rotations, views.shifts / views.pixel_size):
        column, row = (
            (a[2] * z[:, None, None] + a[1] * y[:, None] + a[0] * x - s + 0.5 * n).floor().long()
            for a, s, n in zip(rotation, shift, (w, h))
        )
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        hull &= inside & image.cpu()[row.clamp(0, h - 1), column.clamp(0, w - 1)]
    require(bool(hull.any()), "the retrieved thickness of the views has no matter in common; lower hull, or check it.")
    return hull


class _NeuralFit:
    """A fit in progress: the field, its optimiser, and where the rays of each view look."""

    def __init__(self, train: Scan, matter: Matter, thickness: Tensor, options: NeuralFit, seed: int) -> None:
        self.options, self.views = options, train.views
        grid = Grid.of_views(train.views)
        self.hull = grown(visual_hull(thickness, train.views, grid, options.hull), options.margin).to(options.device)
        self.field = NeuralField(grid, matter, options.network, self.hull, seed).to(options.device)
        backend = "cuda" if options.device.startswith("cuda") else "cpu"
        self.misfit = WaveMisfit(train, matter.delta, matter.beta, options.floor, backend=backend)
        self.weight = options.weight + options.noise_weight * self.misfit.noise
        self.target = (thickness / self.field.pitch).float().to(options.device)
        self.wide = self.field.raster(self.misfit.instrument.views)
        self.generator = torch.Generator(options.device).manual_seed(seed)

    def warm_up(self, on_progress: Progress) -> None:
        """Random rays of all views at once, towards the retrieved thickness."""
        share = min(1.0, self.options.warmup_rays / self.target.numel())
        for samples in self._steps(WARM_UP, self.options.warmup_steps, self.views, on_progress):
            loss = self.target.new_zeros(())
            for v, part in enumerate(samples):
                chosen = self._random(self.target[v].numel()) < share
                kept = chosen[part.pixel]
                rays = Samples(part.pixel[kept], part.depth[kept])
                found = self._thickness(self.views, v, rays)[0].flatten()
                loss = loss + (found - self.target[v].flatten())[chosen].square().sum()
            (loss / (share * len(samples)) + self.weight * self._variation()).backward()

    def through_waves(self, on_progress: Progress) -> None:
        """Whole views, a few at a time, through the wave model."""
        count, instrument = len(self.views), self.misfit.instrument
        order: list[int] = []
        for samples in self._steps(THROUGH_WAVES, self.options.steps, self.wide, on_progress):
            drawn = min(self.options.views_per_step, count)
            if len(order) < drawn:
                order = torch.randperm(count, generator=self.generator, device=self.generator.device).tolist()
            chosen, order = order[:drawn], order[drawn:]
            images = torch.stack([self._thickness(self.wide, v, samples[v]) for v in chosen])
            lines = spread(images, self.wide, instrument.views[chosen]) * self.field.pitch
            index = torch.tensor(chosen, device=images.device)
            data = self.misfit(LineIntegrals(lines, self.field.materials), index).sum()
            (data * (count / drawn) + self.weight * self._variation()).backward()

    def _steps(self, stage: str, count: int, rays: Views, on_progress: Progress) -> Iterator[list[Samples]]:
        """Yields where the rays of each view look; takes an Adam step for the gradients that it then finds."""
        options, began = self.options, time.perf_counter()
        groups = [
            {"params": list(self.field.encoding.parameters()), "weight_decay": options.shrinkage},
            {"params": [*self.field.hidden.parameters(), *self.field.output.parameters()], "weight_decay": 0.0},
        ]
        adam = torch.optim.AdamW([g for g in groups if g["params"]], betas=BETAS, eps=EPSILON)
        samples: list[Samples] = []
        for step in range(count):
            allowed = 0.5 * options.seconds
            done = max(step / count, (time.perf_counter() - began) / allowed if allowed else 0.0)
            if done >= 1:
                break
            on_progress(stage, done)
            due = options.prune_every > 0 and step > 0 and step % options.prune_every == 0
            if due:
                self.field.prune(options.empty, options.margin, self.hull)
            if due or not samples:
                samples = [self.field.samples(rays, v) for v in range(len(rays))]
            for group in adam.param_groups:
                group["lr"] = options.rate * options.rate_left**done
            yield samples
            adam.step()
            adam.zero_grad(set_to_none=True)

    def _thickness(self, rays: Views, v: int, samples: Samples) -> Tensor:
        return self.field.thickness(rays, v, samples, self._random(len(samples.pixel)))

    def _variation(self) -> Tensor:
        """∫ |∇u| over the mask [voxel edges²], from differences along random directions: E |∇u · e| = |∇u| / 2."""
        cells = self.field.get_buffer("mask").nonzero().flip(1)
        count = self.options.probes
        at = cells[(self._random(count) * len(cells)).long()] + self._random(count, 3)
        along = torch.randn(count, 3, generator=self.generator, device=at.device)
        apart = 0.5 * torch.nn.functional.normalize(along, dim=1)
        first, second = self.field(torch.cat((at, at + apart))).split(count)
        return (second - first).abs().mean(dim=0).sum() * (2 * len(cells) / 0.5)

    def _random(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.generator.device)
