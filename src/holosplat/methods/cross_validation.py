"""What hypotheses about light, noise and matter are compared by: frames that objects predict, what is missing from
them, and first volumes of coarse frames. Views are set aside in folds; the volumes of the others, by retrieval and
tomography without bounds, predict them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ..backends import Backend, resolve
from ..baselines import HolographicTV, holographic_tv
from ..baselines.algebraic import Algebraic, sirt
from ..baselines.beyond import margins_of
from ..baselines.holographic_tv import Correction, retrieved
from ..baselines.material import DEFAULT, RATIOS, USUAL_RATIO, MaterialEstimate, estimate_delta
from ..checks import InputError, NoMatterError
from ..fit.whitened import WhitenedFrames
from ..frames import evenly
from ..geometry import Grid
from ..inference import Decision, Score, select
from ..matter import DeltaBeta, KnownRatio, MaterialPrior, Matter
from ..memory import memory_kept
from ..model import Instrument, Model
from ..optics.background import Background, Light, LightOptions
from ..optics.noise import NoiseModel, noise_levels
from ..optics.retrieval import paganin
from ..optics.sampling import alike, fringe_sampling
from ..progress import Progress
from ..representations import BandLimitedVoxels, Stored, VoxelGrid
from ..scan import Exposures, Scan
from ..volume import Object
from .spherical import SphericalMatter, likeliest_sphere

DRAWS = 16
"""Of the noise, for what it leaves of the matter: a standard deviation by so many is right to a sixth."""
HIDDEN = 2.0
"""Standard deviations of what noise leaves of the matter that it may hide."""


def predicted_frames(exposures: Exposures, obj: Object, oversample: int = 0) -> Tensor:
    """Frames [V, H, W] of `obj`, some views at a time to bound memory.

    oversample: wave samples a pixel (0: as the first fringe needs, or as voxels have it).
    """
    voxels = exposures.views.finest / min(obj.grid.voxel_size) if isinstance(obj, VoxelGrid) else math.inf
    samples = oversample or fringe_sampling(exposures, voxels=voxels)
    backend = obj.backend if isinstance(obj, Stored) else "cpu"
    frames = torch.empty(len(exposures), *exposures.views.shape)
    with torch.no_grad(), memory_kept():
        for views in alike(exposures, samples):
            instrument = Instrument(exposures[views], samples, backend=backend)
            frames[torch.from_numpy(views)] = Model(obj, instrument).frames().cpu()
    return frames


class MissingMatter:
    """What is missing from the frames of a scan, as thickness of a material: the judge of whole volumes.

    A residual of intensity is turned into the thickness that would explain it, by Wiener's inverse of each view for
    its noise (`Correction`). So low frequencies, which hardly change a hologram, count by the matter that they stand
    for, and those that noise hides do not count at all.
    """

    def __init__(self, scan: Scan, material: DeltaBeta) -> None:
        self.scan, self._correction = scan, Correction(scan, material)
        self.whole = max(self.of(scan.left(torch.ones(()))), np.finfo(float).tiny)
        """Mean square of all matter in the frames [m²]."""

    def of(self, residual: Tensor) -> float:
        """Mean square [m²] of the thickness that explains residuals [V, H, W] of intensity."""
        return float(self._correction(residual).double().square().mean())

    def share(self, predicted: Tensor) -> float:
        """Root of the part of all matter that predicted frames [V, H, W] leave unexplained: 0 for those of a perfect
        object, about 1 for even light."""
        return math.sqrt(self.of(self.scan.left(predicted)) / self.whole)

    def beyond_noise(self, predicted: Tensor, noise: NoiseModel) -> float:
        """Root of the part of all matter that predicted frames [V, H, W] leave unexplained beyond `noise`; 0 where
        that may hide all of it, by `HIDDEN` standard deviations."""
        draws = torch.tensor([self.of(noise.drawn(seed)) for seed in range(DRAWS)], dtype=torch.float64)
        left = (self.of(self.scan.left(predicted)) - float(draws.mean())) / self.whole
        deviation = float(draws.std(correction=0)) / self.whole
        return math.sqrt(left) if left > HIDDEN * deviation else 0.0


PICTURE_WIDTH, PICTURE_VIEWS = 48, 32
"""Frames of a first picture are binned to about so many pixels, and it takes so many of them at most: on one core it is
there in half a second."""
PICTURE_SWEEPS = Algebraic(sweeps=20, relaxation=1.9, nonnegative=True)
"""Sweeps of its tomography: more change nothing that is seen."""
WIDTH = 64
"""Frames are binned to about so many pixels at most, on which a volume takes a second."""
FEWEST = 3
"""Views from which on some are set aside; of fewer, noise is added and taken off again (`Folds`)."""
MANY, MOST = 6, 3
"""Views from which on two are set aside at a time, and folds at most: six views tell their scatter well enough."""
TOGETHER = 4
"""Views set aside at a time, at most, where fits are compared: as many tell their own scatter, which two do not, so
that clear decisions take one fit of each candidate and not two."""
EFFORT = 0.2
"""Part of the usual steps of a fit by which hypotheses are compared: all of them have as many."""
CHECKED = 4
"""Edge of the squares [pixels], in which unknown light of unseen frames is fitted and tested in turns."""

UNSEEN_RATIO = "δ/β of first volumes"

T = TypeVar("T")

BY_VIEWS, BY_FISSION = "views set aside", "data fission"


def coarse_binning(scan: Scan) -> int:
    """How many pixels along an edge are joined for first volumes."""
    return scan.largest_binning(math.ceil(max(scan.views.shape) / WIDTH))


def first_picture(train: Scan, prior: MaterialPrior) -> VoxelGrid:
    """A coarse volume of training frames at once, to look at: of several times, that of the one in the middle.

    Paganin's filter on binned frames (`optics.retrieval.paganin`), then SIRT without negative values. Where δ is not
    known, the densest voxel stands for one. Nothing random is drawn, and no result depends on it. Errors: `InputError`
    for frames that cannot be retrieved.
    """
    one = train.at_instant(len(train.instants) // 2) if train.is_series else train
    one = one[evenly(len(one), PICTURE_VIEWS)]
    scan = one.binned(one.largest_binning(math.ceil(max(one.views.shape) / PICTURE_WIDTH)))
    ratio = prior.ratio if isinstance(prior, KnownRatio) else prior.delta_sign * USUAL_RATIO
    delta = prior.delta_sign * 1e-6  # any: the thickness is found in its units
    delta, beta = prior.materials[0] if prior.materials else DeltaBeta(delta, delta / ratio)
    known = {"missing": scan.gaps, "two_sided": prior.two_sided}
    lines = paganin(torch.from_numpy(scan.frames), scan.exposures, delta, beta, **known)
    grid = Grid.of_views(scan.views)
    values = sirt(lines, scan.views, grid, None, lambda fraction: None, options=PICTURE_SWEEPS, **known)
    top = 1.0 if prior.materials else max(float(values.abs().max()), 1e-30)
    return VoxelGrid(values[None] / top, grid, Matter.one(delta * top, beta * top))


@dataclass(frozen=True)
class Folds:
    """Coarse frames, and how parts of them are kept from a fit.

    Of fewer views than `FEWEST` none can be spared. Then noise is split (Leiner et al. 2023): with noise of standard
    deviation σ and normal ε, `y + σ ε` and `y - σ ε` are independent; one is fitted and the other predicted. That sees
    what follows noise, and nothing of what lies between views.
    """

    scan: Scan
    count: int
    by: str
    binning: int = 1
    shape: tuple[int, int] | None = None
    """(H, W) of the frames before binning; None: as these."""
    together: int = 1
    """Views that are set aside at a time."""

    @classmethod
    def of(cls, train: Scan, binning: int | None = None, fewest: int = FEWEST) -> Folds:
        """Of training frames; of several times, of those in the middle. binning: of pixels along an edge; None: as many
        as leave coarse frames; fewest: views from which on some are set aside."""
        train = train.at_instant(len(train.instants) // 2) if train.is_series else train
        binning, views = binning or coarse_binning(train), len(train)
        by, most = (BY_FISSION, 1) if views < fewest else (BY_VIEWS, MOST if views >= MANY else views)
        return cls(train.binned(binning), most, by, binning, train.views.shape, 1 if views < MANY else 2)

    @property
    def of_third(self) -> Folds:
        """The same with up to `TOGETHER` views set aside at a time, as many as leave two thirds of them."""
        return replace(self, together=max(self.together, min(TOGETHER, len(self.scan) // 3)))

    def aside(self, fold: int) -> np.ndarray:
        """Numbers of the views that are not fitted. Folds share none; many views are not all predicted."""
        views, chosen = len(self.scan), self.together * self.count
        return np.unique(np.arange(chosen) * views // chosen)[fold :: self.count]

    def kept(self, fold: int) -> np.ndarray:
        """Numbers of the views that are fitted: all of them, where noise is split."""
        views = np.arange(len(self.scan))
        return views if self.by == BY_FISSION else np.setdiff1d(views, self.aside(fold))

    def split(self, fold: int) -> tuple[Scan, Scan]:
        """What is fitted, and what is predicted."""
        if self.by == BY_FISSION:
            frames = torch.from_numpy(self.scan.frames)
            draw = torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
            noise = noise_levels(self.scan.measured)[:, None, None].float() * draw
            return tuple(replace(self.scan, frames=(frames + s * noise).numpy()) for s in (1, -1))  # type: ignore[return-value]
        return self.scan[self.kept(fold)], self.scan[self.aside(fold)]


@dataclass
class FirstVolumes:
    """The volumes of a scan's folds under hypotheses, each made once."""

    folds: Folds
    prior: MaterialPrior
    on_progress: Progress
    options: HolographicTV = field(
        default_factory=lambda: HolographicTV(
            retrieval=20, iterations=80, corrections=3, upper=0.0, refine=1, beyond=False, relit=1
        )
    )
    taken: tuple[str, ...] = ()
    """What was decided of light and noise."""
    part_of: tuple[FirstVolumes, int] | None = None
    """The volumes, and their fold, whose fitted frames these are, as they were measured."""
    _ratio: float | None = None
    _material: DeltaBeta | None = None
    _made: dict[tuple[object, int], object] = field(default_factory=dict)
    _thickness: dict[object, tuple[Tensor, float]] = field(default_factory=dict)
    """What phase retrieval has found in all coarse frames as they were measured, for which δ."""

    @property
    def material(self) -> DeltaBeta:
        """The one material that stands for all matter, of the frames as they were measured."""
        if self._material is None:
            prior = self.prior
            if self._ratio or not prior.fixes_ratio:
                prior = prior.with_ratio(self._ratio or self.ratio[0])
            how = self.folds.scan, prior, self.on_progress, self.options.backend
            self._material = self.once("material", 0, lambda: assumed_material(*how))
        return self._material

    @property
    def ratio(self) -> tuple[float, Decision]:
        """δ/β of matter of which nothing is known (`unseen_ratio`), and the decision that it comes from."""
        return self.once("ratio", 0, lambda: unseen_ratio(self))

    def at_ratio(self, ratio: float) -> FirstVolumes:
        """Volumes of the same folds, of one material of δ/β `ratio`."""
        made = partial(replace, self, _ratio=ratio, _material=None, _made={})
        return self.once(("at ratio", self.prior, ratio), 0, made)

    def as_measured(self, fold: int) -> Score:
        """The score of the volume of a fold in even light and white noise, on the unseen frames."""
        seen, unseen = self.folds.split(fold)
        volume = self.volume(fold, plain_light(seen.measured, LightOptions()))
        return Score.of(unseen.left(predictions(volume, unseen).double()))

    @property
    def for_fits(self) -> FirstVolumes:
        """Those of folds of a third of the views (`Folds.of_third`), by which fits are compared; of the same material,
        and of the same frames after phase retrieval."""
        folds = self.folds.of_third
        if self.folds.by == BY_FISSION or folds.together == self.folds.together:
            return self
        made = partial(replace, self, folds=folds, _material=self.material, _made={})
        found = self.once(("for fits", self.prior), 0, made)
        found.taken = self.taken
        return found

    @property
    def _how(self) -> HolographicTV:
        return replace(self.options, two_sided=self.prior.two_sided)

    def once(self, key: object, fold: int, make: Callable[[], T]) -> T:
        """What `make` gives, or that there is no such matter, made once for a key and a fold."""
        if (key, fold) not in self._made:
            try:
                self._made[key, fold] = make()
            except NoMatterError as error:
                self._made[key, fold] = error
        found = self._made[key, fold]
        if isinstance(found, NoMatterError):
            raise found
        return found  # type: ignore[return-value]

    def volume(self, fold: int, light: Light) -> VoxelGrid | SphericalMatter:
        """The volume of the fitted frames of a fold, which were measured in `light`."""
        seen, _ = self.folds.split(fold)
        even, lines = replace(seen, frames=light.evened(torch.from_numpy(seen.frames)).numpy()), None
        if is_plain(light) and self.folds.by == BY_VIEWS:
            lines = self.thickness(fold, self.material, self._how)
        values, grid = holographic_tv(even, self.material, self._how, self.on_progress, light, lines=lines)
        if self.prior.spherical:
            beyond = margins_of(grid, seen.views)
            frames = WhitenedFrames(even, self.material, light.noise, beyond=beyond)
            return likeliest_sphere(frames, values, self.prior.lower)
        return VoxelGrid(values[None], grid, Matter.one(*self.material)).on(resolve(self.options.backend))

    def thickness(self, fold: int, material: DeltaBeta, how: HolographicTV) -> Tensor:
        """What phase retrieval finds in the fitted frames of a fold as they were measured [V, H, W] [m]: each frame by
        itself, so that folds share it, and materials of one δ/β, for phases are what is found."""
        key = (f"{material.ratio:.9g}", material.delta > 0, how.retrieval, how.two_sided, how.backend)
        if key not in self._thickness:
            self._thickness[key] = retrieved(self.folds.scan, material, how, self.on_progress), material.delta
        lines, delta = self._thickness[key]
        return lines[self.folds.kept(fold)] * (delta / material.delta)

    def lines(self, scan: Scan, material: DeltaBeta, how: HolographicTV) -> Tensor | None:
        """The same of the frames of `scan`, where these are a part of other ones that share it; else None."""
        if self.part_of is None or scan is not self.folds.scan:
            return None
        whole, fold = self.part_of
        return whole.thickness(fold, material, how)


def unseen_ratio(first: FirstVolumes) -> tuple[float, Decision]:
    """δ/β whose volumes of frames as measured predict unseen ones better than those of any of `RATIOS` nearer to
    `USUAL_RATIO`, the null; by a parabola through their residuals, between this and those beside it.

    Where there is no matter of a ratio, its prediction is even light.
    """
    tried = {f"{ratio:.6g}": first.at_ratio(ratio) for ratio in RATIOS}
    outwards = sorted(tried, key=lambda name: abs(math.log(float(name) / USUAL_RATIO)))

    @cache
    def score(name: str, fold: int) -> Score:
        try:
            return tried[name].as_measured(fold)
        except InputError:  # there is no such matter
            return without_matter(first, fold)

    first.on_progress(UNSEEN_RATIO, 0.0)
    decision = select(UNSEEN_RATIO, outwards, score, first.folds.count, by=first.folds.by)
    at = list(tried).index(decision.choice)
    if not 0 < at < len(tried) - 1:
        return RATIOS[at], decision
    near = [Score.joined([score(name, k) for k in range(first.folds.count)]) for name in list(tried)[at - 1 : at + 2]]
    larger, smaller = (near[1].gain_over(near[k])[0] for k in (0, 2))
    bend = larger + smaller
    offset = float(np.clip(0.5 * (larger - smaller) / bend, -1, 1)) if bend > 0 else 0.0
    return float(f"{RATIOS[at] * (RATIOS[1] / RATIOS[0]) ** offset:.4g}"), decision


def assumed_material(
    scan: Scan,
    prior: MaterialPrior,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
) -> DeltaBeta:
    """δ and β of one material for all matter: as known, or as the training frames `scan` suggest.

    Where several are known, it has the δ of the first, and the ratio of an equal mixture. What is not known has the
    sign of δ that the prior says, or is above the medium where it says none, and the δ/β of `FirstVolumes.ratio`.
    """
    if prior.materials:
        deltas, betas = zip(*prior.materials)
        added = sum(math.copysign(beta, beta * delta) for delta, beta in prior.materials)
        return DeltaBeta(deltas[0], deltas[0] * added / sum(map(abs, deltas))) if betas[1:] else prior.materials[0]
    if isinstance(prior, KnownRatio):
        ratio = prior.ratio
    else:
        ratio, _ = FirstVolumes(Folds.of(scan), prior, on_progress).ratio
    delta = estimate_delta(scan, ratio, on_progress, backend, options, prior.delta_sign, prior.two_sided)
    return DeltaBeta(delta, delta / ratio)


def is_plain(light: Light) -> bool:
    """Whether light is even, and its noise white."""
    return light.background is None and light.still is None and not light.noise.has_grain


def plain_light(frames: Tensor, options: LightOptions) -> Light:
    """Even light and white noise."""
    air = options.air_of(frames)
    return Light(air, NoiseModel.of_frames(frames, air), None)


def without_matter(first: FirstVolumes, fold: int, fitted: bool = False) -> Score:
    """The score of even light on the unseen frames of a fold, or on the fitted ones."""
    seen, unseen = first.folds.split(fold)
    scan = seen if fitted else unseen
    return Score.of(scan.left(torch.ones(scan.frames.shape, dtype=torch.float64)))


def lit_by_halves(measured: Tensor, predicted: Tensor, known: Background) -> Tensor:
    """Frames [V, H, W] predicted in even light, in the light that the measured ones have: in each half of a
    checkerboard as the other half says, so that no pixel tells its own."""
    shared = replace(
        known,
        coefficients=known.coefficients[:1].expand(len(measured), -1),
        covariances=known.covariances[:1].expand(len(measured), -1, -1),
        powers=known.powers.mean().expand(len(measured)),
    )
    y, x = np.mgrid[: measured.shape[1], : measured.shape[2]] // CHECKED
    half, lit = torch.from_numpy((x + y) % 2 == 0), predicted.double().clone()
    for part in (half, ~half):
        factor = shared.seen_beside(measured, predicted, part).factor()
        lit[:, ~part] *= factor[:, ~part]
    return lit


def predictions(found: Object, scan: Scan) -> Tensor:
    """Frames [V, H, W] of an object in even light, without the steps between voxels (`BandLimitedVoxels`)."""
    return predicted_frames(scan.exposures, BandLimitedVoxels.of(found) if isinstance(found, VoxelGrid) else found)
