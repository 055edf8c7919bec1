"""Residuals of measured frames by spatial frequency and view, what would explain them, and validation frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..checks import finite, require
from ..frames import evenly, rfft_weights
from ..memory import memory_kept
from ..model import Alignment, Instrument, LightField, Model, smooth_modes
from ..ranges import Weight, checked_dataclass
from ..scan import Exposures, Scan
from ..volume import LineIntegrals, Object
from .terms import comparisons

COMMON = ("mass", "absorption", "distance", "blur", "shift_x", "shift_y")
"""Changes that all views share, whose effect on frames is measured."""
LIGHT_ORDER = 2
"""Half waves along each side of the frame, at most, of the light that a residual is compared with."""
MOST_PROBED = 16
"""Views whose frames are differentiated, at most, evenly chosen: enough for a cause that all views share."""
STEP = 0.02
"""Relative change of matter and distance in finite differences."""
STEP_PX = 0.2
"""Change of shifts [pixels] in finite differences."""
STEP_BLUR = 0.1
"""Change of the point-spread function's variance [pixels²] in finite differences."""
SMALLEST = 1e-30
"""Power that is divided by at least."""


@dataclass(frozen=True)
class Rings:
    """The plane of spatial frequencies of frames [h, w] in bands of an octave.

    band: [h, w//2 + 1] number of the band of each coefficient of `rfft2`
    weight: [h, w//2 + 1] how many coefficients of the full transform it stands for
    edges: [B + 1] frequencies [1/m] between the bands, on the smallest pixels where they differ; the first band holds
        the mean of the frame and what has one period along its longer side, the last one the corners
    """

    band: Tensor
    weight: Tensor
    edges: np.ndarray

    @classmethod
    def of(cls, shape: tuple[int, int], pixel: float) -> Rings:
        """Bands of frames of `shape` with pixels of pitch `pixel` [m]: octaves down from the Nyquist frequency."""
        h, w = shape
        radius = torch.hypot(torch.fft.fftfreq(h, pixel)[:, None].double(), torch.fft.rfftfreq(w, pixel)[None].double())
        nyquist, lowest = 0.5 / pixel, 1.001 / (max(shape) * pixel)
        corner = float(radius.max())
        inner = [nyquist / 2**k for k in range(32) if nyquist / 2**k > 1.5 * lowest][::-1]
        edges = np.array([0.0, lowest, *inner, *([corner] if inner and corner > 1.0001 * nyquist else [])])
        band = torch.bucketize(radius, torch.from_numpy(edges[1:-1] * (1 + 1e-9)))
        held = torch.bincount(band.flatten(), minlength=len(edges) - 1) > 0  # frames of few rows leave bands empty
        edges, band = np.append(edges[:-1][held.numpy()], edges[-1]), (held.cumsum(0) - 1)[band]
        return cls(band, torch.from_numpy(rfft_weights(w)).expand(h, -1), edges)

    def __len__(self) -> int:
        return len(self.edges) - 1

    @property
    def counts(self) -> np.ndarray:
        """[B] coefficients of one frame in each band."""
        return np.bincount(self.band.flatten().numpy(), self.weight.flatten().numpy(), len(self))

    def mean(self, power: Tensor) -> np.ndarray:
        """[V, B] mean over each band of `power` [V, h, w//2 + 1]."""
        weighted = (power * self.weight).flatten(1).numpy()
        band = self.band.flatten().numpy()
        return np.stack([np.bincount(band, row, len(self)) for row in weighted]) / self.counts

    def spread(self, values: np.ndarray) -> Tensor:
        """[V, h, w//2 + 1] of values [V, B]: each coefficient has its band's."""
        return torch.from_numpy(values)[:, self.band]

    def periods(self, band: int) -> tuple[float, float]:
        """Shortest and longest period [m] in `band`; the longest of the first one is infinite."""
        low, high = self.edges[band], self.edges[band + 1]
        return 1 / high, (1 / low if low else float("inf"))


@dataclass(frozen=True)
class Probe:
    """Scalar products of one view's residual with the changes that might explain it, weighed by the power they may
    have anyway.

    gram: [P, P] of the changes with each other, P = 6 (`COMMON`) + (`LIGHT_ORDER` + 1)²
    product: [P] of the changes with the residual
    """

    gram: np.ndarray
    product: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """Mean powers (of `rfft2` with norm "ortho") by view and band, and probes of what might explain the residual.

    rings: the B bands
    residual: [V, B] of measured minus predicted frames
    contrast: [V, B] of measured frames minus one
    noise: [V, B] of the frames' noise
    sampling: [V, B] of the error of the model's own sampling
    allowed: [V, B] what a residual may have
    probes: of the views `probed` [K]
    """

    rings: Rings
    residual: np.ndarray
    contrast: np.ndarray
    noise: np.ndarray
    sampling: np.ndarray
    allowed: np.ndarray
    probed: np.ndarray
    probes: tuple[Probe, ...]


@checked_dataclass
class Allowance:
    """What a residual may have beside noise, for no model is exact."""

    contrast: Weight = 0.05
    """Share of the contrast (rms) in each band: bodies with sharp edges are fitted to 0.03 to 0.045."""
    rough: Weight = 0.15
    """Share of the contrast of all bands (rms) at periods shorter than `resolved`, where voxels are rougher than
    frames."""
    resolved: Weight = 4.0
    """Shortest period that pixels resolve well [pixels]."""
    negligible: Weight = 0.01
    """Share of the contrast of all bands (rms) that one band may miss, however little it has itself."""

    def power(self, contrast: np.ndarray, rings: Rings, pixel: float) -> np.ndarray:
        """[B] power that a residual of frames with `contrast` [V, B] may have, beside noise and sampling.

        pixel: the frames' pitch [m].
        """
        mean, counts = contrast.mean(axis=0), rings.counts
        total = float((mean * counts).sum())
        own = self.contrast**2 * mean + self.negligible**2 * total / counts
        resolved = rings.edges[1:] * pixel * self.resolved < 1.01
        return np.where(resolved, own, own + self.rough**2 * total / counts.sum())


@dataclass(frozen=True)
class Prediction:
    """The predictions of V frames; each is computed at its first use, so that the waves of one are held at a time.

    object: the matter
    exposures: the V planned exposures
    oversample: wave samples a pixel
    alignment, light: of the V exposures, on the CPU; None for none
    backend: of the wave optics, resolved
    """

    object: Object
    exposures: Exposures
    oversample: int
    alignment: Alignment | None = None
    light: LightField | None = None
    backend: str = "cpu"

    def view(self, i: int, finer: int = 1) -> Model:
        """The model of the exposure `i` alone, on waves `finer` times finer."""
        instrument = Instrument(self.exposures[[i]], finer * self.oversample, backend=self.backend)
        on = instrument.device
        alignment = self.alignment and Alignment(**{n: p[[i]].to(on) for n, p in self.alignment.parameters().items()})
        light = self.light and LightField(self.light.coefficients[[i]].to(on), self.light.modes.to(on))
        return Model(self.object, instrument, alignment, light)


def residuals(
    said: Prediction,
    measured: Tensor,
    noise: Tensor,
    allowance: Allowance = Allowance(),
    missing: Tensor | None = None,
) -> Residuals:
    """The residuals of a prediction of `measured` frames [V, h, w], whose noise has the power `noise` [V, h, w//2 + 1].

    The power is that of `rfft2` with norm "ortho", in which white noise of variance s² has s². The sampling's error is
    the difference from waves sampled twice as finely, taken in the probed views; the others have their neighbour's.
    missing: pixels [V, h, w] bool without a value; the others stand for them. Errors: `InputError` where
    frames do not fit the exposures, or predicted ones are not finite.
    """
    views, count = said.exposures.views, len(said.exposures)
    wanted = (count, *views.shape)
    require(
        tuple(measured.shape) == wanted,
        f"measured frames must have the shape {wanted} of the exposures, but they have {tuple(measured.shape)}.",
    )
    rings = Rings.of(views.shape, views.finest)
    probed = evenly(count, MOST_PROBED)
    spectra, sampling, changes = list[Tensor](), list[Tensor](), list[Tensor]()
    for i in range(count):
        one = said.view(i)
        with torch.no_grad(), memory_kept():
            predicted = one.frames().double().cpu()
            finite("predicted frames", predicted.numpy())
            if i in probed:
                changes.append(_changes(one))
                sampling.append(_power(said.view(i, 2).frames().double().cpu() - predicted))
        left = measured[i : i + 1].double().cpu() - predicted
        if missing is not None:
            without = missing[i : i + 1]
            left = left.masked_fill(without, 0.0) / math.sqrt(max(1 - float(without.float().mean()), 1 / left.numel()))
        spectra.append(_transform(left))
    spectrum, nearest = torch.cat(spectra), np.abs(np.arange(count)[:, None] - probed).argmin(axis=1)
    contrast, known = rings.mean(_power(measured.double().cpu() - 1)), rings.mean(noise.double().cpu())
    sampled = rings.mean(torch.cat(sampling))[nearest]
    allowed = known + sampled + allowance.power(contrast, rings, views.finest)
    weight = rings.weight / rings.spread(allowed).clamp_min(SMALLEST)
    probes = tuple(_probe(change, spectrum[i], weight[i]) for i, change in zip(probed, changes))
    return Residuals(rings, rings.mean(_squared(spectrum)), contrast, known, sampled, allowed, probed, probes)


def _changes(one: Model) -> Tensor:
    """[P, h, w//2 + 1] derivatives of one view's frame, transformed: by each of `COMMON`, and by modes of the light.

    Mass and absorption by a relative change of δ and β, and of β alone; distance by a relative change; blur by the
    variance of the point-spread function [pixels²]; shifts of the detector [pixels]; light by a factor's modes. The
    first four explain nothing of frames that waves do not make.
    """
    exposures, time, on = one.instrument.exposures, float(one.instrument.times[0]), one.instrument.device
    planned = one.alignment or Alignment()
    lines, light = one.lines(time), 1.0 if one.light is None else one.light.factor()
    distance = planned.optical_distance(exposures)
    distance = torch.from_numpy(exposures.optical.distance).to(on) if distance is None else distance
    sigma = planned.psf_sigma_px(exposures)
    sigma = torch.from_numpy(exposures.psf_sigma_px).to(on) if sigma is None else sigma

    def seen(matter: LineIntegrals = lines, z: Tensor = distance, s: Tensor = sigma) -> Tensor:
        return (one.instrument.frames(matter, None, z, s) * light).double().cpu()

    def of(delta: float, beta: float) -> LineIntegrals:
        return LineIntegrals(lines.channels, tuple((d * delta, b * beta) for d, b in lines.materials))

    def shifted(x: float, y: float) -> Tensor:
        moved = torch.tensor([[x, y]], dtype=torch.float64).to(on)
        shifts = moved if planned.shifts is None else planned.shifts + moved
        return replace(one, alignment=replace(planned, shifts=shifts)).frames().double().cpu()

    here, more = seen() if one.by_waves else one.frames().double().cpu(), 1 + STEP
    waves = (
        [
            (seen(of(more, more)) - here) / STEP,
            (seen(of(1.0, more)) - here) / STEP,
            (seen(z=distance * more) - here) / STEP,
            (seen(s=(sigma.square() + STEP_BLUR).sqrt()) - here) / STEP_BLUR,
        ]
        if one.by_waves
        else [here.new_zeros(here.shape)] * 4
    )
    found = [
        *waves,
        (shifted(STEP_PX, 0.0) - here) / STEP_PX,
        (shifted(0.0, STEP_PX) - here) / STEP_PX,
    ]
    modes = smooth_modes((here.shape[1], here.shape[2]), LIGHT_ORDER).double()
    return _transform(torch.cat([*found, modes * here]))


def _probe(changes: Tensor, residual: Tensor, weight: Tensor) -> Probe:
    whole = torch.cat([changes, residual[None]]).flatten(1) * weight.flatten().sqrt()
    products = (whole @ whole.conj().T).real.numpy()
    return Probe(products[:-1, :-1], products[:-1, -1])


def _transform(frames: Tensor) -> Tensor:
    return torch.fft.rfft2(frames, norm="ortho")


def _squared(spectrum: Tensor) -> Tensor:
    return spectrum.real.square() + spectrum.imag.square()


def _power(frames: Tensor) -> Tensor:
    return _squared(_transform(frames))


class Judge:
    """Scores a model on frames that the fit does not see. low, span: the affine map that takes frames to [0, 1]."""

    COLUMNS = ("val_l1", "val_ssim", "val_frcm")

    def __init__(self, frames: Scan, instrument: Instrument, low: float, span: float) -> None:
        """instrument: of the exposures of `frames`."""
        self.scan, self._instrument, self._low, self._span = frames, instrument, low, span

    def __call__(self, model: Model) -> tuple[float, dict[str, float]]:
        """The score, smaller is better, and the columns of metrics.csv.

        It is that of SSIM and FRCM, not of L1, which prefers a blurred object to one with its fringes misplaced.
        """
        with torch.no_grad():
            predicted = replace(model, instrument=self._instrument, alignment=None, light=None).frames().cpu()
        a, b = ((f - self._low) / self._span for f in (predicted, torch.from_numpy(self.scan.frames)))
        ssim, frcm = (1 - float(term(a, b).mean()) for term in (comparisons.one_minus_ssim, comparisons.one_minus_frcm))
        columns = {"val_l1": float(comparisons.l1(a, b).mean()), "val_ssim": ssim, "val_frcm": frcm}
        return 1 - 0.5 * (ssim + frcm), columns


def split_validation(train: Scan, count: int) -> tuple[Scan, Scan]:
    """Training frames without, and only, `count` evenly spread validation frames; `InputError` if none is left."""
    require(
        count < len(train),
        f"validation_views must leave a training frame: {count} of {len(train)} are asked for.",
    )
    chosen = set_aside(len(train), count)
    return train[np.flatnonzero(~chosen)], train[np.flatnonzero(chosen)]


def set_aside(frames: int, count: int) -> np.ndarray:
    """Which of so many training frames `split_validation` sets aside, [V] bool."""
    chosen = np.zeros(frames, dtype=bool)
    if count > 0:
        chosen[((np.arange(count) + 0.5) * frames / count).astype(int)] = True
    return chosen
