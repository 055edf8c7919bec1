"""Phase retrieval of single views: closed forms, gradients, and a contract that every method keeps.

Frames of bodies come from the float64 reference optics on a raster finer than any method's, of thicknesses in closed
form. Distances are given by `at(lambda_z)`, the distance [m] at which λz has that many squared pitches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.retrieval import (
    BETA,
    CELL_BETA,
    CELL_DELTA,
    DELTA,
    DOUBLE,
    PITCH,
    K,
    _squared_distance,
    at,
    exposures,
    gaussian,
    pixels,
    taken,
)
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.optics import sampling
from holosplat.optics.retrieval import (
    ADMM,
    RETRIEVALS,
    Linear,
    Prior,
    Tikhonov,
    admm,
    bounded_estimate,
    paganin,
    tikhonov,
)
from holosplat.optics.retrieval.model import WaveModel
from holosplat.optics.retrieval.nonlinear import (
    _laplacian,
    descend,
    gradient,
    gradient_adjoint,
    objective,
    penalty_weights,
)
from holosplat.scan import Exposures
from holosplat_bench.opponents import alternating
from holosplat_bench.opponents.alternating import (
    Projections,
    gerchberg_saxton,
    hybrid_input_output,
    through_detector,
)


def bodies(views: Views, radius_px: float = 8.0) -> Tensor:
    """Thickness [H, W] in metres of a ball and a flat ellipsoid beside it."""
    x, y = pixels(views)
    total = torch.zeros(views.shape, dtype=DOUBLE)
    for centre, flatness in (((-11.3, 5.2), 1.0), ((10.4, -6.7), 0.4)):
        inside = (radius_px * PITCH) ** 2 - _squared_distance(x, y, centre)
        total = total + 2 * flatness * inside.clamp_min(0).sqrt()
    return total


def noisy(frames: Tensor, photons: float, seed: int = 0) -> Tensor:
    """Counts over their mean."""
    counts = torch.poisson(frames * photons, generator=torch.Generator().manual_seed(seed))
    return counts / photons


def relative_error(found: Tensor, truth: Tensor) -> float:
    """Root mean square of the difference over that of the truth."""
    return float((found.double() - truth).norm() / truth.norm())


# --- through the waves --------------------------------------------------------------------------------------


def model_of(psf: float = 0.6, lambda_z: float = 12.0, ratio: float = 0.01, photons: float = 500.0) -> WaveModel:
    """Of noisy frames of the bodies, float64, at two distances."""
    where = exposures((33, 41), np.array([at(lambda_z), at(lambda_z / 2)]), psf, count=2)
    frames = noisy(taken(lambda v: bodies(v, 6.0), where, DELTA, ratio * DELTA)[1], photons)
    return WaveModel(frames, where, ratio, None)


@pytest.mark.parametrize("lambda_z", [12.0, 0.9])
def test_the_objectives_gradient(lambda_z):
    """Against central differences, along random directions; at λz = 0.9/2 with two samples to the pixel."""
    waves = model_of(lambda_z=lambda_z)
    assert waves.oversample == (1 if lambda_z > 5 else 2)
    weights = penalty_weights(waves, 1.0)
    generator = torch.Generator().manual_seed(3)
    phase = waves.phase + 0.2 * torch.rand(waves.phase.shape, dtype=DOUBLE, generator=generator)
    _, slope = objective(waves, phase, weights)
    for _ in range(3):
        way = torch.randn(phase.shape, dtype=DOUBLE, generator=generator)
        ahead, behind = (objective(waves, phase + s * 1e-5 * way, weights)[0] for s in (1, -1))
        expected = (slope * way).sum(dim=(1, 2))
        assert torch.allclose((ahead - behind) / 2e-5, expected, rtol=1e-6, atol=1e-9)


def test_every_step_lowers_the_objective():
    waves = model_of()
    phase, values = descend(waves, Tikhonov(iterations=30), lambda fraction: None)
    assert bool((values[1:] <= values[:-1]).all())
    assert bool((values[-1] < 0.8 * values[0]).all())
    assert float(phase.min()) >= 0
    assert float((phase * (1 - waves.support)).abs().max()) == 0


def test_the_estimate_keeps_its_means_on_a_finer_raster():
    waves = model_of(lambda_z=0.9, photons=1e9)
    where = waves.exposures
    estimate = bounded_estimate(waves.frames, where, 0.01, None)
    inside = waves.thickness(waves.phase, DELTA) * K * DELTA
    assert relative_error(inside, estimate.phase) < 0.02  # what bounds cut off


@pytest.mark.parametrize("shape", [(7, 9), (8, 12)])
def test_slopes_and_their_adjoint(shape):
    generator = torch.Generator().manual_seed(2)
    images = torch.randn(3, *shape, dtype=DOUBLE, generator=generator)
    slopes = torch.randn(2, 3, *shape, dtype=DOUBLE, generator=generator)
    assert float((gradient(images) * slopes).sum()) == pytest.approx(float((images * gradient_adjoint(slopes)).sum()))
    by_spectrum = torch.fft.irfft2(torch.fft.rfft2(images) * _laplacian(shape), s=shape)
    assert torch.allclose(gradient_adjoint(gradient(images)), by_spectrum, atol=1e-12)


def test_projection_on_the_amplitude_never_wraps():
    """A phase of 30 rad whose frame is the measured one is a fixed point; a wrapped one would come back below π."""
    where = exposures((61, 75), at(3.0))
    truth, frames = taken(lambda v: gaussian(v, 400e-6, 12.0, (0.0, 0.0)), where, DELTA, 0.002 * DELTA)
    waves = WaveModel(frames, where, 0.002, 0.0)
    phase = gaussian(where.views.padded(waves.margin), 30.0, 12.0, (0.0, 0.0))[None]
    assert float(truth.max()) * K * DELTA == pytest.approx(float(phase.max()), rel=0.02)
    waves.amplitude = waves.image(phase).sqrt()
    assert torch.allclose(through_detector(waves, phase), phase, atol=1e-9)
    nearly = phase + gaussian(where.views.padded(waves.margin), 0.3, 4.0)[None]
    assert float((through_detector(waves, nearly) - phase).abs().max()) < 0.35


def test_projection_on_one_material(monkeypatch):
    """Where only the amplitude is found wrong, by `exp(-r Δ)`, the nearest phase is `φ + r² Δ / (1 + r²)`."""
    waves, ratio, change = model_of(ratio=0.5), 0.5, 0.2
    gain = torch.full(waves.phase.shape, math.exp(-ratio * change), dtype=DOUBLE)
    monkeypatch.setattr(alternating, "_gain", lambda model, phase: gain)
    phase = torch.full_like(waves.phase, 3.0)
    expected = 3.0 + ratio**2 * change / (1 + ratio**2)
    assert torch.allclose(through_detector(waves, phase), torch.full_like(phase, expected), atol=1e-12)


def test_reduction_brings_amplitudes_nearer():
    """Gerchberg–Saxton reduces the error (Fienup 1982, section III), up to its bounds' part in it."""
    waves = model_of(psf=0.0)
    before = waves.misfit(waves.phase)[0]
    phase = waves.phase
    for _ in range(20):
        phase = waves.bounded(through_detector(waves, phase))
    assert bool((waves.misfit(phase)[0] < 0.9 * before).all())


def test_feedback_makes_the_difference_to_error_reduction():
    where = exposures((33, 41))
    frames = noisy(taken(lambda v: bodies(v, 6.0), where)[1], 2000.0)
    without = hybrid_input_output(frames, where, DELTA, BETA, options=Projections(iterations=9, feedback=0.0))
    reduced, hybrid = (
        f(frames, where, DELTA, BETA, options=Projections(iterations=9))
        for f in (gerchberg_saxton, hybrid_input_output)
    )
    assert not torch.equal(reduced, hybrid)
    assert not torch.equal(without, hybrid)


# --- every method -------------------------------------------------------------------------------------------


METHODS = pytest.mark.parametrize("name", RETRIEVALS)

CLEAN = dict(zip(RETRIEVALS, (0.29, 0.12, 0.04, 0.028, 0.04, 0.042)))
"""Bounds of the relative error of a ball and an ellipsoid without noise: about a fourth above what is found."""
NOISY = dict(zip(RETRIEVALS, (0.95, 0.62, 0.16, 0.19, 0.1, 0.14)))
"""The same with 2000 photons a pixel. The second exposure, at half the distance, has half the contrast."""


@pytest.fixture(scope="module")
def ball() -> tuple[Exposures, Tensor, Tensor]:
    """Two exposures, the bodies' thickness and frames: holographic, 0.5 µm pixels, the second at half the distance."""
    where = exposures(distance=np.array([at(24.8), at(12.4)]), count=2)
    return where, *taken(bodies, where)


@pytest.fixture(scope="module")
def found(ball) -> Callable[[str, float | None], Tensor]:
    """What a method finds in these frames with so many photons, in single precision; found once."""
    where, _, frames = ball

    @cache
    def retrieved(name: str, photons: float | None) -> Tensor:
        seen = frames if photons is None else noisy(frames, photons)
        return RETRIEVALS[name](seen.float(), where, DELTA, BETA)

    return retrieved


@METHODS
@pytest.mark.parametrize("photons", [None, 2000.0])
def test_bodies_are_found(name, photons, ball, found):
    assert relative_error(found(name, photons), ball[1]) < (CLEAN if photons is None else NOISY)[name]


@METHODS
def test_blurred_frames(name):
    """A point-spread function of 0.7 px, and one of 0.2 px in the second exposure, are known and undone."""
    sharp = exposures((49, 59), np.array([at(24.8), at(12.4)]), count=2)
    where = replace(sharp, psf_sigma_px=np.array([0.7, 0.2]))
    truth, frames = taken(bodies, where)
    told = relative_error(RETRIEVALS[name](frames.float(), where, DELTA, BETA), truth)
    untold = relative_error(RETRIEVALS[name](frames.float(), sharp, DELTA, BETA), truth)
    assert told < untold


@pytest.mark.parametrize("name", [name for name in RETRIEVALS if name not in ("paganin", "ctf")])
def test_the_waves_beat_the_filters(name, ball, found):
    """Paganin's plain filter is the least that the others must beat, by a factor of two here."""
    where, truth, frames = ball
    plain = paganin(frames, where, DELTA, BETA, options=Linear(noise=0.0))
    assert relative_error(found(name, None), truth) < 0.5 * relative_error(plain, truth)


@METHODS
def test_negative_contrast_of_absorption(name):
    """Cells in plasma: β < 0, a phase of a fiftieth of a radian, λz = 62 squared pitches."""
    where = exposures(distance=at(62.0))
    truth, frames = taken(bodies, where, CELL_DELTA, CELL_BETA)
    found = RETRIEVALS[name](frames.float(), where, CELL_DELTA, CELL_BETA)
    assert relative_error(found, truth) < (0.65 if name in ("paganin", "ctf") else 0.2)


@METHODS
def test_each_view_is_on_its_own(name, monkeypatch):
    """One by one, all at once, or as many at a time as memory is meant for: the same, and the same again."""
    where = exposures((33, 41), np.array([at(12.0), at(6.0)]), count=2)
    retrieve, frames = RETRIEVALS[name], noisy(taken(lambda v: bodies(v, 6.0), where)[1], 2000.0).float()
    together = retrieve(frames, where, DELTA, BETA)
    assert together.shape == frames.shape
    assert together.dtype == frames.dtype
    assert torch.equal(together, retrieve(frames, where, DELTA, BETA))
    scale = float(together.abs().max())
    for v in range(2):
        alone = retrieve(frames[v : v + 1], where[[v]], DELTA, BETA)
        assert float((alone[0] - together[v]).abs().max()) < 0.01 * scale
    monkeypatch.setattr(sampling, "MOST_SAMPLES", 1)
    assert float((retrieve(frames, where, DELTA, BETA) - together).abs().max()) < 0.01 * scale


@METHODS
def test_single_precision_suffices(name):
    where = exposures((35, 45))
    truth, frames = taken(bodies, where)
    seen = noisy(frames, 2000.0)
    single, double = (RETRIEVALS[name](images, where, DELTA, BETA) for images in (seen.float(), seen))
    assert double.dtype == DOUBLE
    assert relative_error(single, truth) == pytest.approx(relative_error(double, truth), abs=0.01)


@METHODS
def test_nothing_is_found_in_empty_frames(name):
    where = exposures((31, 45))
    assert float(RETRIEVALS[name](torch.ones(1, 31, 45), where, DELTA, BETA).abs().max()) < 1e-9
    noise = noisy(torch.ones(1, 31, 45, dtype=DOUBLE), 1e4).float()
    assert float(RETRIEVALS[name](noise, where, DELTA, BETA).abs().mean()) < 0.3e-6  # a twentieth of a cell


@METHODS
def test_matter_may_leave_the_frame(name):
    """A body across the border is found to be there, and its other half does not wrap around to the far side."""
    where = exposures((63, 75))
    truth, frames = taken(lambda v: bodies(v, 8.0) + gaussian(v, 4e-6, 5.0, (37.0, 12.0)), where)
    found = RETRIEVALS[name](frames.float(), where, DELTA, BETA)
    assert float(found[0, 40:48, :4].abs().mean()) < 0.5e-6
    assert relative_error(found, truth) < 0.75


@METHODS
@pytest.mark.parametrize("size", [1e-4, 1.0])
def test_holes_are_found_as_bodies_are(name, size):
    """Frames of holes are those of bodies of the opposite contrast to first order, and so is their thickness; beyond
    it, the waves tell them apart, and holes are found as well as bodies."""
    where = exposures((33, 41), np.array([at(6.0)]), 0.6)
    found = []
    for sign in (1, -1):
        truth, frames = taken(lambda v: bodies(v, 6.0), where, sign * size * DELTA, sign * size * BETA)
        found.append(RETRIEVALS[name](frames, where, sign * size * DELTA, sign * size * BETA))
        assert float(found[-1].mean()) > 0
        assert size < 1 or relative_error(found[-1], truth) < 0.9
    if size < 1:
        assert relative_error(found[1], found[0].double()) < 0.02


@METHODS
def test_progress_is_told(name):
    seen: list[float] = []
    RETRIEVALS[name](torch.ones(2, 15, 17), exposures((15, 17), count=2), DELTA, BETA, on_progress=seen.append)  # type: ignore[call-arg]
    assert seen[0] == 0
    assert seen == sorted(seen)
    assert seen[-1] <= 1


@METHODS
def test_bad_input_is_named(name):
    retrieve, where, frames = RETRIEVALS[name], exposures((15, 17)), torch.ones(1, 15, 17)
    with pytest.raises(InputError, match="differs from its medium in δ, but δ is 0"):
        retrieve(frames, where, 0.0, BETA)
    with pytest.raises(InputError, match="frames must have the shape"):
        retrieve(torch.ones(2, 15, 17), where, DELTA, BETA)
    with pytest.raises(InputError, match="float32 or float64"):
        retrieve(torch.ones(1, 15, 17, dtype=torch.int32), where, DELTA, BETA)
    with pytest.raises(InputError, match="finite"):
        retrieve(frames * math.nan, where, DELTA, BETA)


@pytest.mark.parametrize("options", [Linear, Tikhonov, Projections, ADMM])
def test_bad_options_are_named(options):
    with pytest.raises(InputError, match="noise must not be negative"):
        options(noise=-0.1)


def test_bad_numbers_of_options():
    for make in (lambda: Tikhonov(iterations=0), lambda: ADMM(iterations=0), lambda: Projections(iterations=0)):
        with pytest.raises(InputError, match="iterations"):
            make()
    with pytest.raises(InputError, match="decay"):
        Prior(decay=0.0)
    with pytest.raises(InputError, match="feedback"):
        Projections(feedback=-1.0)
    assert tikhonov is RETRIEVALS["tikhonov"]
    assert admm is RETRIEVALS["admm"]


@pytest.mark.parametrize(("radius_px", "count", "lambda_z", "most"), [(2.5, 40, 0.6, 0.2), (14.0, 2, 25.0, 0.1)])
def test_bounds_tell_what_noise_hides_of_a_frame(radius_px, count, lambda_z, most):
    """Of many small balls, bounds know the lowest frequencies better than noisy frames do; of thick ones, frames do."""
    where, delta = exposures((61, 84), at(lambda_z)), 0.4 / (K * radius_px * PITCH)
    places = np.random.default_rng(4).uniform(-1, 1, (count, 2)) * (26.0, 18.0)

    def balls(views: Views) -> Tensor:
        x, y = pixels(views)
        inside = ((radius_px * PITCH) ** 2 - _squared_distance(x, y, tuple(place)) for place in places)
        return sum((2 * one.clamp_min(0).sqrt() for one in inside), start=torch.zeros(views.shape, dtype=DOUBLE))

    truth, frames = taken(balls, where, delta, delta / 2800)
    true, seen = truth * K * delta, (noisy(frames, 1e4), where, 1 / 2800, None)
    found, once = bounded_estimate(*seen), bounded_estimate(*seen, lacking=True)
    assert relative_error(found.phase, true) < min(most, 0.9 * relative_error(once.phase, true))
    assert once.lacks == 0
    if radius_px < 5:  # where noise, and not the linear model, is what hides the phase
        assert float(found.lacks) == pytest.approx(float((once.phase - true).square().mean()), rel=0.3)


def test_bounds_tell_nothing_of_matter_that_edges_cut():
    """A rod through the frame, from one edge to the other."""
    where, radius = exposures((61, 84), at(3.0)), 8 * PITCH
    delta = 1.0 / (K * 2 * radius)

    def rod(views: Views) -> Tensor:
        x, y = pixels(views)
        return 2 * (radius**2 - (x + 0.3 * y) ** 2).clamp_min(0).sqrt()

    truth, frames = taken(rod, where, delta, delta / 2800)
    seen = noisy(frames, 1e4), where, 1 / 2800, None
    once, unknown, within = (
        relative_error(bounded_estimate(*seen, **told).phase, truth * K * delta)
        for told in ({"lacking": True}, {}, {"leaves": (False, False)})
    )
    assert unknown < 1.02 * once < within


def test_the_penalty_expects_what_the_estimate_lacks():
    """Twice the power is half the penalty; it is that of the frequencies of a disc, π/4 of all."""
    waves = model_of()
    waves.lacks = torch.zeros(len(waves.phase), dtype=DOUBLE)
    alone = penalty_weights(waves, 1e-3)
    (h, w), pixels_of_raster = waves.exposures.views.shape, math.prod(waves.raster.shape) / waves.oversample**2
    waves.lacks = waves.phase.square().mean(dim=(1, 2)) * pixels_of_raster / (h * w) * 4 / math.pi
    assert torch.allclose(penalty_weights(waves, 1e-3), 0.5 * alone, rtol=0.1)
