"""Resource estimates of a job from the sizes of its arrays: memory, disk and time.

`benchmarks/needs.py` measures what the constants below stand for, and writes docs/data/needs.csv.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from ..baselines import HolographicTV
from ..checks import InputError
from ..io.room import free_disk, free_memory
from ..matter import MatterKind
from ..methods import (
    Auto,
    Gaussians,
    HolographicVoxels,
    Method,
    PerView,
    SmoothVolume,
    Surfaces,
    Voxels,
    uncertain,
)
from ..methods.cross_validation import EFFORT, FEWEST, MANY, MOST, WIDTH
from ..methods.start import MOST_GAUSSIANS
from ..optics.sampling import fringe_sampling, on_larger_pixels, padding
from ..scan import Exposures
from ..units import between, size_in_words, time_in_words

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
    beside: float = 12.0
    """Seconds of a run that a fit to coarse frames within it does not take: the program, judging and the report."""
    near: float = 8.0
    """The same where coarse pixels show the surfaces."""
    step: float = 0.057
    """Seconds of a step of such surfaces on any frames."""
    edge: float = 1.53e-7
    """The same for a wave sample."""
    ratio: float = 0.2
    """Seconds of a trial of δ/β."""
    ratio_voxel: float = 1.6e-6
    """The same for a voxel of coarse pixels in a view."""


SAFETY = 1.1
"""Times the estimate that must be there: it errs by a fifth."""
KEPT = 4
"""Copies of an object that a run folder may hold: itself, two checkpoints with their optimiser, one being written."""
RATIOS = uncertain.MANY + 2 * (uncertain.NEWTON + 1)
"""Trials of δ/β of which nothing is known."""
FULL = 0.03
"""Share of a large field that is taken to be full of matter."""


@dataclass(frozen=True)
class Sizes:
    """views, rows and columns of frames; samples: of waves along a pixel; margin: rows and columns of it beside; times:
    of which the frames are."""

    views: int
    rows: int
    columns: int
    samples: int
    margin: tuple[int, int]
    times: int = 1

    @classmethod
    def of(cls, exposures: Exposures, binning: int = 1) -> Sizes:
        """Those of exposures, on pixels `binning` times larger."""
        exposures = on_larger_pixels(exposures, binning)
        samples = fringe_sampling(exposures)
        times = len(np.unique(exposures.time))
        return cls(len(exposures), *exposures.views.shape, samples, padding(exposures, samples), times)

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


@dataclass(frozen=True)
class Needs:
    """Peak resources of a job: memory, at most, and disk [bytes], processor time of all cores together [s];
    most_seconds, least_memory: the same where what is found in the frames may change them (0: it cannot)."""

    memory: float
    disk: float
    seconds: float = 0.0
    most_seconds: float = 0.0
    least_memory: float = 0.0

    def line(self) -> str:
        """In words."""
        time = f", and about {between(time_in_words, self.seconds, self.most_seconds)} of processor time" * (
            self.seconds > 0
        )
        memory = between(size_in_words, self.least_memory or self.memory, self.memory)
        return f"takes about {memory} of memory, {size_in_words(self.disk)} on the disk{time}"

    def times(self, count: int) -> Needs:
        """Resources of so many of the same, one after the other."""
        seconds, most = count * self.seconds, count * self.most_seconds
        return replace(self, disk=count * self.disk, seconds=seconds, most_seconds=most)

    def fit(self, path: Path) -> bool:
        """Whether there is so much memory, and disk at `path`."""
        return SAFETY * self.memory <= free_memory() + Costs.program and self.disk <= free_disk(path)


@runtime_checkable
class Estimated(Protocol):
    """A method that says itself what it takes, as those of other packages do."""

    def needs(self, sizes: Sizes) -> Needs:
        """Of training frames of such sizes, beside the program and the frames; `disk` in numbers of the object."""
        ...


@dataclass(frozen=True)
class Seen:
    """Properties of frames: sizes of windows (None: whole frames), and whether surfaces begin with Gaussians in
    noise."""

    windows: Sizes | None = None
    noisy: bool = False


UNSEEN = Seen()


def of_reconstruction(
    sizes: Sizes, method: Method, matter: MatterKind | None = None, seen: Seen = UNSEEN, ratio_told: bool = True
) -> Needs | None:
    """Estimate resources of `reconstruct` for training frames of such sizes; None for a method without an estimate.

    matter: its kind, where that is settled; else the frames decide, and it takes what either kind takes.
    ratio_told: whether δ/β is known. Fits to coarse frames may decide of light, matter and ratio: the longest time has
    room for them.
    """
    kinds = KINDS if isinstance(method, Auto) and matter is None else (matter,)
    each = [one for kind in kinds if (one := _of_kind(sizes, method, kind, seen)) is not None]
    if not each:
        return None
    worked, first = seen.windows or sizes, max(each, key=lambda one: one.memory)
    settled = _without_rounds(method) if seen.noisy else method
    decided = of_choice(worked, settled) if isinstance(settled, Auto) else 0.0
    decided += of_ratio(worked) if not ratio_told and isinstance(method, Auto | SmoothVolume) else 0.0
    least = min(one.least_memory or one.memory for one in each) if len(each) > 1 else first.least_memory
    most = max(one.most_seconds or one.seconds for one in each) + decided
    return replace(first, seconds=min(one.seconds for one in each), most_seconds=most, least_memory=least)


def _of_kind(sizes: Sizes, method: Method, matter: MatterKind | None, seen: Seen) -> Needs | None:
    """The same for a kind of matter, without decisions."""
    worked = seen.windows or sizes
    fit = of_fit(worked, _without_rounds(method) if seen.noisy else method, matter)
    if fit is None:
        return None
    if seen.windows is not None:  # the result is judged by whole frames
        finer = sizes.waves(1)
        judged, more = Costs.program + Costs.frames * sizes.pixels + Costs.judged * finer, Costs.judging * finer
        least = fit.least_memory and max(fit.least_memory, judged)
        most, disk = fit.most_seconds and fit.most_seconds + more, fit.disk + Costs.written * sizes.pixels
        fit = Needs(max(fit.memory, judged), disk, fit.seconds + more, most, least)
    is_body = isinstance(method, Surfaces) or (isinstance(method, Auto) and matter == "levels")
    how = getattr(method, "gaussians", None) if is_body and seen.noisy else None
    if isinstance(how, Gaussians):  # with which surfaces begin, on the pixels that they begin on
        factor = how.coarse.factor((worked.rows, worked.columns))
        coarse = replace(worked, rows=worked.rows // factor, columns=worked.columns // factor)
        more = _gaussian_seconds(_fine(coarse, how.volume)[0], edges=True)
        fit = replace(fit, seconds=more, most_seconds=fit.seconds + Costs.turns * more)
    least = with_report(sizes, fit.least_memory) if fit.least_memory else 0.0
    return replace(fit, memory=with_report(sizes, fit.memory), least_memory=least)


def _coarse(sizes: Sizes) -> Sizes:
    """Those of the coarse frames by which is decided."""
    factor = math.ceil(max(sizes.rows, sizes.columns) / WIDTH)
    rows, columns = (max(1, n // factor) for n in (sizes.rows, sizes.columns))
    return replace(sizes, rows=rows, columns=columns, samples=factor * sizes.samples)


def of_choice(sizes: Sizes, method: Auto) -> float:
    """Seconds, at most, of fits of both kinds of matter to coarse frames (`methods.illumination`, `methods.levels`)."""
    if sizes.views < FEWEST:
        return 0.0
    coarse, folds = _coarse(sizes), MOST if sizes.views >= MANY else sizes.views
    each = [of_fit(coarse, method.with_effort(EFFORT), kind) for kind in KINDS]
    return folds * sum(max(one.seconds, one.most_seconds) - Costs.beside for one in each if one is not None)


def of_ratio(sizes: Sizes) -> float:
    """Seconds for δ/β, which is fitted to coarse frames (`methods.uncertain`)."""
    coarse = _coarse(sizes)
    return RATIOS * (Costs.ratio + Costs.ratio_voxel * coarse.views * coarse.voxels)


def _without_rounds(method: Method) -> Method:
    """A method whose bodies begin in noise, with a volume that agrees with no frames."""
    if isinstance(method, Surfaces | Auto):
        return replace(method, gaussians=_without_rounds(method.gaussians))
    assert isinstance(method, Gaussians)
    return replace(method, volume=replace(method.volume, corrections=0))


def _gaussian_seconds(fine: float, edges: bool) -> float:
    """Of a fit of Gaussians that begins with so many voxels, and of surfaces cut out of them, if there are `edges`."""
    return (20 if edges else 12) + 2.3e-6 * fine


def of_fit(sizes: Sizes, method: Method, matter: MatterKind | None = None) -> Needs | None:
    """The same without the report, which takes memory of its own."""
    if isinstance(method, Auto):
        kinds = (matter,) if matter else KINDS
        each = [of_fit(sizes, method.suited(kind)) for kind in kinds]
        return max((one for one in each if one is not None), key=lambda one: one.memory)
    beside = _beside(sizes, method)
    if beside is None:
        return None
    rest = Costs.program + Costs.frames * sizes.pixels
    disk, least = Costs.written * (KEPT * beside.disk + sizes.pixels) + Costs.page, beside.least_memory
    return replace(beside, memory=rest + beside.memory, disk=disk, least_memory=least and rest + least)


def with_report(sizes: Sizes, memory: float) -> float:
    """Bytes at the peak of a job that takes `memory`, and whose result is judged and drawn then."""
    return max(memory, Costs.frames * sizes.pixels + Costs.report + 0.5 * Costs.waves * sizes.waves())


def _beside(sizes: Sizes, method: Method) -> Needs | None:
    """Resources beside the program and the frames; disk: in numbers of the object."""
    if isinstance(method, Estimated):
        return method.needs(sizes)
    if isinstance(method, PerView):
        memory = Costs.plain * sizes.voxels + Costs.rays * sizes.views * sizes.columns**2
        return Needs(memory, sizes.voxels, Costs.run + 0.35e-6 * sizes.views * sizes.voxels)
    if isinstance(method, SmoothVolume):
        small = sizes.joined(method.max_voxels)
        memory = max(Costs.smooth * small.voxels, of_start(small, method.volume))
        return Needs(memory, small.voxels, Costs.run + 4.5e-6 * sizes.views * small.voxels)
    if isinstance(method, HolographicVoxels):
        fine = _fine(sizes, method.volume)[0]
        return Needs(of_start(sizes, method.volume), fine, Costs.run + 1.5e-6 * fine)
    if isinstance(method, Voxels):
        return of_grid(sizes, method.volume)
    gaussians = method if isinstance(method, Gaussians) else getattr(method, "gaussians", None)
    return _bodies(sizes, gaussians, gaussians is not method) if isinstance(gaussians, Gaussians) else None


def _bodies(sizes: Sizes, how: Gaussians, edges: bool) -> Needs:
    """The same of Gaussians, and of surfaces cut out of them if there are `edges`; coarse pixels that show the bodies
    spare a fine volume."""
    batch = how.fit.schedule.views_per_step
    fitted = replace(sizes, views=min(batch, sizes.views) if batch else sizes.views).waves()
    waves = max(Costs.waves * fitted, Costs.edges * sizes.waves(1) if edges else 0.0)
    begun = 0.0 if how.start == "random" else of_start(sizes, how.volume)
    count = how.random_count if how.start == "random" else min(how.max_start, how.start_per_pixel * sizes.pixels)
    steps = max(1.0, how.volume.few_views / max(1, sizes.views))  # few views have more steps a round,
    few = 0.22 + 0.78 * min(sizes.views, 12) / 12  # and a fifth of a step does not depend on their number
    work = _fine(sizes, how.volume)[0] * steps * few if how.volume.corrections or not edges else 0.0
    memory, seconds = max(begun, waves + Costs.gaussian * count), _gaussian_seconds(work, edges)
    plain, finer = Needs(memory, 14 * count, seconds), sizes.waves(1)
    steps = how.coarse.of_views(sizes.views)
    near = Costs.near + (steps.coarse_steps + steps.last_steps) * (Costs.step + Costs.edge * finer)
    if how.start != "phase" or how.coarse.columns == 0:
        return plain
    if edges:
        least = max(of_start(sizes, replace(how.volume, corrections=0)), waves)
        longest = near + max(0.0, seconds - Costs.beside)  # of both ways, one after the other
        return replace(plain, seconds=near, most_seconds=longest, least_memory=min(least, memory))
    if how.coarse.factor((sizes.rows, sizes.columns)) == 1:
        return plain
    filled = min(MOST_GAUSSIANS, FULL * sizes.voxels)
    memory = max(memory, Costs.waves * finer + Costs.filling * filled)
    return Needs(memory, 14 * filled, max(seconds, near + 2e-7 * filled * sizes.views))


def of_grid(sizes: Sizes, how: HolographicTV) -> Needs:
    """The same of voxels, or of a field that is looked at on voxels, fitted from such a start."""
    fitted = Costs.waves * sizes.waves() + Costs.plain * sizes.voxels
    return Needs(max(of_start(sizes, how), fitted), sizes.voxels, 20 + 3e-6 * _fine(sizes, how)[0])


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


def require_room(needs: Needs, path: Path, others: Iterable[tuple[str, Needs]] = ()) -> None:
    """`InputError` if a job does not fit into memory and disk, with the first of the `others` that does."""
    if needs.fit(path):
        return
    memory, disk = free_memory() + Costs.program, free_disk(path)
    fits = ((how, one) for how, one in others if one.fit(path))
    way = next((f"{how} takes {size_in_words(one.memory)} and {size_in_words(one.disk)}" for how, one in fits), "")
    raise InputError(
        f"the job {needs.line()}, but {size_in_words(memory)} of memory and {size_in_words(disk)} of disk are free; "
        f"{way or 'take a part of it (of frames by --crop, --views), or a larger machine'}."
    )
