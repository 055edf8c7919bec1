"""How likely frames are under constants of the experiment: the likeliest volume of coarse frames within a support.

Without a support, a wrong distance or ratio δ/β leaves halos of faint matter about the body, which explain the frames
as well; where space is known to be empty, they do not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import field, replace
from typing import Annotated, cast

import numpy as np
import torch
from scipy.ndimage import binary_dilation, label
from torch import Tensor

from ..baselines import HolographicTV, holographic_tv
from ..baselines.beyond import margins_of
from ..baselines.tomography import plateau
from ..checks import require
from ..fit.residuals import set_aside
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem, descend
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..inference import Decision, Score, select
from ..matter import DeltaBeta, Matter
from ..memory import memory_kept
from ..optics.coherence import joined_blur_px
from ..optics.noise import NoiseModel
from ..optics.sampling import fringe_sampling
from ..ranges import MOST, Natural, Share, Within, checked_dataclass
from ..representations import VoxelGrid
from ..scan import Scan
from .method import Task, quiet

UNIT_DELTA = 1e-6
"""Size of the δ of an occupancy of one; any value does, for occupancies have no bound."""

SPECK = 27
"""Voxels of which a connected piece of matter has at least, or it may be noise: a cube of three."""
FEW_SPECKS = 0.1
"""Share of all matter up to which such pieces are taken for noise; if they hold more, they are matter."""

FEWEST = 3
"""Frames from which on one is predicted from the others."""
UNSEEN = 4
"""One frame in so many is set aside, one at least."""
FIELDS = ("distance", "energy_kev", "bandwidth", "psf_sigma_px")
"""Constants that exposures have under their own names."""

Constants = Mapping[str, float]
"""Values of what is uncertain, by the names of `Uncertain`."""


@checked_dataclass
class ProfileOptions:
    """How the likelihood of constants is computed."""

    width: Annotated[int, Within(16, MOST)] = 64
    """Frames are binned to at most so many pixels [pixels]: a volume of them takes seconds."""
    faint: float = 0.08
    """Part of the matter's level from which on a voxel of the first volume belongs to the support."""
    dilated: int = 2
    """Voxels by which the support is wider, for rims."""
    doubt: Share = 0.01
    """Part of the contrast (rms) that counts as noise besides: without any, a fit would not come to its end."""
    iterations: Natural = 60
    """Iterations of each of two rounds, whose second takes the level of matter from the first. All δ/β share it."""
    start: HolographicTV = field(
        default_factory=lambda: HolographicTV(
            retrieval=40, iterations=100, corrections=2, noisy=1.0, refine=1, upper=0.0
        )
    )
    """The volume that each fit starts from."""
    prior: ContinuousPrior = field(default_factory=lambda: ContinuousPrior(slopes=0.1, values=0.005))
    """What is expected of matter: less than of a volume that is to be looked at, for what is expected pulls constants
    towards those that need fewer slopes; here the support does most."""

    def __post_init__(self) -> None:
        require(0 < self.faint < 1, f"faint must lie between 0 and 1, but it is {self.faint:g}.")


def without_specks(volume: Tensor, inside: np.ndarray) -> np.ndarray:
    """`inside` [Z, Y, X] of a volume [Z, Y, X] without what noise strews over it; no ray would pass beside that."""
    pieces, _ = cast(tuple[np.ndarray, int], label(inside))
    large = np.bincount(pieces.ravel()) >= SPECK
    large[0] = False
    kept = large[pieces]
    lost = float(volume.numpy()[inside & ~kept].sum())
    return kept if lost <= FEW_SPECKS * float(volume.numpy()[inside].sum()) else inside


class Profile:
    """-log of the likelihood of the coarse frames of a task, as a function of constants; the volume is the likeliest.

    ratio: δ/β at the nominal energy, where it is not among the constants; nominal: the constants by which the support
    is found; corners: constants whose fringes may be the finest, or the widest: samples of waves a pixel are those that
    they need, the same for all constants, or the misfit would jump where their number changes.
    """

    def __init__(
        self,
        task: Task,
        ratio: float,
        nominal: Constants,
        corners: Sequence[Constants],
        options: ProfileOptions = ProfileOptions(),
    ) -> None:
        self.options, self._ratio, self._sign = options, ratio, task.prior.delta_sign
        factor = task.scan.largest_binning(math.ceil(max(task.scan.views.shape) / options.width))
        self._scan, self._binned = task.scan.binned(factor), factor
        contrast = torch.from_numpy(self._scan.frames - 1).double().square().mean(dim=(1, 2))
        noise = task.noise.binned(factor)
        white = (noise.white.square() + options.doubt**2 * contrast).sqrt()
        self._noise = NoiseModel(white, noise.grain, noise.width)
        self._energy = self._scan.exposures.reference_energy
        self._beyond = (0, 0)
        self._samples = max(fringe_sampling(self._exposed(c).exposures, voxels=1) for c in [nominal, *corners])
        self._nominal = nominal
        self._begun = dict[tuple[tuple[str, float], ...], Tensor]()
        with memory_kept():
            whole = self._volume(self.frames(nominal))
            self._beyond = margins_of(whole.grid, self._scan.views)
            first = self._placed(whole)
        inside = without_specks(first, (first > options.faint * plateau(first)).numpy())
        self.support = torch.from_numpy(np.asarray(binary_dilation(inside, iterations=max(1, options.dilated))))
        self._peak = plateau(first) / float((first * self.support).sum() / self.support.sum())
        """The level of matter over its mean in the support. The prior's unit must not vary by chance from fit to fit,
        as a plateau does, for the larger it is, the likelier are all slopes."""

    def __len__(self) -> int:
        return len(self._scan)

    def begin(self, constants: Constants) -> None:
        """Begin all further fits with volumes of the δ/β that `constants` have: one that is far off holds fits back."""
        self._nominal = constants
        self._begun.clear()

    def air(self) -> float:
        """Part of all pixels whose rays pass beside the support."""
        problem = VolumeProblem(self.frames({}), self.options.prior, 1.0, self.options.start.backend)
        return float((problem.lines(self.support.float().to(problem.device)) <= 0).double().mean())

    @property
    def noise_share(self) -> float:
        """Noise over the contrast of the coarse frames (rms), 1 at most."""
        contrast = float(np.square(self._scan.frames - 1).mean())
        return min(1.0, math.sqrt(float(self._noise.level.square().mean()) / max(contrast, 1e-30)))

    def frames(self, constants: Constants) -> WhitenedFrames:
        """The misfit of the coarse frames under `constants`."""
        scan = self._exposed(constants)
        ratio = constants.get("delta_beta", self._ratio * ratio_factor(scan, self._energy))
        material = DeltaBeta(self._sign * UNIT_DELTA, self._sign * UNIT_DELTA / ratio)
        backend, samples = self.options.start.backend, self._samples
        return WhitenedFrames(scan, material, self._noise, backend=backend, oversample=samples, beyond=self._beyond)

    def _exposed(self, constants: Constants) -> Scan:
        blur = {"psf_sigma_px": constants["psf_sigma_px"] / self._binned} if "psf_sigma_px" in constants else {}
        return exposed(self._scan, {**constants, **blur})

    def _volume(self, frames: WhitenedFrames) -> VoxelGrid:
        values, grid = holographic_tv(frames.train, frames.material, self.options.start, quiet)
        return VoxelGrid(values[None], grid, Matter.one(*frames.material))

    def _placed(self, whole: VoxelGrid) -> Tensor:
        """A volume with the rows and columns beyond the frames that the first one has."""
        return whole.resampled(Grid.of_views(self._scan.views.padded(self._beyond))).values[0]

    def __call__(self, constants: Constants) -> float:
        """½ χ² and prior of the likeliest volume in the support."""
        return self.fitted(constants)[1]

    def score(self, constants: Constants, unseen: np.ndarray) -> Score:
        """How well the likeliest volume of the other frames predicts the frames `unseen` [V] bool."""
        u, _ = self._of(~unseen).fitted(constants)
        frames = self._of(unseen).frames(constants)
        lines = VolumeProblem(frames, self.options.prior, 1.0, self.options.start.backend).lines(u)
        with torch.no_grad():
            return Score.of(frames.known(frames.amplitudes(lines) - frames.measured))

    def needs(self, name: str, values: Constants) -> Decision | None:
        """Whether frames that are set aside are predicted better with the constant `name` as in `values` than with 0.

        A comparison of `inference.select`, whose null is 0; None for too few frames.
        """
        if len(self) < FEWEST:
            return None
        unseen = set_aside(len(self), max(1, len(self) // UNSEEN))
        scores = {each: self.score({**values, name: at}, unseen) for each, at in (("0", 0.0), (name, values[name]))}
        return select(name, ("0", name), lambda each, _: scores[each], by="frames set aside")

    def _of(self, chosen: np.ndarray) -> Profile:
        part = copy(self)
        part._scan, part._noise = self._scan[np.flatnonzero(chosen)], self._noise[np.flatnonzero(chosen)]
        part._begun = {}
        return part

    def fitted(self, constants: Constants) -> tuple[Tensor, float]:
        """The likeliest volume in the support, and ½ χ² and prior."""
        with memory_kept():
            return self._descended(self.frames(constants), self._start(constants))

    def _start(self, constants: Constants) -> Tensor:
        """What a fit begins with: a volume of the nominal δ/β, which waves between matter and detector depend on less
        than on all others."""
        key = tuple((name, value) for name, value in constants.items() if name != "delta_beta")
        if key not in self._begun:
            nominal = {"delta_beta": self._nominal["delta_beta"]} if "delta_beta" in constants else {}
            frames = self.frames({**constants, **nominal})
            u = (self._placed(self._volume(frames)) * self.support).to(frames.instrument.device)
            self._begun[key], _ = self._descended(frames, u)
        return self._begun[key]

    def _descended(self, frames: WhitenedFrames, u: Tensor) -> tuple[Tensor, float]:
        """The likeliest volume from `u` on, and its objective."""
        if not bool((u > 0).any()):
            return u, frames(torch.zeros(len(frames.field), *frames.field.shape, device=u.device)).value
        level = self._peak * float(u.sum() / self.support.sum())
        problem = VolumeProblem(frames, self.options.prior, level, self.options.start.backend, self.support)
        u, values = descend(problem, u, self.options.iterations)
        return u, values[-1]


def exposed(scan: Scan, constants: Constants) -> Scan:
    """`scan` with the optics that `constants` say, in the pixels it has; δ and β hold at their energy then.

    A detector's blur is in the pixels of the scan, and the source's, its angle times the distance, joins it.
    """
    changes = {name: np.full(len(scan), value) for name, value in constants.items() if name in FIELDS}
    if "source_angle" in constants:
        exposures = replace(scan.exposures, **changes)
        blur = constants["source_angle"] * np.abs(exposures.distance)
        changes["psf_sigma_px"] = joined_blur_px(exposures.psf_sigma_px, blur, exposures.views.pixel_sizes)
    if not changes:
        return scan
    reference = None if "energy_kev" in changes else scan.exposures.reference_kev
    return replace(scan, exposures=replace(scan.exposures, **changes, reference_kev=reference))


def ratio_factor(scan: Scan, energy_kev: float) -> float:
    """δ/β at the energy of `scan` over that at `energy_kev` [keV]: `(E/E₀)²` (see `scan.far_from_edges`)."""
    return (scan.exposures.reference_energy / energy_kev) ** 2
