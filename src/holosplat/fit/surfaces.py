"""Closed surfaces fitted to holograms: Adam on vertices, in the smooth coordinates of a membrane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from torch import Tensor

from ..checks import InputError, at_least, positive, require
from ..geometry import Poses
from ..memory import memory_kept
from ..model.instrument import Instrument
from ..optics.noise import noise_levels, noise_share
from ..optics.sampling import resolving_oversample
from ..representations.isosurface import adjacency, neighbour_mean
from ..representations.surfaces import SurfaceMesh
from ..scan import Scan

STAGE = "surfaces"
BETAS = (0.9, 0.99)
SMALLEST_ROUNDING = 1e-6
"""Of the misfit at zero, in units of the frames' range."""
FARTHEST = 1e6
"""Coordinates beyond this many pixels, and those that are no numbers, are a fit that diverged."""

Progress = Callable[[str, float, dict[str, float]], None]
"""Called with (stage, fraction done, record of the step)."""


@dataclass(frozen=True)
class SurfaceFit:
    """Options of `fit_surfaces`.

    steps: gradient steps, each on all training views; rate: length of the first steps [pixels], of which `decay` is
    left at the last (exponential); stiffness: how far a vertex draws its neighbours along, λ of Nicolet et al. (2021);
    smoothness: weight of the energy of bending (see `fit_surfaces`), which grows by `noise_gain` times the share of
    the frames' contrast that is noise; rounding: of the misfit at zero, in standard deviations of the noise;
    oversample: wave samples a pixel (0: one more than the fit of Gaussians takes, see `Schedule`).
    """

    steps: int = 100
    rate: float = 0.2
    decay: float = 0.1
    stiffness: float = 10.0
    smoothness: float = 1.0
    noise_gain: float = 3.0
    rounding: float = 3.0
    oversample: int = 0

    def __post_init__(self) -> None:
        at_least(self, 0, "steps", "stiffness", "smoothness", "noise_gain", "rounding", "oversample")
        positive("rate", self.rate, "pixels")
        require(0 < self.decay <= 1, f"decay must lie in (0, 1], but it is {self.decay:g}.")


def fit_surfaces(
    scan: Scan,
    start: SurfaceMesh,
    options: SurfaceFit = SurfaceFit(),
    on_progress: Progress = lambda stage, fraction, record: None,
) -> SurfaceMesh:
    """The surfaces that explain the training frames of `scan`, from `start` on, of the same triangles.

    Minimised is the mean over pixels and views of `√(r² + c²) - c`, r the difference of frames in units of the
    training frames' range and c the rounding, plus smoothness · Σ |L² x|² / (pixels of a frame), x the vertices in
    pixels and L x their distance from the mean of their neighbours. Steps are Adam's in the coordinates (1 + λΔ) x,
    one length for all vertices (Nicolet, Jacobson & Jakob 2021, "Large steps in inverse rendering of geometry",
    section 3). Errors: `InputError` without training frames, or where vertices are no longer numbers.
    """
    train = scan.train()
    require(np.ptp(train.frames) > 0, "all training frames are constant, so there is nothing to fit.")
    misfit = _Misfit(train, oversampling(train, options))
    rounding = max(SMALLEST_ROUNDING, options.rounding * misfit.noise)
    descent = _Descent(start, options)
    weight = options.smoothness * (1 + options.noise_gain * noise_share(misfit.frames)) / misfit.frames[0].numel()
    with memory_kept():
        for step in range(options.steps):
            vertices = descent.vertices.requires_grad_()
            loss = misfit(start.replaced(vertices), rounding)
            loss.backward()
            assert vertices.grad is not None
            bending = descent.advance(vertices.grad, weight)
            if not bool((descent.vertices.abs() < FARTHEST).all()):
                raise InputError(f"the fit of surfaces diverged at step {step + 1}; lower its rate.")
            record = {"step": step + 1.0, "loss": loss.item() + bending, "bending": bending}
            on_progress(STAGE, (step + 1) / options.steps, record)
    return start.replaced(descent.vertices)


def oversampling(scan: Scan, options: SurfaceFit = SurfaceFit()) -> int:
    """Wave samples along a pixel at which surfaces are fitted and judged: their edges are sharper than Gaussians'."""
    return options.oversample or resolving_oversample(scan.exposures, 1.5, at_least=1) + 1


class _Misfit:
    """Rounded L1 of a scan's frames; `noise`: its standard deviation in units of the frames' range."""

    def __init__(self, train: Scan, oversample: int) -> None:
        self.frames = torch.from_numpy(train.frames)
        self._span = float(np.ptp(train.frames))
        self._instrument = Instrument(train.exposures, oversample)
        self._poses = Poses.of(self._instrument.views)
        self.noise = float(noise_levels(self.frames).mean()) / self._span

    def __call__(self, surfaces: SurfaceMesh, rounding: float) -> Tensor:
        predicted = self._instrument.frames(surfaces.project(self._poses))
        residual = (predicted - self.frames) / self._span
        return ((residual.square() + rounding**2).sqrt() - rounding).mean()


class _Descent:
    """Vertices and their Adam state; one step takes the gradient through the membrane's inverse."""

    def __init__(self, start: SurfaceMesh, options: SurfaceFit) -> None:
        faces, count = start.faces.numpy(), len(start.vertices)
        edges = adjacency(faces, count)
        laplacian = diags_array(edges.sum(1)) - edges
        self._solve = splu(csc_array(eye_array(count) + options.stiffness * laplacian)).solve
        away = csr_array(eye_array(count) - neighbour_mean(faces, count))
        self._bending = csr_array(away @ away)
        self.vertices = start.vertices.detach().clone()
        self._options, self._step = options, 0
        self._first, self._second = torch.zeros_like(self.vertices), 0.0

    def advance(self, gradient: Tensor, weight: float) -> float:
        """One step against `gradient` and that of the bending energy, of which it returns the value."""
        options = self._options
        bent = self._bending @ self.vertices.detach().numpy()
        slope = gradient.numpy() + 2 * weight * (self._bending.T @ bent)
        smooth = torch.from_numpy(self._solve(slope))
        rate = options.rate * options.decay ** (self._step / max(1, options.steps - 1))
        self._step += 1
        self._first = BETAS[0] * self._first + (1 - BETAS[0]) * smooth
        self._second = BETAS[1] * self._second + (1 - BETAS[1]) * float(smooth.square().max())
        first, second = (m / (1 - b**self._step) for m, b in zip((self._first, self._second), BETAS))
        self.vertices = self.vertices.detach() - rate * first / (second**0.5 + 1e-30)
        return float(weight * np.square(bent).sum())
