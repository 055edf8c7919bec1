"""Every fitted method goes on bit for bit from a saved state, in a fit made anew with another seed and start."""

from __future__ import annotations

import io
from collections.abc import Callable
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
import torch

from helpers.bumpy import bumpy, surfaces
from helpers.fit_balls import a_cloud, a_scan, fit_of
from helpers.two_balls import NETWORK, ONE, blurred_start, chords, scan
from holosplat.fit.density import DensityControl
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.run import Record
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid
from holosplat.matter import MaterialPrior
from holosplat.methods import SurfaceFit, VoxelFit
from holosplat.methods.method import Task
from holosplat.methods.surface_fit import surface_fit
from holosplat.methods.voxels import voxel_fit
from holosplat.scan import Scan
from holosplat_bench.opponents.fields import NeuralField
from holosplat_bench.opponents.neural_fields import NeuralFit, warmed_up, waves_fit

VALIDATED = {"validation_views": 1, "validate_every": 3}


def gaussians(seed: int) -> Fit:
    """Density control, minibatches and blocks of volume; the fit that goes on starts from fewer Gaussians."""
    density = DensityControl(every=4, start=0.1, stop=0.9, grow_fraction=0.1, faint=0.02)
    weights = Objective(l1=1.0, ssim=0.2, tv_volume=0.1, overfull=1.0)
    drawn = {"views_per_step": 2, "volume_every": 2, "volume_edge": 8}
    cloud = a_cloud(100 - 40 * seed, seed)
    return fit_of(a_scan(), objective=weights, density=density, seed=seed, cloud=cloud, steps=12, **drawn, **VALIDATED)


def voxels(seed: int) -> Fit:
    measured = scan()
    start = blurred_start(Grid.of_views(measured.views))
    start = start.with_parameters({"values": start.values * (1 - 0.5 * seed)})
    return voxel_fit(measured, start, VoxelFit(steps=12, schedule=Schedule(**VALIDATED)), seed)


def surface(seed: int) -> Fit:
    """Without the prior, whose scale is that of the start, which a checkpoint of a run holds."""
    ball = surfaces(bumpy(2, 5.0 + seed, depth=0.0))
    schedule = Schedule(steps=12, views_per_step=2, **VALIDATED)
    return surface_fit(scan(), ball, SurfaceFit(worth=0.0, stiffness=5.0, curvature=0.0, schedule=schedule), seed)


@cache
def warm(seed: int) -> tuple[Scan, NeuralField, NeuralFit]:
    """Frames, a field that has learnt their thickness, and the options of its fit."""
    measured = scan()
    schedule = Schedule(steps=12, views_per_step=2, decay=0.05, **VALIDATED)
    options = NeuralFit(
        NETWORK, 20 + seed, 500, 0.05, probes=100, margin=1, prune_every=4, empty=0.4, schedule=schedule
    )
    task = Task(measured, MaterialPrior.known(ONE.channels[0]), seed)
    return measured, warmed_up(task, ONE, 1.3 * chords(measured.views).float(), options), options


def neural(seed: int) -> Fit:
    """Random depths and probes, minibatches, and a mask that is pruned."""
    measured, field, options = warm(seed)
    return waves_fit(measured, deepcopy(field), options, seed)


FITS: dict[str, Callable[[int], Fit]] = {f.__name__: f for f in (gaussians, voxels, surface, neural)}


def run(fit: Fit, until: int | None = None) -> list[Record]:
    """Advance the fit; returns its records without the clock."""
    records: list[Record] = []
    fit.run(records.append, until)
    return [{name: value for name, value in record.items() if name != "seconds"} for record in records]


def through_a_file(state: dict) -> dict:
    """The state as a checkpoint gives it back."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def assert_same(first: Fit, second: Fit) -> None:
    """Parameters, results and what else is saved are bit for bit the same."""
    mine, other = first.trainable.leaves, second.trainable.leaves
    assert mine.keys() == other.keys()
    assert all(torch.equal(leaf, other[name]) for name, leaf in mine.items())
    results = [fit.result().parameters() for fit in (first, second)]
    assert all(torch.equal(p, results[1][name]) for name, p in results[0].items())
    assert first.best_step == second.best_step


@pytest.mark.parametrize("method", FITS)
def test_an_interrupted_fit_goes_on_bit_for_bit(method):
    whole = FITS[method](0)
    records = run(whole)
    assert len(records) == 12
    assert sum("val_l1" in record for record in records) == 4
    for stop in (1, 5, 8):
        first = FITS[method](0)
        head = run(first, until=stop)
        state = through_a_file(first.state_dict())
        second = FITS[method](1)
        second.load(state)
        assert second.step == stop
        assert head + run(second) == records
        assert_same(second, whole)


@pytest.mark.parametrize("method", FITS)
def test_a_fit_is_that_of_its_seed_and_start(method):
    first, same, other = (FITS[method](seed) for seed in (0, 0, 1))
    records = [run(fit, until=4) for fit in (first, same, other)]
    assert records[0] == records[1]
    assert_same(first, same)
    assert records[0] != records[2]


@pytest.mark.parametrize("method", FITS)
def test_a_state_kept_in_memory_does_not_change(method):
    fit = FITS[method](0)
    run(fit, until=5)
    state = fit.state_dict()
    records = run(fit)
    for _ in range(2):
        again = FITS[method](1)
        again.load(state)
        assert run(again) == records


def test_the_mask_of_a_field_is_pruned_and_resumed():
    """Voxels that are no longer looked at stay so, without a look at the start's mask."""
    fit = FITS["neural"](0)
    counts = [record["occupied"] for record in run(fit)]
    assert counts[0] == counts[6] > counts[7] == counts[11]
    second, views = FITS["neural"](1), scan().views
    before = second.model.object.kept_samples(views, 0)
    second.load(through_a_file(fit.state_dict()))
    after = second.model.object.kept_samples(views, 0)
    assert len(after.pixel) == len(fit.model.object.samples(views, 0).pixel) < len(before.pixel)
    np.testing.assert_array_equal(second.model.object.mask, fit.model.object.mask)
    assert int(second.model.object.mask.sum()) == counts[-1]
