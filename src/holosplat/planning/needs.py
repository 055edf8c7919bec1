"""Resource estimates of a job from the sizes of its arrays: memory, disk and time.

`benchmarks/needs.py` measures what the constants below stand for, and writes docs/data/needs.csv.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ..baselines import HolographicTV
from ..checks import InputError
from ..io.room import free_disk, free_memory
from ..matter import MatterKind
from ..methods import (
    Auto,
    Gaussians,
    HolographicVoxels,
    Method,
    NeuralFields,
    Onix,
    PerView,
    PixelNerf,
    SmoothVolume,
    Surfaces,
    Voxels,
)
from ..methods.coarse_cloud import MOST_GAUSSIANS
from ..optics.sampling import fringe_sampling, padding
from ..scan import Exposures
from ..units import two_digits

KINDS: tuple[MatterKind, ...] = ("levels", "continuous")
"""Of matter, of which the frames may decide."""


class Costs:
    """Bytes of memory and seconds that the parts of a job take."""

    program: float = 0.42e9
    """The program and its libraries."""
    report: float = 0.66e9
    """All of it while a run is judged and its report drawn."""
    frames: float = 24.0
    """A pixel of a frame: itself, and copies that are corrected, evened and compared."""
    fine: float = 63.0
    """A voxel of the rounds of agreement: the volume, its dual, and what both are extrapolated to."""
    coarse: float = 22.0
    """A voxel of one pixel beside these."""
    rays: float = 60.0
    """A voxel of a slice that a view crosses: the transposed slice matrix, and the parts that it is made of."""
    smooth: float = 255.0
    """A voxel of a smooth volume: six pairs of L-BFGS, gradients and priors."""
    plain: float = 52.0
    """A voxel of a tomography by itself."""
    points: float = 0.11e9
    """The points of a pixel-aligned field that are evaluated at once, and the weights."""
    aligned: float = 90.0
    """A voxel of such a field, of which two in five show matter: a fifth more is taken where all do."""
    place: float = 5.0
    """Such a voxel in a view: where its shadow lies."""
    features: float = 1500.0
    """A pixel of its images: what the encoder makes of it, with gradients."""
    waves: float = 150.0
    """A wave sample of all views in a fit, with its gradient."""
    edges: float = 105.0
    """The same in a fit of surfaces."""
    gaussian: float = 700.0
    """A Gaussian with gradients, Adam's moments and its tiles."""
    filling: float = 250.0
    """The same of one that fills surfaces of large frames, which is small."""
    simulated: float = 85.0
    """A wave sample of one view of a simulation."""
    written: float = 4.0
    """A number that is written."""
    page: float = 8e6
    """The report and the tables of a run."""
    judged: float = 75.0
    """A wave sample of whole frames, by which surfaces that were fitted in windows are judged."""
    judging: float = 1.6e-6
    """Seconds that it takes."""
    run: float = 15.0
    """Seconds of a run whose fit takes none: the program, decisions about light and noise, judging and the report."""
    turns: float = 2.5
    """Times what a fit of Gaussians takes: that, and the turns of surfaces and volume that may follow in noise."""


SAFETY = 1.1
"""Times the estimate that must be there: it errs by a fifth."""
KEPT = 4
"""Copies of an object that a run folder may hold: itself, two checkpoints with their optimiser, one being written."""
FULL = 0.03
"""Share of a large field that is taken to be full of matter."""
BINNINGS, FEWEST_COLUMNS = range(2, 9), 11
"""What is tried for --bin, and columns that must be left."""


@dataclass(frozen=True)
class Sizes:
    """views, rows and columns of frames; samples: of waves along a pixel; margin: rows and columns of it beside."""

    views: int
    rows: int
    columns: int
    samples: int
    margin: tuple[int, int]

    @classmethod
    def of(cls, exposures: Exposures, binning: int = 1) -> Sizes:
        """Those of exposures, on pixels `binning` times larger."""
        exposures = on_larger_pixels(exposures, binning)
        samples = fringe_sampling(exposures)
        return cls(len(exposures), *exposures.views.shape, samples, padding(exposures, samples))

    @property
    def pixels(self) -> int:
        """Of all frames."""
        return self.views * self.rows * self.columns

    @property
    def voxels(self) -> int:
        """Of one pixel."""
        return self.rows * self.columns**2

    def waves(self, extra: int = 0) -> int:
        """Samples of all waves, with `extra` more along a pixel."""
        rows, columns = (n + 2 * m for n, m in zip((self.rows, self.columns), self.margin))
        return self.views * rows * columns * (self.samples + extra) ** 2

    def joined(self, most: int) -> Sizes:
        """On pixels so many times larger that there are `most` voxels of one at most."""
        factor = 1
        while self.voxels / factor**3 > most and factor < min(self.rows, self.columns):
            factor += 1
        return replace(self, rows=self.rows // factor, columns=self.columns // factor)


def on_larger_pixels(exposures: Exposures, binning: int) -> Exposures:
    """The same field on pixels `binning` times larger."""
    if binning == 1:
        return exposures
    views = exposures.views
    shape = (max(1, views.shape[0] // binning), max(1, views.shape[1] // binning))
    views = replace(views, shape=shape, pitch=views.pitch * binning)
    return replace(exposures, views=views, psf_sigma_px=exposures.psf_sigma_px / binning)


@dataclass(frozen=True)
class Needs:
    """Peak resources of a job: memory and disk [bytes], processor time of all cores together [s];
    most_seconds: the same where what is found in the frames may make it longer (0: it cannot)."""

    memory: float
    disk: float
    seconds: float = 0.0
    most_seconds: float = 0.0

    def line(self) -> str:
        """In words."""
        time = f", and about {_times(self.seconds, self.most_seconds)} of processor time" if self.seconds else ""
        return f"takes about {_size(self.memory)} of memory, {_size(self.disk)} on the disk{time}"

    def times(self, count: int) -> Needs:
        """Resources of so many of the same, one after the other."""
        return Needs(self.memory, count * self.disk, count * self.seconds, count * self.most_seconds)

    def fit(self, path: Path) -> bool:
        """Whether there is so much memory, and disk at `path`."""
        return SAFETY * self.memory <= free_memory() + Costs.program and self.disk <= free_disk(path)


@dataclass(frozen=True)
class Seen:
    """The properties of frames that change it (`planning.seen`). windows: sizes of windows, None for whole frames;
    noisy: whether surfaces begin with Gaussians, and may take turns with a volume."""

    windows: Sizes | None = None
    noisy: bool = False


UNSEEN = Seen()


def of_reconstruction(
    sizes: Sizes, method: Method, matter: MatterKind | None = None, seen: Seen = UNSEEN
) -> Needs | None:
    """Estimate resources of `reconstruct` for training frames of such sizes; None for a method without an estimate.

    matter: its kind, where that is settled; else the frames decide, and it takes what either kind takes.
    """
    if isinstance(method, Auto) and matter is None:
        each = [one for kind in KINDS if (one := of_reconstruction(sizes, method, kind, seen)) is not None]
        times = [time for one in each for time in (one.seconds, one.most_seconds or one.seconds)]
        return replace(max(each, key=lambda one: one.memory), seconds=min(times), most_seconds=max(times))
    worked = seen.windows or sizes
    fit = of_fit(worked, method, matter)
    if fit is None:
        return None
    if seen.windows is not None:
        fit = _judged(fit, sizes)
    if seen.noisy and (more := _in_noise(worked, method, matter)):
        fit = replace(fit, seconds=more, most_seconds=fit.seconds + Costs.turns * more)
    return replace(fit, memory=with_report(sizes, fit.memory))


def _judged(fit: Needs, whole: Sizes) -> Needs:
    """A fit in windows, with the judging of its result by whole frames."""
    finer = whole.waves(1)
    memory = max(fit.memory, Costs.program + Costs.frames * whole.pixels + Costs.judged * finer)
    return Needs(memory, fit.disk + Costs.written * whole.pixels, fit.seconds + Costs.judging * finer)


def _in_noise(sizes: Sizes, method: Method, matter: MatterKind | None) -> float:
    """Seconds of the Gaussians with which surfaces begin in noise, on the pixels that they begin on; 0 where there are
    none."""
    how = (
        method.gaussians if isinstance(method, Surfaces) or (isinstance(method, Auto) and matter == "levels") else None
    )
    if how is None:
        return 0.0
    factor = how.coarse.factor((sizes.rows, sizes.columns))
    coarse = replace(sizes, rows=sizes.rows // factor, columns=sizes.columns // factor)
    return _gaussian_seconds(_fine(coarse, how.volume)[0], edges=True)


def _gaussian_seconds(fine: float, edges: bool) -> float:
    """Of a fit of Gaussians that begins with so many voxels, and of surfaces cut out of them, if there are `edges`."""
    return (20 if edges else 12) + 2.3e-6 * fine


def of_fit(sizes: Sizes, method: Method, matter: MatterKind | None = None) -> Needs | None:
    """The same without the report, which takes memory of its own."""
    if isinstance(method, Auto):
        kinds = (matter,) if matter else KINDS
        each = [of_fit(sizes, method.suited(kind)) for kind in kinds]
        return max((one for one in each if one is not None), key=lambda one: one.memory)
    parts = _parts(sizes, method)
    if parts is None:
        return None
    memory, seconds, numbers = parts
    disk = Costs.written * (KEPT * numbers + sizes.pixels) + Costs.page
    return Needs(Costs.program + Costs.frames * sizes.pixels + memory, disk, seconds)


def with_report(sizes: Sizes, memory: float) -> float:
    """Bytes at the peak of a job that takes `memory`, and whose result is judged and drawn then."""
    return max(memory, Costs.frames * sizes.pixels + Costs.report + 0.5 * Costs.waves * sizes.waves())


def _parts(sizes: Sizes, method: Method) -> tuple[float, float, float] | None:
    """Bytes beside the program, seconds, and numbers of the object."""
    if isinstance(method, PerView):
        memory = Costs.plain * sizes.voxels + Costs.rays * sizes.views * sizes.columns**2
        return memory, Costs.run + 0.35e-6 * sizes.views * sizes.voxels, sizes.voxels
    if isinstance(method, SmoothVolume):
        small = sizes.joined(method.max_voxels)
        memory = max(Costs.smooth * small.voxels, of_start(small, method.volume))
        return memory, 10 + 4.5e-6 * sizes.views * small.voxels, small.voxels
    if isinstance(method, HolographicVoxels | Voxels | NeuralFields):
        begun, fine = of_start(sizes, method.volume), _fine(sizes, method.volume)[0]
        if isinstance(method, HolographicVoxels):
            return begun, Costs.run + 1.5e-6 * fine, fine
        fitted = Costs.waves * sizes.waves() + Costs.plain * sizes.voxels
        return max(begun, fitted), 20 + 3e-6 * fine, sizes.voxels
    if isinstance(method, Onix | PixelNerf):
        small, steps = sizes.joined(method.fit.max_voxels), method.fit.schedule.steps
        seen = small.views * small.voxels
        memory = Costs.points + Costs.aligned * small.voxels + Costs.place * seen + Costs.features * small.pixels
        memory += Costs.waves * sizes.waves()
        return memory, 5 + 0.9e-6 * steps * seen, small.voxels
    gaussians = method if isinstance(method, Gaussians) else getattr(method, "gaussians", None)
    return _bodies(sizes, gaussians, gaussians is not method) if isinstance(gaussians, Gaussians) else None


def _bodies(sizes: Sizes, how: Gaussians, edges: bool) -> tuple[float, float, float]:
    """The same of Gaussians, and of surfaces cut out of them where there are `edges`."""
    batch = how.fit.schedule.views_per_step
    fitted = replace(sizes, views=min(batch, sizes.views) if batch else sizes.views).waves()
    waves = max(Costs.waves * fitted, Costs.edges * sizes.waves(1) if edges else 0.0)
    begun = 0.0 if how.start == "random" else of_start(sizes, how.volume)
    count = how.random_count if how.start == "random" else min(how.max_start, how.start_per_pixel * sizes.pixels)
    fine = _fine(sizes, how.volume)[0]
    memory, numbers = max(begun, waves + Costs.gaussian * count), 14 * count
    seconds, finer = _gaussian_seconds(fine, edges), sizes.waves(1)
    near = 12 + 1.07e-5 * finer  # surfaces from coarse pixels on, where they show bodies
    if how.start != "phase" or how.coarse.columns == 0:
        return memory, seconds, numbers
    if edges:
        return memory, near, numbers
    if how.coarse.factor((sizes.rows, sizes.columns)) == 1:
        return memory, seconds, numbers
    filled = min(MOST_GAUSSIANS, FULL * sizes.voxels)
    memory = max(memory, Costs.waves * finer + Costs.filling * filled)
    return memory, max(seconds, near + 2e-7 * filled * sizes.views), 14 * filled


def _fine(sizes: Sizes, how: HolographicTV) -> tuple[int, int]:
    """Voxels of the rounds of agreement, and how many lie along a pixel."""
    refine = how.refine or sizes.samples
    while refine > 1 and sizes.voxels * refine**3 > how.max_voxels:
        refine -= 1
    return sizes.joined(how.max_voxels).voxels * refine**3, refine


def of_start(sizes: Sizes, how: HolographicTV) -> float:
    """Bytes of a start by phase retrieval and total variation."""
    fine, refine = _fine(sizes, how)
    small = sizes.joined(how.max_voxels)
    alone = Costs.plain * small.voxels + Costs.rays * small.views * small.columns**2
    if how.corrections == 0:
        return alone
    rays = Costs.rays * small.views * (small.columns * refine) ** 2
    return max(alone, Costs.fine * fine + Costs.coarse * small.voxels + rays)


def of_simulation(exposures: Exposures, samples: int, frames: int) -> Needs:
    """What `simulate` takes: one view of waves at a time, and `frames` that are written. samples: along a pixel."""
    margin = padding(exposures, samples)
    rows, columns = (n + 2 * m for n, m in zip(exposures.views.shape, margin))
    pixels = frames * math.prod(exposures.views.shape)
    return Needs(Costs.program + Costs.simulated * rows * columns * samples**2, Costs.written * pixels + 1e6)


def require_room(needs: Needs, path: Path, others: Iterable[tuple[str, Needs]] = ()) -> None:
    """`InputError` if a job does not fit into memory and disk, with the first of the `others` that does."""
    if needs.fit(path):
        return
    memory, disk = free_memory() + Costs.program, free_disk(path)
    way = next((f"{how} takes {_size(one.memory)} and {_size(one.disk)}" for how, one in others if one.fit(path)), "")
    raise InputError(
        f"the job {needs.line()}, but {_size(memory)} of memory and {_size(disk)} of disk are free; "
        f"{way or 'take a part of it (of frames by --crop, --views), or a larger machine'}."
    )


def smaller(exposures: Exposures, method: Method, matter: MatterKind | None) -> Iterator[tuple[str, Needs]]:
    """The same reconstruction on larger voxels in the start, and on larger pixels; how, and what it takes then."""
    flag, coarse = _one_voxel_a_pixel(method)
    for factor in (1, *BINNINGS):
        if factor > 1 and exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        sizes, bins = Sizes.of(exposures, factor), f"--bin {factor}" if factor > 1 else ""
        for how, tried in ((bins, method), (f"{bins} {flag}".strip(), coarse)):
            needs = of_reconstruction(sizes, tried, matter)
            if needs is not None and how:
                yield how, needs


def coarser(exposures: Exposures, of: Callable[[Exposures], Needs]) -> Iterator[tuple[str, Needs]]:
    """What `of` says of the same frames on larger pixels; how, and what it takes then."""
    for factor in BINNINGS:
        if exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        yield f"--bin {factor}", of(on_larger_pixels(exposures, factor))


def _one_voxel_a_pixel(method: Method) -> tuple[str, Method]:
    """A method whose start has voxels of one pixel, and the flag that makes it so; none where it has no such start."""
    start = getattr(method, "volume", None)
    if isinstance(start, HolographicTV) and isinstance(method, Gaussians | HolographicVoxels | Voxels | NeuralFields):
        return "--set volume.refine=1", replace(method, volume=replace(start, refine=1))
    if isinstance(method, Auto | Surfaces):
        gaussians = method.gaussians
        coarse = replace(gaussians, volume=replace(gaussians.volume, refine=1))
        return "--set gaussians.volume.refine=1", replace(method, gaussians=coarse)
    return "", method


def _size(bytes_: float) -> str:
    return f"{two_digits(bytes_ / 1e9)} GB" if bytes_ >= 0.95e9 else f"{max(1.0, bytes_ / 1e6):.0f} MB"


def _times(least: float, most: float) -> str:
    """A range of times; the first alone where there is no other."""
    first, last = _time(least), _time(max(least, most))
    return first if first == last else f"{first.removesuffix(last[last.index(' ') :])} to {last}"


def _time(seconds: float) -> str:
    if seconds < 90:
        return f"{max(1, round(seconds, -1)):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
