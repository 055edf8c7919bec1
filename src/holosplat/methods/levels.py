"""Whether matter has levels of δ with sharp edges, or is continuous: what is known, and what frames say.

A volume without any bound is made of all views but a few, on coarse voxels. Its inside is then flattened, to one level
or to two, with its rims left as they are. Of matter with levels, the flat volume foretells the views set aside as well
or better, for the differences were errors; of continuous matter it foretells them worse.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from torch import Tensor

from ..backends import Backend, resolve
from ..baselines import HolographicTV, holographic_tv
from ..baselines.material import plateau
from ..baselines.two_materials import best_levels, told_apart
from ..checks import at_least
from ..matter import Known, KnownRatio, KnownTwo, Matter, MatterKind
from ..optics.noise import noise_share
from ..ranges import Weight, ranged
from ..representations import VoxelGrid
from .assumed import assumed_material
from .cross_validation import CrossValidation, MissingMatter
from .method import Task

STAGE = "levels or continuous matter"


@dataclass(frozen=True)
@ranged
class LevelTest:
    """How it is decided whether matter has levels."""

    worse: Weight = 1.2
    """Factor of the misfit of the views set aside, by a flat inside, from which on matter is continuous."""
    same: Weight = 1.02
    """Factor up to which a flat inside does no harm, and matter has levels."""
    noisy: Weight = 0.35
    """Share of noise from which on a flat inside that does no harm says nothing: there, flattening is denoising. One
    that does harm all the same says that matter is continuous."""
    validation: CrossValidation = field(default_factory=CrossValidation)
    """How views are set aside."""
    volume: HolographicTV = field(
        default_factory=lambda: HolographicTV(retrieval=30, upper=0.0, refine=1, beyond=False)
    )
    """The volume without bounds, on voxels of a pixel. What lies beyond the frames explains too much, and a flat inside
    would seem worse for it. Half of the usual steps of phase retrieval decide the same of all cases of the benchmark
    (benchmarks/levels.py)."""

    def __post_init__(self) -> None:
        at_least(self, 1, "worse", "same")

    def on_backend(self, backend: Backend) -> LevelTest:
        """The same test computed by `backend`."""
        return replace(self, volume=replace(self.volume, backend=backend))


@dataclass(frozen=True)
class Decision:
    """matter: the kind; why: in words; sure: whether frames or knowledge say so, rather than a rule; factor: of the
    misfit of views set aside, by a flat inside; NaN where it was not measured."""

    matter: MatterKind
    why: str
    sure: bool = True
    factor: float = math.nan


def decide_matter(task: Task, options: LevelTest = LevelTest()) -> Decision:
    """What kind of matter the training frames of `task` show."""
    if isinstance(task.prior, KnownTwo):
        return Decision("levels", "two materials are known")
    split = options.validation.split(task.scan)
    if split is None:
        return _undecided(task, "there are too few views to set some aside")
    task.on_progress(STAGE, 0.0)
    seen, aside = split
    material = assumed_material(seen, task.prior, task.on_progress, options.volume.backend)
    light = options.validation.light(task.scan, task.uneven)
    values, grid = holographic_tv(seen, material, replace(options.volume, upper=0.0), task.on_progress, light)
    matter, judge = Matter.one(*material), MissingMatter(aside, material)
    backend = resolve(options.volume.backend)
    free = _Misfit.of(judge, VoxelGrid(values[None], grid, matter).on(backend))
    pixel = max(1, round(seen.views.finest / grid.voxel_size[0]))
    flat = [_Misfit.of(judge, VoxelGrid(one[None], grid, matter).on(backend)) for one in flattened(values, pixel)]
    return _decided(task, free, flat, noise_share(judge.measured) > options.noisy, options)


def _decided(task: Task, free: _Misfit, flat: list[_Misfit], noisy: bool, options: LevelTest) -> Decision:
    if not flat:
        return _undecided(task, "nothing in a first volume lies more than a pixel inside matter")
    most = 1 if task.prior.fixes_ratio else 2  # one ratio with one bound holds one level
    factors = [one.over(free) for one in flat[:most]]
    least, worst = min(min(f) for f in factors), min(max(f) for f in factors)
    said = f"on views set aside, matter flattened to its levels leaves {least:.3g} times the misfit of a free volume"
    if least > options.worse and task.uneven is not None and isinstance(task.prior, Known):
        return replace(_undecided(task, f"{said} in uneven light, of which most of it may be"), factor=least)
    if least > options.worse:
        return Decision("continuous", said, factor=least)
    if least > options.same and noisy and not isinstance(task.prior, Known):
        return Decision(
            "continuous", f"{said}, and in noise it should leave less, for it takes noise away", factor=least
        )
    if worst <= options.same and not noisy:
        return Decision("levels", said, factor=least)
    return replace(_undecided(task, said), factor=least)


def _undecided(task: Task, said: str) -> Decision:
    """A known density is a level; a known ratio says nothing of levels."""
    if isinstance(task.prior, KnownRatio):
        return Decision("continuous", f"{said}, which decides nothing, nor does a known ratio", sure=False)
    known = isinstance(task.prior, Known)
    return Decision(
        "levels", f"{said}, which decides nothing{', but the material is known' if known else ''}", sure=known
    )


@dataclass(frozen=True)
class _Misfit:
    """Mean square residual of frames, of intensity and of the matter that it stands for."""

    intensity: float
    matter: float

    @classmethod
    def of(cls, judge: MissingMatter, grid: VoxelGrid) -> _Misfit:
        residual = judge.measured - judge.predicted(grid)
        return cls(float(residual.double().square().mean()), judge.of(residual))

    def over(self, other: _Misfit) -> tuple[float, float]:
        return self.intensity / max(other.intensity, 1e-30), self.matter / max(other.matter, 1e-60)


def flattened(values: Tensor, pixel: int) -> Iterator[Tensor]:
    """Volumes [Z, Y, X] whose inside is flat, at one level and at two; rims, `pixel` voxels and more, stay.

    Nothing is given where nothing lies inside.
    """
    v, rim = values.numpy(), 1 + pixel // 2
    inside = _eroded(v > 0.5 * plateau(values), rim)
    if not inside.any():
        return
    yield torch.from_numpy(np.where(inside, v[inside].mean(), v))
    found = best_levels(values, pixel)
    levels = (found.high, found.low)
    lighter = _eroded(told_apart(values, levels, pixel)[1].numpy() > 0, rim)
    denser = _eroded(v > 0.5 * sum(levels), rim)
    if lighter.any() and denser.any():
        flat = np.where(denser, v[denser].mean(), v)
        yield torch.from_numpy(np.where(lighter, v[lighter].mean(), flat))


def _eroded(inside: np.ndarray, steps: int) -> np.ndarray:
    return np.asarray(binary_erosion(inside, iterations=steps), dtype=bool)
