"""A smooth volume: continuous matter without levels, fitted through the waves in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from ..baselines import HolographicTV, holographic_tv
from ..baselines.material import MaterialEstimate, plateau
from ..checks import at_least, require
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem, descend, modulated
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import Matter
from ..memory import memory_kept
from ..optics.noise_model import NoiseModel
from ..progress import Advance
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from .method import Stage, Task
from .start import assumed_material

LEAST_EDGE = 12
"""Pixels along a frame's shorter side that larger ones must leave, or the fit is not begun on them."""


def _start() -> HolographicTV:
    return HolographicTV(retrieval=40, iterations=100, corrections=2, noisy=1.0, refine=1, upper=0.0)


@dataclass(frozen=True)
class SmoothVolume:
    """Continuous matter on voxels: any value from zero up, no levels, no bound, as likely as frames and noise make it.

    Where the frames are of one material's ratio δ/β (known, or estimated where nothing is known), δ is free in every
    voxel. `volume` is the start, whose bound is never used.
    """

    kind: ClassVar[str] = "volume"

    volume: HolographicTV = field(default_factory=_start)
    """The start: phase retrieval, total variation, and a little agreement with the frames."""
    estimate: MaterialEstimate = field(default_factory=MaterialEstimate)
    """How a ratio δ/β that is not known is estimated."""
    prior: ContinuousPrior = field(default_factory=ContinuousPrior)
    """What is expected of continuous matter."""
    coarser: tuple[int, ...] = (4, 2)
    """Edges of the larger voxels [pixels] on which the fit is begun: low frequencies are found there soonest."""
    rounds: int = 3
    """How often a fit is followed by the modulations that undo what the prior takes."""
    iterations: int = 20
    """Iterations of a round."""
    max_voxels: int = 20_000_000
    """Frames are binned rather than having more voxels than this."""

    def __post_init__(self) -> None:
        at_least(self, 0, "rounds", "iterations")
        at_least(self, 1, "max_voxels")
        sizes = all(factor >= 2 for factor in self.coarser) and list(self.coarser) == sorted(self.coarser, reverse=True)
        require(sizes, f"coarser must be whole numbers from 2 on, the largest first, but it is {self.coarser}.")

    def stages(self) -> tuple[Stage, ...]:
        """One, which cannot be resumed: it takes less than a minute."""
        return (SmoothStage(self),)

    def with_effort(self, effort: float) -> SmoothVolume:
        """The same method with `effort` times the iterations, at least one."""
        return replace(self, iterations=max(1, round(effort * self.iterations)))


@dataclass(frozen=True)
class SmoothStage:
    """The start and the fit of a smooth volume."""

    options: SmoothVolume
    name: str = "smooth volume"

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """The volume: δ in units of the known material's, or of the estimated one's."""
        options = self.options
        scan = task.scan.binned(binning(task.scan, options.max_voxels))
        backend = options.volume.backend
        material = assumed_material(scan, task.prior, task.on_progress, backend, options.estimate)
        first, grid = holographic_tv(scan, material, replace(options.volume, upper=0.0, noisy=1.0), task.on_progress)
        begun = VoxelGrid(first[None], grid, Matter.one(*material)).resampled(Grid.of_views(scan.views))
        with memory_kept():
            noise = noise_of_binned(task.noise, binning(task.scan, options.max_voxels))
            return self._fitted(scan, begun, noise, task.report(self.name))

    def _fitted(self, scan: Scan, begun: VoxelGrid, noise: NoiseModel, on_progress: Advance) -> VoxelGrid:
        """The fit on voxels of a pixel, from the start or from larger voxels (`_likelier`)."""
        options = self.options
        factors = [f for f in options.coarser if min(scan.views.shape) >= LEAST_EDGE * f]
        work = [1.0 / f**3 for f in (*factors, 1)]
        done, coarse = 0.0, begun
        for factor, share in zip(factors, work):
            binned, quieter = scan.binned(factor), noise_of_binned(noise, factor)
            frames = WhitenedFrames(binned, begun.matter.channels[0], quieter, backend=options.volume.backend)
            coarse = coarse.resampled(Grid.of_views(binned.views))
            report = _part(on_progress, done / sum(work), share / sum(work))
            coarse = self._rounds(frames, coarse, options.prior.on_larger_voxels(factor), report)
            done += share
        frames = WhitenedFrames(scan, begun.matter.channels[0], noise, backend=options.volume.backend)
        best = self._likelier(frames, begun, coarse.resampled(begun.grid)) if factors else begun
        return self._rounds(frames, best, options.prior, _part(on_progress, done / sum(work), 1 / sum(work)))

    def _rounds(
        self, frames: WhitenedFrames, begun: VoxelGrid, prior: ContinuousPrior, on_progress: Advance
    ) -> VoxelGrid:
        options, u = self.options, begun.values[0]
        for done in range(options.rounds):
            if not bool((u > 0).any()):
                break  # the frames show nothing but noise
            problem = VolumeProblem(frames, prior, plateau(u), options.volume.backend)
            u, _ = descend(
                problem, u, options.iterations, _part(on_progress, done / options.rounds, 1 / options.rounds)
            )
            u = modulated(problem, u)
        return begun.with_parameters({"values": u[None]})

    def _likelier(self, frames: WhitenedFrames, first: VoxelGrid, coarse: VoxelGrid) -> VoxelGrid:
        """The coarse volume if its frames are explained to within their noise after half a round, or the likelier one.

        Low frequencies, of which noisy frames say little, converge on large voxels first. Without noise the details
        that large voxels lack disturb them, and the start is nearer.
        """
        u, v = first.values[0], coarse.values[0]
        if not bool((v > 0).any()):
            return first
        backend, steps = self.options.volume.backend, max(1, self.options.iterations // 2)
        problem = VolumeProblem(frames, self.options.prior, plateau(v), backend)
        found, values = descend(problem, v, steps)
        if 2 * frames(problem.lines(found)).value > frames.count:
            other, others = descend(problem, u, steps)
            found = other if others[-1] < values[-1] else found
        return first.with_parameters({"values": found[None]})

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is left to be fitted."""


def binning(scan: Scan, most: int) -> int:
    """How many pixels along an edge are joined, so that voxels of their size are at most `most`."""
    h, w = scan.views.shape
    factor = 1
    while w * w * h / factor**3 > most:
        factor += 1
    return factor


def noise_of_binned(noise: NoiseModel, factor: int) -> NoiseModel:
    """The noise of frames whose pixels are means of `factor` × `factor`, by that of the frames.

    Grain is taken to be smooth: what binning folds back of it counts as none.
    """
    if factor == 1:
        return noise
    h, w = noise.shape
    rows, columns = h // factor, w // factor
    at_rows = torch.round(torch.fft.fftfreq(rows, 1 / rows) * h / (rows * factor)).long()
    at_columns = torch.round(torch.arange(columns // 2 + 1) * w / (columns * factor)).long()
    grain = noise.grain[:, at_rows][:, :, at_columns.clamp_max(noise.grain.shape[2] - 1)] / factor**2
    return NoiseModel(noise.white / factor, grain, columns)


def _part(on_progress: Advance, begin: float, share: float) -> Advance:
    """Progress of a part of the work."""

    def report(fraction: float) -> None:
        on_progress(min(1.0, begin + share * fraction))

    return report
