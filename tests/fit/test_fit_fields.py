"""Voxels and neural fields through the waves: the misfit, the minimiser, and fits of two balls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from holosplat.fit.neural import NeuralFit, fit_neural, visual_hull
from holosplat.fit.voxels import VoxelFit, fit_voxels
from holosplat.fit.waves import WaveMisfit, linear_response

from holosplat.checks import InputError
from holosplat.fit.projected_gradient import spectral_projected_gradient
from holosplat.geometry import Grid, Views
from holosplat.model import Instrument
from holosplat.optics.noise import noise_level
from holosplat.representations import Encoding, Matter, Network, VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

PIXEL, DELTA, BETA = 1e-6, 1e-6, 1e-9
BALLS = (((-5.0, 2.0, 3.0), 4.0), ((4.0, -3.0, -2.0), 5.0))
"""Centres `(x, y, z)` and radii of the truth [pixels]."""
NETWORK = Network(Encoding(levels=3, features=2, coarsest=8.0, finest=2.0, log2_size=12), hidden=16, layers=1)


def quiet(stage: str, fraction: float) -> None:
    """No report."""


def chords(views: Views) -> torch.Tensor:
    """Thickness of the balls [V, H, W] [m] on the pixel centres of `views`."""
    h, w = views.shape
    total = np.zeros((len(views), h, w))
    x, y = ((np.arange(n) + 0.5 - 0.5 * n) * views.pixel_size for n in (w, h))
    for centre, radius in BALLS:
        at = views.rotations @ (np.array(centre) * PIXEL)
        apart = (y[:, None] - at[:, 1, None, None]) ** 2 + (x - at[:, 0, None, None]) ** 2
        total += 2 * np.sqrt(np.clip((radius * PIXEL) ** 2 - apart, 0, None))
    return torch.from_numpy(total)


def scan(photons: float | None = None, count: int = 6) -> Scan:
    """Frames of 25 × 28 pixels of the two balls, from waves four times finer."""
    exposures = Exposures.of(Views.evenly_spaced(count, (25, 28), PIXEL), 15.0, 0.12)
    instrument = Instrument(exposures, 4, torch.float64)
    frames = instrument.frames(LineIntegrals(chords(instrument.views)[:, None], ((DELTA, BETA),))).numpy()
    if photons:
        frames = np.random.default_rng(1).poisson(frames * photons) / photons
    return Scan(frames.astype(np.float32), exposures, np.zeros(count, dtype=bool))


def truth(grid: Grid) -> torch.Tensor:
    """The balls' occupancy [Z, Y, X], sampled at voxel centres."""
    x, y, z = (axis / PIXEL for axis in grid.axes())
    inside = [
        (z[:, None, None] - c) ** 2 + (y[:, None] - b) ** 2 + (x - a) ** 2 < r**2 for (a, b, c), r in BALLS
    ]  # fmt: skip
    return torch.from_numpy(np.any(inside, axis=0).astype(np.float32))


def error(found: np.ndarray, grid: Grid) -> float:
    """Relative error of δ/DELTA."""
    true = truth(grid).numpy()
    return float(np.linalg.norm(found / DELTA - true) / np.linalg.norm(true))


def misfit_of(measured: Scan, found: VoxelGrid) -> float:
    """Σ misfit of an object, by the same measure for all."""
    judge = WaveMisfit(measured, DELTA, BETA, 0.3)
    with torch.no_grad():
        return float(judge(found.project(judge.instrument.views)).sum())


def blurred_start(grid: Grid, channels: int = 1) -> VoxelGrid:
    """Half of the truth, smeared out."""
    smeared = torch.nn.functional.avg_pool3d(truth(grid)[None, None], 5, stride=1, padding=2)[0]
    return VoxelGrid(0.5 * smeared.repeat(channels, 1, 1, 1), grid, DELTA, BETA)


# --- the misfit ---------------------------------------------------------------------------------------------


def test_the_misfit_of_the_truth_is_small_and_views_stand_alone():
    measured = scan()
    misfit = WaveMisfit(measured, DELTA, BETA, 0.3, oversample=4)
    lines = LineIntegrals(chords(misfit.instrument.views)[:, None].float(), ((DELTA, BETA),))
    nothing = LineIntegrals(torch.zeros_like(lines.channels), lines.materials)
    assert float(misfit(lines).max()) < 1e-5 * float(misfit(nothing).min())
    index = torch.tensor([4, 1])
    part = LineIntegrals(nothing.channels[index], lines.materials)
    assert torch.allclose(misfit(part, index), misfit(nothing)[index])


def test_the_misfit_is_in_pixels_of_thickness():
    """A faint object whose shape is a wave of response H, below the first maximum: ½ Σ (H T)² / (H² + floor²)."""
    measured = scan(count=1)
    views = measured.views
    frames = np.ones_like(measured.frames)
    misfit = WaveMisfit(replace(measured, frames=frames), DELTA, BETA, 0.3)
    instrument = misfit.instrument
    response = linear_response(measured.exposures, BETA / DELTA)[0, 0, 5]
    depth = 1e-3
    columns = torch.arange(instrument.views.shape[1]) - instrument.margin[1] * instrument.oversample + 0.5
    wave = torch.cos(2 * torch.pi * 5 / 28 / instrument.oversample * columns)
    lines = (depth * PIXEL * wave).expand(1, 1, *instrument.views.shape)
    expected = 0.25 * views.shape[0] * views.shape[1] * (depth * response) ** 2 / (response**2 + 0.3**2)
    assert float(misfit(LineIntegrals(lines, ((DELTA, BETA),)))) == pytest.approx(float(expected), rel=0.05)


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_noise_is_measured_between_shapes(sigma):
    generator = torch.Generator().manual_seed(0)
    shapes = torch.zeros(4, 61, 80)
    shapes[:, 20:40, 20:50] = 1.0
    noisy = shapes + sigma * torch.randn(shapes.shape, generator=generator)
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.2)
    assert noise_level(shapes) == 0


# --- the minimiser ------------------------------------------------------------------------------------------


def test_the_minimiser_finds_the_bounded_minimum():
    """A quadratic with a condition number of 1e3: bounded values sit on their bounds, free ones at the minimum."""
    scale = torch.logspace(0, 3, 30, dtype=torch.float64)
    target = torch.linspace(-0.5, 1.5, 30, dtype=torch.float64)
    seen = []

    def evaluate(x: torch.Tensor) -> tuple[float, torch.Tensor]:
        seen.append(x)
        return 0.5 * float((scale * (x - target) ** 2).sum()), scale * (x - target)

    found = spectral_projected_gradient(evaluate, torch.full_like(target, 0.5), 1.0, 80, lambda f: None)
    assert torch.allclose(found, target.clamp(0, 1), atol=1e-6)
    assert len(seen) == 80
    assert all(float(x.min()) >= 0 and float(x.max()) <= 1 for x in seen)


def test_the_minimiser_returns_the_best_point_and_refuses_nonsense():
    values = iter([3.0, 2.0, 4.0, float("nan"), 2.5])
    seen = []

    def evaluate(x: torch.Tensor) -> tuple[float, torch.Tensor]:
        seen.append(x)
        return next(values), torch.ones_like(x)

    found = spectral_projected_gradient(evaluate, torch.ones(2), float("inf"), 5, lambda f: None)
    assert torch.equal(found, seen[1])
    with pytest.raises(InputError, match="no finite value"):
        spectral_projected_gradient(lambda x: (float("nan"), x), torch.ones(2), 1.0, 3, lambda f: None)


# --- voxels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("photons", [None, 5000.0])
def test_voxels_agree_better_with_holograms_and_truth_than_their_start(photons):
    measured = scan(photons)
    grid = Grid.of_views(measured.views)
    start, seen = blurred_start(grid), []
    # Fringes fill these small frames and pass for noise; a smoother total variation gets there from so far in 60 steps.
    options = VoxelFit(noise_weight=3.0 if photons else 0.0, floor=0.3, smoothing=0.02)
    found = fit_voxels(measured, start, options, lambda stage, done: seen.append((stage, done)))
    assert misfit_of(measured, found) < (0.15 if photons else 0.01) * misfit_of(measured, start)
    assert error(found.voxelise(grid).delta, grid) < (0.4 if photons else 0.3)
    assert error(start.voxelise(grid).delta, grid) > 0.7
    assert float(found.values.min()) >= 0
    assert float(found.values.max()) <= 1
    again = fit_voxels(measured, start, options, quiet)
    assert torch.equal(found.values, again.values)
    assert len(seen) == 59
    assert [f for _, f in seen] == sorted(f for _, f in seen)


def test_two_channels_are_fitted_without_an_upper_bound_and_finer_than_pixels():
    measured = scan()
    grid = Grid.of_views(measured.views)
    start = VoxelGrid(2.5 * blurred_start(grid, 2).values, grid, 0.7 * DELTA, BETA)
    found = fit_voxels(measured, start, VoxelFit(steps=30, refine=2, noise_weight=0.0, floor=0.3), quiet)
    assert found.grid.shape == tuple(2 * n for n in grid.shape)
    assert misfit_of(measured, found) < 0.6 * misfit_of(measured, start)
    assert float(found.values[0].max()) > 1.2  # the material's δ is set too low
    assert not torch.equal(found.values[0], found.values[1])


def test_coarse_voxels_come_first_and_help_a_poor_start():
    measured = scan()
    grid = Grid.of_views(measured.views)
    start, stages = VoxelGrid(torch.zeros(1, *grid.shape), grid, DELTA, BETA), []
    options = VoxelFit(steps=6, refine=2, noise_weight=0.0)
    plain = fit_voxels(measured, start, options, quiet)
    found = fit_voxels(measured, start, replace(options, coarse_steps=40), lambda stage, done: stages.append(stage))
    assert misfit_of(measured, found) < 0.5 * misfit_of(measured, plain)
    assert found.grid == plain.grid
    assert stages == sorted(stages, key=stages.index)
    assert len(set(stages)) == 2


def test_more_total_variation_makes_flatter_voxels():
    measured = scan(2000.0)
    start = blurred_start(Grid.of_views(measured.views))
    flat, rough = (fit_voxels(measured, start, VoxelFit(0, 20, w, 0.0), quiet).values for w in (1.0, 0.0))
    assert float(flat.diff(dim=3).abs().sum()) < 0.7 * float(rough.diff(dim=3).abs().sum())


def test_test_frames_are_not_looked_at():
    measured = scan()
    frames = measured.frames.copy()
    frames[5] = 7.0
    is_test = np.arange(6) == 5
    start = blurred_start(Grid.of_views(measured.views))
    scans = (replace(measured, is_test=is_test), replace(measured, frames=frames, is_test=is_test))
    first, second = (fit_voxels(s, start, VoxelFit(steps=3), quiet).values for s in scans)
    assert torch.equal(first, second)


# --- neural fields ------------------------------------------------------------------------------------------


def test_the_hull_holds_the_truth_and_little_else():
    views = scan().views
    grid = Grid.of_views(views)
    hull = visual_hull(chords(views).float(), views, grid, 0.05)
    matter = truth(grid) > 0
    assert bool(hull[matter].all())
    assert int(hull.sum()) < 4 * int(matter.sum())
    with pytest.raises(InputError, match="no matter in common"):
        visual_hull(chords(views).float(), views, grid, 2.0)


@pytest.mark.parametrize("matter", [Matter(DELTA, BETA), Matter(DELTA, BETA, channels=2)], ids=["one", "two"])
def test_fields_agree_better_with_holograms_and_truth_after_the_waves(matter):
    measured = scan(count=5)
    grid = Grid.of_views(measured.views)
    thickness = torch.nn.functional.avg_pool2d(0.7 * chords(measured.views).float(), 5, 1, 2)
    short = NeuralFit(NETWORK, 30, 1500, 0, rate=0.03, noise_weight=0.0, probes=200, prune_every=25)
    full = replace(short, steps=50)
    stages: list[str] = []
    start = fit_neural(measured, matter, thickness, short, 1, quiet)
    found = fit_neural(measured, matter, thickness, full, 1, lambda stage, done: stages.append(stage))
    voxels = [VoxelGrid(f.values(grid), grid, DELTA, BETA) for f in (start, found)]
    assert misfit_of(measured, voxels[1]) < 0.1 * misfit_of(measured, voxels[0])
    errors = [error(f.voxelise(grid).delta, grid) for f in (start, found)]
    assert errors[1] < 0.6 < errors[0]
    assert (stages.count(stages[0]), stages.count(stages[-1])) == (30, 50)


def test_fields_are_reproducible_by_seed_and_stop_in_time():
    measured = scan(count=3)
    thickness = chords(measured.views).float()
    options = NeuralFit(NETWORK, warmup_steps=5, steps=5, probes=50, views_per_step=2, prune_every=2)
    grid = Grid.of_views(measured.views)
    first, same, other = (
        fit_neural(measured, Matter(DELTA, BETA), thickness, options, seed, quiet).values(grid) for seed in (1, 1, 2)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    steps: list[float] = []
    hurried = replace(options, warmup_steps=100_000, steps=100_000, seconds=0.4)
    fit_neural(measured, Matter(DELTA, BETA), thickness, hurried, 1, lambda stage, done: steps.append(done))
    assert 2 <= len(steps) < 10_000


def test_interrupts_pass():
    measured = scan(count=2)
    start = blurred_start(Grid.of_views(measured.views))

    def stop(stage: str, done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_voxels(measured, start, VoxelFit(steps=3), stop)
    with pytest.raises(KeyboardInterrupt):
        fit_neural(measured, Matter(DELTA, BETA), chords(measured.views).float(), NeuralFit(NETWORK), 0, stop)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VoxelFit(steps=0), "steps must be at least 1"),
        (lambda: VoxelFit(weight=-1.0), "weight must not be negative"),
        (lambda: VoxelFit(smoothing=0.0), "smoothing must be positive"),
        (lambda: VoxelFit(floor=0.0), "floor must be positive"),
        (lambda: NeuralFit(rate=0.0), "rate must be positive"),
        (lambda: NeuralFit(rate_left=2.0), "rate_left must lie in"),
        (lambda: NeuralFit(warmup_steps=0, steps=0), "a fit needs steps"),
        (lambda: NeuralFit(views_per_step=0), "views_per_step must be at least 1"),
        (lambda: WaveMisfit(scan(count=1), -1e-6, 0.0, 0.3), "δ > 0"),
        (lambda: WaveMisfit(scan(count=1), DELTA, 0.0, 0.0), "floor must be positive"),
        (
            lambda: fit_neural(scan(count=2), Matter(DELTA, BETA), torch.zeros(2, 9, 9), NeuralFit(), 0, quiet),
            "thickness must have the shape",
        ),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
