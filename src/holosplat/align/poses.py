"""Estimation of poses: a volume and the poses in alternation, on smaller and smaller pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..baselines.primal_dual import PrimalDual
from ..checks import require
from ..fit.pose_refinement import PoseRefinement
from ..geometry import Grid
from ..matter import DeltaBeta
from ..model import Alignment
from ..optics.sampling import fringe_sampling
from ..progress import Advance
from ..projectors.voxels import LatticeProjector
from ..ranges import MOST, Angle, Natural, Pixels, Weight, Within, checked_dataclass
from ..scan import Exposures, Scan
from .derivatives import NUMBERS, Normal, in_pixels, predicted, step, unexplained
from .initial_geometry import retrieved, shifts_by_mass

SHIFT, TURN, DISTANCE, MAGNIFICATION, FLUX = slice(0, 2), slice(2, 5), 5, 6, 7
"""Places of the numbers of `NUMBERS`."""
Blur = Annotated[float, Within(0.3, 10, unit="pixels")]
"""Widths of a Gaussian on a raster, which its samples show [pixels]."""


def aligned(numbers: Tensor, pixels: float = 1.0) -> Alignment:
    """The corrections that `numbers` [V, 8] of `NUMBERS` are, in pixels that are so many times larger."""
    magnified = numbers[:, MAGNIFICATION].exp() - 1 if bool((numbers[:, MAGNIFICATION] != 0).any()) else None
    shifts, stretches = numbers[:, SHIFT] / pixels, numbers[:, DISTANCE].exp() - 1
    return Alignment(numbers[:, TURN], shifts, stretches, magnified=magnified)


@checked_dataclass
class PosePrior:
    """Standard deviations of what is not known of each view; 0: it is as planned."""

    shift: Pixels = 2.0
    """Detector's shifts along rows and columns [pixels]."""
    angle: Angle = 1.0
    """Turns about the two axes across the beam [degrees]."""
    roll: Angle = 1.0
    """Turns about the beam [degrees]."""
    distance: float = 0.0
    """Propagation distance, as a share of it. Only matter with sharp edges tells it: a longer distance sharpens edges
    as voxels blur them."""
    flux: float = 0.02
    """Flux of a frame beside the flat field's, as a share of it."""
    magnification: float = 0.0
    """Magnification, as a share of it: that of the training frames together is as planned."""

    def __post_init__(self) -> None:
        limits = {"shift": 100.0, "angle": 20.0, "roll": 20.0, "distance": 0.5, "flux": 0.5, "magnification": 0.1}
        for name, most in limits.items():
            value = getattr(self, name)
            require(value <= most, f"uncertain {name} must be {most:g} at most, but it is {value:g}; correct it.")

    def pose(self, pixels: float = 1.0) -> np.ndarray:
        """Standard deviations [5] of shifts [pixels that are so many times larger] and turns about x, y, z [rad]."""
        turns = np.deg2rad([self.angle, self.angle, self.roll])
        return np.array([self.shift / pixels, self.shift / pixels, *turns])

    def deviations(self, turning: bool = True, sharp: bool = False) -> Tensor:
        """Standard deviations [8] of `NUMBERS`, shifts in detector pixels; turning: whether turns and magnification,
        which act far from the middle, are free; sharp: whether the matter's edges are, so that a distance which is
        known need not be free (`BLUR_AS_DISTANCE`)."""
        turn, roll = np.deg2rad([self.angle, self.roll]) * turning
        distance = self.distance if sharp else self.distance or BLUR_AS_DISTANCE
        found = [self.shift, self.shift, turn, turn, roll, distance, self.magnification * turning, self.flux]
        return torch.tensor(found, dtype=torch.float64)

    def freedom(self, so_far: np.ndarray) -> PoseRefinement:
        """The same for a fit of matter and geometry; so_far: [V, 7] changes of the plan [pixels, rad, shares]."""
        angle, roll = np.deg2rad([self.angle, self.roll])
        return PoseRefinement(self.shift, float(angle), float(roll), self.distance, so_far, self.magnification)


@checked_dataclass
class Drift:
    """Standard deviations of how far each beam of a series goes from the first time to the last; 0: it stays."""

    shift: Pixels = 0.0
    """Detector's shifts along rows and columns [pixels]."""
    angle: Angle = 0.0
    """Turns about all three axes [degrees]."""

    def __post_init__(self) -> None:
        for name, most in (("shift", 100.0), ("angle", 20.0)):
            value = getattr(self, name)
            require(value <= most, f"drift {name} must be {most:g} at most, but it is {value:g}; correct it.")

    def pose(self, pixels: float = 1.0) -> np.ndarray:
        """Standard deviations [5] of half the way, by which the ends differ from the middle, as `PosePrior.pose`."""
        half = 0.5 * np.array([self.shift / pixels, np.deg2rad(self.angle)])
        return half[[0, 0, 1, 1, 1]]


TURNING = 30
"""Pixels along a frame's shorter side from which on turns are looked for: on larger pixels there are shifts alone."""
BLUR_AS_DISTANCE = 0.02
"""Share of the distance that is free where the distance is known: it takes up what the edges of voxels are too soft
for, which would else be taken for something else. What is found of it is forgotten."""


@dataclass(frozen=True)
class Level:
    """pixels: edge of the pixels [detector pixels]; rounds: of volume and poses in turn."""

    pixels: int
    rounds: int


@checked_dataclass
class PoseOptions:
    """How poses are looked for."""

    uncertain: PosePrior = field(default_factory=PosePrior)
    """What is not known, and by how much."""
    rounds: Natural = 8
    """Rounds of volume and poses on each size of pixels, at most."""
    least_side: Annotated[int, Within(4, MOST)] = 16
    """Pixels along a frame's shorter side on the largest pixels, which catch the largest errors."""
    max_voxels: Natural = 4_000_000
    """Pixels are not smaller than allow so many voxels; shifts are found to some hundredths of such a pixel."""
    blur: Blur = 1.0
    """Frames are compared after a Gaussian of this standard deviation [pixels]: details of a pixel's size depend on
    the voxels' raster."""
    weight: Weight = 0.5
    """Weight of total variation in the volume [pixels of path length]."""
    steps: Natural = 8
    """Primal–dual steps of the volume a round, for `few_views` or more."""
    first: Natural = 40
    """Steps of the first volume, likewise."""
    few_views: Natural = 10
    """With fewer training views than this there are more steps: total variation has more to fill in, and where it has
    not, a volume takes any pose."""
    by_mass: Weight = 2.0
    """Uncertain shifts [pixels] beyond which centres of mass give the first ones: they are good to a pixel or two."""
    retrieval: Natural = 40
    """Steps of the phase retrieval."""
    times: Natural = 8
    """Times of a series that are used at most: those that say most, evenly spread."""
    drift: Drift = field(default_factory=Drift)
    """How far the beams of a series may drift."""
    edges: int = 60
    """Steps of surfaces with the geometry free, after the voxels, where matter has one known density: poses of cells
    settle in fifty (0: none)."""

    def levels(self, shape: tuple[int, int], views: int) -> tuple[Level, ...]:
        """From the largest pixels to the smallest, by powers of two, of frames of this shape.

        views: for training; few of them say nothing of the matter on large pixels.
        """
        (h, w), reach = shape, min(max(self.uncertain.shift, 1.0), self.by_mass)
        largest = reach if views < self.few_views // 2 else 2 * reach
        finest = 1
        while w * w * h / finest**3 > self.max_voxels:
            finest *= 2
        sizes = [finest]
        while min(shape) // (2 * sizes[-1]) >= self.least_side and sizes[-1] < largest:
            sizes.append(2 * sizes[-1])
        return tuple(Level(size, self.rounds) for size in reversed(sizes))


class PoseSearch:
    """Poses and a volume in progress. The volume is that of the training frames; poses are found of all frames."""

    def __init__(
        self, scan: Scan, material: DeltaBeta, options: PoseOptions, upper: float | None, *, begin: bool = True
    ) -> None:
        """upper: bound of occupancies; begin: whether large shifts begin with centres of mass."""
        self.scan, self.material, self.options, self.upper = scan, material, options, upper
        count = len(scan)
        self.numbers = torch.zeros(count, len(NUMBERS), dtype=torch.float64)
        self.covariances = torch.zeros(count, len(NUMBERS), len(NUMBERS), dtype=torch.float64)
        self._solver: PrimalDual | None = None
        self._retrieved = dict[int, Tensor]()
        self._more = max(1.0, options.few_views / int((~scan.is_test).sum()))
        if begin and options.uncertain.shift > options.by_mass:
            self.begin()

    def exposures(self, planned: Exposures) -> Exposures:
        """Planned exposures, on pixels of any size, corrected by the numbers as they are now."""
        return aligned(self.numbers, planned.views.pitch / self.scan.views.pitch).exposures(planned)

    def levels(self) -> tuple[Level, ...]:
        """All levels, in their order."""
        return self.options.levels(self.scan.views.shape, int((~self.scan.is_test).sum()))

    def begin(self) -> None:
        """Shifts by centres of mass, for a start; turns and distances as planned."""
        scan = self.scan.binned(self.levels()[0].pixels)
        thickness = retrieved(scan, self.material, self.options.retrieval)
        shifts = shifts_by_mass(thickness.double().numpy(), scan.views)
        pixels = scan.views.pitch / self.scan.views.pitch
        self.numbers[:, SHIFT] = torch.from_numpy(shifts) * pixels

    @property
    def volume(self) -> Tensor:
        """Occupancies [Z, Y, X] of the level that was run last."""
        assert self._solver is not None
        return self._solver.volume

    def volume_on(self, grid: Grid) -> Tensor:
        """The same on a grid of the same extent, between its voxels."""
        return interpolate(self.volume[None, None], size=grid.shape, mode="trilinear", align_corners=False)[0, 0]

    def residuals(self, scan: Scan) -> Tensor:
        """[V, H, W] what the volume leaves of the frames of `scan`, on its pixels, over their contrast."""
        return unexplained(scan.measured, self.frames(scan))

    def frames(self, scan: Scan) -> Tensor:
        """[V, H, W] what the volume predicts of the frames of `scan`, on pixels of any size."""
        grid, found = Grid.of_views(in_pixels(scan.views)), self.exposures(scan.exposures)
        images = predicted(self.volume_on(grid), grid, found, self.material, fringe_sampling(scan.exposures)).frames
        return self.numbers[:, FLUX].exp().float()[:, None, None] * images

    def run(self, level: Level, on_progress: Advance) -> None:
        """The rounds of a level, until steps of the shifts are within their standard errors, or fall no longer."""
        at, last = self.prepared(level), math.inf
        trained = torch.from_numpy(~self.scan.is_test)
        for done in range(level.rounds):
            before = self.numbers[:, SHIFT].clone()
            self.solve(self.looked(at), at.shape)
            self.numbers[:, MAGNIFICATION] -= self.numbers[trained, MAGNIFICATION].mean()
            moved = float((self.numbers[:, SHIFT] - before).square().mean())
            on_progress((done + 1) / level.rounds)
            if moved <= float(self.covariances.diagonal(dim1=1, dim2=2)[:, SHIFT].mean()) or moved >= last:
                break
            last = moved
        on_progress(1.0)

    @property
    def edges_follow(self) -> bool:
        """Whether surfaces of one known density go on from the voxels."""
        return self.options.edges > 0 and self.upper == 1.0

    def prepared(self, level: Level) -> Prepared:
        """Inputs of the rounds of a level."""
        scan = self.scan.binned(level.pixels)
        planned = scan.exposures
        grid = Grid.of_views(in_pixels(planned.views))
        return Prepared(scan, self.thickness(scan) / scan.views.pitch, grid, fringe_sampling(planned))

    def looked(self, at: Prepared) -> Normal:
        """Some steps of the volume, and what the frames then say of the numbers."""
        found = self.exposures(at.scan.exposures)
        train = np.flatnonzero(~at.scan.is_test)
        self._improve_volume(LatticeProjector(at.grid, in_pixels(found.views)[train]), at)
        return self.normal(self.volume, at.grid, found, at.scan.measured, at.oversample)

    def thickness(self, scan: Scan) -> Tensor:
        """Retrieved thickness [m] of the training frames of `scan`, on pixels of any size.

        Poses do not matter to it, distances and pixels do: at those planned it is kept for later.
        """
        pixels = round(scan.views.pitch / self.scan.views.pitch)
        as_planned = np.array_equal(scan.exposures.optical.distance, self.scan.exposures.optical.distance)
        if as_planned and pixels in self._retrieved:
            return self._retrieved[pixels]
        found = retrieved(scan[np.flatnonzero(~scan.is_test)], self.material, self.options.retrieval)
        if as_planned:
            self._retrieved[pixels] = found
        return found

    def _improve_volume(self, projector: LatticeProjector, at: Prepared) -> None:
        """Some steps of total-variation tomography in the poses as they are now."""
        options, before, grid = self.options, self._solver, at.grid
        seen = {"images": at.retrieved, "gaps": at.scan.train().gaps}
        first, steps = (math.ceil(self._more * count) for count in (options.first, options.steps))
        if before is None:
            self._solver = PrimalDual(projector, torch.zeros(grid.shape), options.weight, self.upper)
            self._solver.run(iterations=first, **seen)
            return
        if before.volume.shape == torch.Size(grid.shape):
            self._solver = before.on_finer(projector, 1, options.weight)
        else:
            self._solver = PrimalDual(projector, self.volume_on(grid), options.weight, self.upper)
            self._solver.run(iterations=max(0, first - steps), **seen)
        self._solver.run(iterations=steps, **seen)

    def move(self, volume: Tensor, grid: Grid, found: Exposures, frames: Tensor, oversample: int) -> None:
        """One step of all numbers beside `volume` on `grid` (lengths in pixels); found: exposures as they are now."""
        self.solve(self.normal(volume, grid, found, frames, oversample), found.views.shape)

    def normal(self, volume: Tensor, grid: Grid, found: Exposures, frames: Tensor, oversample: int) -> Normal:
        """Information of frames [V, H, W], NaN in pixels without a value, on the parameters (shifts in detector
        pixels), given `volume` on `grid`."""
        scales = torch.ones(len(NUMBERS), dtype=torch.float64)
        scales[SHIFT] = round(found.views.pitch / self.scan.views.pitch)
        magnified = self.options.uncertain.magnification > 0
        here = predicted(volume, grid, found, self.material, oversample, magnified)
        lit = self.numbers[:, FLUX].exp()[:, None, None].float()
        here = replace(here, frames=lit * here.frames, derivatives=lit[:, None] * here.derivatives)
        return Normal.of(frames, here, self.options.blur).in_units(scales)

    def solve(self, normal: Normal, shape: tuple[int, int]) -> None:
        """One step of all numbers; shape: of the frames that say `normal`."""
        moved = step(normal, self.numbers, self.options.uncertain.deviations(min(shape) >= TURNING))
        self.numbers, self.covariances = moved.numbers, moved.covariances


@dataclass(frozen=True)
class Prepared:
    """A level's frames, their retrieved thickness [pixels] (of those for training), the volume's grid (lengths in
    pixels), and samples along a pixel."""

    scan: Scan
    retrieved: Tensor
    grid: Grid
    oversample: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames."""
        return self.scan.views.shape
