"""Voxels and neural fields through the waves: fits of two balls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.two_balls import BETA, DELTA, NETWORK, ONE, blurred_start, chords, error, misfit_of, scan, truth
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import VoxelFit, Voxels
from holosplat.methods.method import Progress, Task, quiet, run_quietly
from holosplat.representations import VoxelGrid
from holosplat.scan import Scan
from holosplat_bench.opponents.fields import NeuralField
from holosplat_bench.opponents.neural_fields import NeuralFit, NeuralStage, visual_hull, warmed_up

KNOWN, UNKNOWN = MaterialPrior.known(ONE.channels[0]), MaterialPrior.unknown()
ROUGH = Objective(l1=0.0, spectral=1.0, floor=0.3)


def fit_voxels(measured: Scan, start: VoxelGrid, options: VoxelFit, on_progress: Progress = quiet) -> VoxelGrid:
    """What the stages behind the start make of `start`."""
    task, found = Task(measured.train(), KNOWN if start.matter.single else UNKNOWN, 0, on_progress), start
    for stage in Voxels(fit=options).stages()[1:]:
        fit = stage.fit(task, stage.start(task, found))
        assert fit is not None
        found = run_quietly(fit, task.report(stage.name), VoxelGrid)
    return found


def fit_neural(
    measured: Scan, matter: Matter, thickness: Tensor, options: NeuralFit, seed: int, on_progress: Progress = quiet
) -> NeuralField:
    """A field that learned the thickness, and then went through the waves."""
    stage = NeuralStage(options)
    task = Task(measured.train(), KNOWN if matter.single else UNKNOWN, seed, on_progress)
    start = warmed_up(task, matter, thickness, options)
    fit = stage.fit(task, start)
    return start if fit is None else run_quietly(fit, task.report(stage.name), NeuralField)


# --- voxels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("photons", [None, 5000.0])
def test_voxels_agree_better_with_holograms_and_truth_than_their_start(photons):
    measured = scan(photons)
    grid = Grid.of_views(measured.views)
    start, seen = blurred_start(grid), []
    # Fringes fill these small frames and pass for noise; a smoother total variation gets there from so far in 60 steps.
    options = VoxelFit(noise_weight=3.0 if photons else 0.0, objective=ROUGH, smoothing=0.02)
    found = fit_voxels(measured, start, options, lambda stage, done: seen.append((stage, done)))
    assert misfit_of(measured, found) < (0.15 if photons else 0.01) * misfit_of(measured, start)
    assert error(found.voxelise(grid).delta, grid) < (0.4 if photons else 0.3)
    assert error(start.voxelise(grid).delta, grid) > 0.7
    assert float(found.values.min()) >= 0
    assert float(found.values.max()) <= 1
    again = fit_voxels(measured, start, options)
    assert torch.equal(found.values, again.values)
    assert [f for _, f in seen] == pytest.approx([k / 60 for k in range(1, 61)])


def test_two_channels_are_fitted_without_an_upper_bound_and_finer_than_pixels():
    measured = scan()
    grid = Grid.of_views(measured.views)
    matter = Matter.free(0.7 * DELTA, BETA)
    start = VoxelGrid(2.5 * blurred_start(grid, matter).values, grid, matter)
    found = fit_voxels(measured, start, VoxelFit(steps=30, refine=2, noise_weight=0.0, objective=ROUGH))
    assert found.grid.shape == tuple(2 * n for n in grid.shape)
    assert misfit_of(measured, found) < 0.6 * misfit_of(measured, start)
    assert float(found.values[0].max()) > 1.2  # the material's δ is set too low
    assert not torch.equal(found.values[0], found.values[1])


def test_coarse_voxels_come_first_and_help_a_poor_start():
    measured = scan()
    grid = Grid.of_views(measured.views)
    start, stages = VoxelGrid(torch.zeros(1, *grid.shape), grid, ONE), []
    options = VoxelFit(steps=6, refine=2, noise_weight=0.0)
    plain = fit_voxels(measured, start, options)
    found = fit_voxels(measured, start, replace(options, coarse_steps=40), lambda stage, done: stages.append(stage))
    assert misfit_of(measured, found) < 0.5 * misfit_of(measured, plain)
    assert found.grid == plain.grid
    assert stages == sorted(stages, key=stages.index)
    assert len(set(stages)) == 2


def test_more_total_variation_makes_flatter_voxels():
    measured = scan(2000.0)
    start = blurred_start(Grid.of_views(measured.views))
    flat, rough = (fit_voxels(measured, start, VoxelFit(0, 20, w, 0.0)).values for w in (1.0, 0.0))
    assert float(flat.diff(dim=3).abs().sum()) < 0.7 * float(rough.diff(dim=3).abs().sum())


def test_test_frames_are_not_looked_at():
    measured = scan()
    frames = measured.frames.copy()
    frames[5] = 7.0
    is_test = np.arange(6) == 5
    start = blurred_start(Grid.of_views(measured.views))
    scans = (replace(measured, is_test=is_test), replace(measured, frames=frames, is_test=is_test))
    first, second = (fit_voxels(s, start, VoxelFit(steps=3)).values for s in scans)
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


@pytest.mark.parametrize("matter", [ONE, Matter.free(DELTA, BETA)], ids=["one", "free"])
def test_fields_agree_better_with_holograms_and_truth_after_the_waves(matter):
    measured = scan(count=5)
    grid = Grid.of_views(measured.views)
    thickness = torch.nn.functional.avg_pool2d(0.7 * chords(measured.views).float(), 5, 1, 2)
    still = Schedule(steps=0, views_per_step=1, decay=0.05)
    weights = {"rate": 0.03, "noise_weight": 0.0, "probes": 200}
    short = NeuralFit(NETWORK, 30, 1500, **weights, prune_every=25, schedule=still)
    full = replace(short, schedule=replace(still, steps=50))
    stages: list[str] = []
    start = fit_neural(measured, matter, thickness, short, 1)
    found = fit_neural(measured, matter, thickness, full, 1, lambda stage, done: stages.append(stage))
    voxels = [VoxelGrid(f.values(grid), grid, matter) for f in (start, found)]
    assert misfit_of(measured, voxels[1]) < 0.1 * misfit_of(measured, voxels[0])
    errors = [error(f.voxelise(grid).delta, grid) for f in (start, found)]
    assert errors[1] < 0.6 < errors[0]
    assert (stages.count(stages[0]), stages.count(stages[-1])) == (30, 50)


def test_fields_are_reproducible_by_seed_and_stop_in_time():
    measured = scan(count=3)
    thickness = chords(measured.views).float()
    schedule = Schedule(steps=5, views_per_step=2, decay=0.05)
    options = NeuralFit(NETWORK, warmup_steps=5, probes=50, prune_every=2, schedule=schedule)
    grid = Grid.of_views(measured.views)
    first, same, other = (fit_neural(measured, ONE, thickness, options, seed).values(grid) for seed in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    steps: list[float] = []
    hurried = replace(options, warmup_steps=100_000, schedule=replace(schedule, steps=100_000, seconds=0.4))
    fit_neural(measured, ONE, thickness, hurried, 1, lambda stage, done: steps.append(done))
    assert 2 <= len(steps) < 10_000


def test_interrupts_pass():
    measured = scan(count=2)
    start = blurred_start(Grid.of_views(measured.views))

    def stop(stage: str, done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_voxels(measured, start, VoxelFit(steps=3), stop)
    with pytest.raises(KeyboardInterrupt):
        fit_neural(measured, ONE, chords(measured.views).float(), NeuralFit(NETWORK), 0, stop)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VoxelFit(steps=0), "steps must be at least 1"),
        (lambda: VoxelFit(weight=-1.0), "weight must not be negative"),
        (lambda: VoxelFit(smoothing=0.0), "smoothing must be a positive number"),
        (lambda: VoxelFit(schedule=Schedule(views_per_step=2)), "voxels need views_per_step = 0"),
        (lambda: NeuralFit(rate=0.0), "rate must be a positive number"),
        (lambda: NeuralFit(warmup_steps=0, schedule=Schedule(steps=0)), "a fit needs steps"),
        (lambda: fit_neural(scan(count=2), ONE, torch.zeros(2, 9, 9), NeuralFit(), 0), "thickness must have the shape"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
