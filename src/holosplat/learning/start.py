"""A volume to start from, as a trained network guesses it from few views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from ..baselines.rays import frames_of, refined
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..model import Instrument
from ..optics.noise import noise_levels
from ..optics.retrieval import FIXED, Tikhonov, tikhonov
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..ranges import Natural, checked_dataclass
from ..scan import Exposures, Scan
from ..volume import Volume
from .network import COPIES, FINE, THICKNESS, Guess, Taps, coarse, thickness_of
from .weights import Trained, read_weights

RETRIEVAL = Tikhonov(iterations=20, prior=FIXED)
"""Of each frame by itself: a third of the steps of the other starts, as a network mends what is left; with the prior of
the retrievals that it learned from."""
CONTRAST = 0.5
"""Of the contrast's root mean square, in the images."""


def retrieved_thickness(
    frames: Tensor, exposures: Exposures, material: DeltaBeta, missing: Tensor | None = None
) -> Tensor:
    """Projected thickness [V, H, W] [m] of `material` in relative frames [V, H, W], each by itself; missing: pixels
    [V, H, W] bool without a value; errors: those of `tikhonov`."""
    return tikhonov(frames, exposures, *material, options=RETRIEVAL, missing=missing)


def seen_in(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Tensor, Tensor]:
    """The contrast [V, H, W] of a scan, the retrieved thickness of `material` [V, H, W] [smallest pixels], and the
    noise [V].

    Missing pixels have no weight: they show the contrast that the retrieved thickness has there.
    """
    frames, optics = torch.from_numpy(scan.frames), scan.exposures.optical
    thickness = retrieved_thickness(frames, scan.exposures, material, scan.gaps)
    if scan.gaps is not None:
        samples = fringe_sampling(optics)
        frames = torch.where(
            scan.gaps, frames_of(Instrument(optics, samples), refined(thickness.float(), samples), material), frames
        )
    return frames - 1, thickness / scan.views.finest, noise_levels(scan.measured)


def images(contrast: Tensor, thickness: Tensor, noise: Tensor) -> Tensor:
    """The network's images [V, 3, H, W] float32 of views.

    contrast: [V, H, W], relative intensity less one; thickness: [V, H, W], retrieved, in pixels; noise: [V], standard
    deviation of the noise of the contrast.
    """
    rms = contrast.float().square().mean().sqrt().clamp_min(torch.finfo(torch.float16).tiny)
    level = (noise.float() / rms)[:, None, None].expand(contrast.shape)
    return torch.stack([CONTRAST * contrast / rms, THICKNESS * thickness, CONTRAST * level], 1).float()


STAGE = "learned start"
MOST_COLUMNS = 128
"""Pixels across that the network sees, at most: larger frames are binned."""
CLEARLY = 0.75
"""Largest ratio of unexplained parts on larger and smaller pixels: these show shapes better."""
FEWEST = 32
"""Rows and columns of binned frames, at least."""
FEWEST_VIEWS = 3
"""Views of which one can be left out to see what the others say."""


@checked_dataclass
class LearnedStart:
    """Options of a start that a network guesses."""

    weights: str = ""
    """File of the network's weights (default: those of the package, if it has any)."""
    trial_steps: Natural = 300
    """Steps of the fit of Gaussians from every start, before they are compared: those of a whole fit."""
    trial_surfaces: Natural = 100
    """Steps of the fit of surfaces that follow, where matter has one known level."""
    cells: bool = True
    """Whether red cells, where the network knows these alone and beams are two, are also looked for by their shape at
    rest: two views hardly determine shapes. They are one more start to be compared."""

    @property
    def network(self) -> Trained:
        """The network and its card; errors: those of `read_weights`."""
        return read_weights(Path(self.weights)) if self.weights else read_weights()


@dataclass(frozen=True)
class Guessed:
    """The guess of a network.

    values: [Z, Y, X] float32, occupancy from 0 to 1
    grid: its voxels, of a pixel of the (binned) frames
    images, taps: what the network saw
    """

    values: Tensor
    grid: Grid
    images: Tensor
    taps: Taps

    def left(self, factor: int = 1) -> float:
        """The `unexplained` part of the volume on pixels `factor` times larger."""
        return unexplained(self.values, self.images, self.taps, factor)


def guess_matter(scan: Scan, material: DeltaBeta, network: Guess, on_progress: Progress) -> Guessed:
    """The occupancy of `material` that `network` guesses from the frames of `scan`.

    The network knows bodies of some pixels across. So frames are shown on pixels of two sizes, and the larger ones are
    taken where they explain the retrieved thickness clearly better, by what they show of it. Errors: those of phase
    retrieval.
    """
    on_progress(STAGE, 0.0)
    factors, found = _factors(scan), list[Guessed]()
    for done, factor in enumerate(factors):
        found.append(_on_pixels(scan.binned(factor) if factor > 1 else scan, material, network))
        on_progress(STAGE, (done + 1) / len(factors))
    finer, *coarser = found
    if coarser and coarser[0].left() < CLEARLY * finer.left(factors[1] // factors[0]):
        return coarser[0]
    return finer


@dataclass(frozen=True)
class GuessedMatter:
    """The guess of a network as matter, to be stored and shown.

    volume: δ and β; spread: [Z, Y, X] float32, standard deviation of occupancy in several guesses; of_copies: whether
    these are of copies of the scene, not without one of the views each
    """

    volume: Volume
    spread: np.ndarray
    of_copies: bool

    @classmethod
    def of(cls, found: Guessed, material: DeltaBeta, network: Guess) -> GuessedMatter:
        """What `network` guesses of `material`, and where its guesses differ (`spread`)."""
        values = found.values.numpy()
        volume = Volume(values * material.delta, values * material.beta, found.grid)
        return cls(volume, spread(found, network).numpy(), len(found.images) < FEWEST_VIEWS)


def _factors(scan: Scan) -> Sequence[int]:
    """By what frames are binned: as little as the network allows, and twice that where enough is left of them."""
    least = max(1, math.ceil(max(scan.views.shape) / MOST_COLUMNS))
    return [least * times for times in (1, 2) if times == 1 or min(scan.views.shape) >= 2 * least * FEWEST]


def _on_pixels(scan: Scan, material: DeltaBeta, network: Guess) -> Guessed:
    seen, views, grid = _shown(scan, material)
    taps = Taps.of(grid, views)
    with torch.inference_mode():
        values = torch.sigmoid(network(seen, taps)[1])
    return Guessed(values.clone(), grid.divided((FINE, FINE, FINE)), seen, taps)


def missing_thickness(values: Tensor, seen: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
    """The thickness [V, H, W] in images [V, 3, 2H, 2W] that occupancy [2Z, 2Y, 2X] does not explain, and all of it."""
    thickness = avg_pool2d(seen[:, 1:2], FINE)[:, 0]
    return thickness - thickness_of(coarse(values).flatten(), taps), thickness


def unexplained(values: Tensor, seen: Tensor, taps: Taps, factor: int = 1) -> float:
    """Root mean square of the missing thickness over that of all of it, on pixels `factor` times larger."""
    left, there = (float(avg_pool2d(part, factor).norm()) for part in missing_thickness(values, seen, taps))
    return left / max(there, torch.finfo(torch.float32).tiny)


def spread(found: Guessed, network: Guess) -> Tensor:
    """Standard deviation [Z, Y, X] of the guesses of `network` without one of the views each: where it is large, few
    frames determine the matter. Of two views, it is that of guesses of copies of the scene (`COPIES`): where it is
    large, the network guesses matter that the frames do not determine."""
    few = len(found.images) < FEWEST_VIEWS
    with torch.inference_mode():
        guesses = _of_copies(found, network) if few else _without_each(found, network)
        return torch.stack(guesses).std(0).clone()


def _without_each(found: Guessed, network: Guess) -> list[Tensor]:
    every = torch.arange(len(found.images))
    rest = [every[every != left_out] for left_out in every]
    return [torch.sigmoid(network(found.images[some], found.taps.part(some))[1]) for some in rest]


def _of_copies(found: Guessed, network: Guess) -> list[Tensor]:
    guesses = [network(copy.images(found.images), copy.taps(found.taps))[1] for copy in COPIES]
    return [torch.sigmoid(copy.back(guess)) for copy, guess in zip(COPIES, guesses)]


def _shown(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Views, Grid]:
    """The network's images [V, 3, 2H, 2W], the views of H × W pixels twice as large, and the lattice in them.

    Odd frames get a row or a column of air more. Of holes in a medium, contrast is shown with the opposite sign: that
    of bodies of the same shape, to first order, of which networks learn.
    """
    contrast, thickness, noise = seen_in(scan, material)
    views = scan.views
    (h, w), more = views.shape, [n % FINE for n in views.shape]
    seen = images(material.sign * contrast, thickness, noise)
    seen = pad(seen, (0, more[1], 0, more[0]))
    whole = views.cropped(slice(0, h + more[0]), slice(0, w + more[1]))
    large = replace(whole, shape=(seen.shape[2] // FINE, seen.shape[3] // FINE), pitch=FINE * views.pitch)
    return seen, large, Grid.of_views(large)
