"""Matter whose δ changes with time: the field of that, its gradient, and a small series of lumps that fade."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.fading_lumps import EVEN, MATTER, SHAPE, TIMES, Fades, drifting, series
from holosplat.checks import InputError
from holosplat.fit.flow_volume import FlowProblem, likelier_fading
from holosplat.fit.smooth_volume import ContinuousPrior
from holosplat.geometry import Grid
from holosplat.io.objects import read_object, write_object
from holosplat.matter import MaterialPrior
from holosplat.methods import SmoothVolume, Task
from holosplat.motion.flow_reconstruction import FlowOptions, FlowSearch, merged
from holosplat.representations import Fading, Flow, Lattice, TimeBasis
from holosplat.representations.flow import fading_factor

QUICK = SmoothVolume(coarser=(), rounds=1, iterations=8)
LATTICE = Lattice.around((SHAPE[1], SHAPE[0], SHAPE[1]), 2)
ENDS = (-2 / 3, 1 / 3)
"""First and last time, from that of the third of four on, in lengths of all times."""


def some(spread: float = 0.5) -> Fading:
    torch.manual_seed(0)
    return Fading(spread * torch.randn(2, *LATTICE.counts, dtype=torch.float64), LATTICE)


def test_a_field_on_voxels_is_that_at_points():
    """Along three different edges; and splines of equal coefficients are one everywhere within the lattice."""
    axes = [torch.linspace(-a, a, n, dtype=torch.float64) for a, n in ((6, 5), (4, 3), (9, 7))]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    fading = some()
    there = fading.at(torch.stack([x, y, z], -1).reshape(-1, 3)).reshape(2, 5, 3, 7)
    assert fading.on(axes).numpy() == pytest.approx(there.numpy())
    even = fading.with_coefficients(torch.ones_like(fading.coefficients))
    assert even.on(axes).numpy() == pytest.approx(1.0)
    assert float(fading_factor(torch.tensor([0.3, -0.4]), 0.5)) == pytest.approx(np.exp(0.15 - 0.1))


def test_gaussians_fade_as_the_field_says():
    """At both ends of the times, and nearly so between; faint ones too."""
    fading, centres = some(), 6 * torch.rand(40, 3, dtype=torch.float64) - 3
    raw = torch.linspace(-8, 1.5, 40, dtype=torch.float64)
    linear, square = fading.of_raw(centres, raw, ENDS)
    before = torch.nn.functional.softplus(raw)
    for later, bound in (*((s, 1e-9) for s in ENDS), (0.2, 0.02), (-0.3, 0.02)):
        found = torch.nn.functional.softplus(raw + later * linear + later**2 * square) / before
        assert found.numpy() == pytest.approx(fading_factor(fading.at(centres), later).numpy(), rel=bound)


def search(scan, spread: float) -> FlowSearch:
    how = FlowOptions(
        volume=QUICK,
        cells=2,
        most_cells=2,
        most_degree=0,
        steps=2,
        iterations=6,
        final=16,
        most_final=16,
        spacing_px=1.0,
        fading=spread,
    )
    return FlowSearch(Task(scan, MaterialPrior.known(MATTER), light=EVEN), MATTER, how)


def test_the_gradient_is_that_of_finite_differences():
    """Of matter that a flow carries at the same time; and steps never make it less likely."""
    scene, scan = series(drifting())
    made = search(scan, 1.0)
    flow = Flow.still(LATTICE, TimeBasis(0, 1, 0), float(TIMES[2]), 3)
    flow = flow.with_parameters({"potential": 3 * torch.randn(1, 3, *LATTICE.counts)})
    frames = [made.frames.whitened(k, 1) for k in range(len(TIMES))]
    problem = FlowProblem(frames, TIMES.tolist(), ContinuousPrior(), 0.5, flow, 1)
    u = torch.from_numpy(scene.at(TIMES[2]).voxelise(Grid.of_views(scan.views)).delta / MATTER.delta).float()
    fading = some(0.3).with_coefficients(some(0.3).coefficients.float())
    leaf, way = fading.coefficients.clone().requires_grad_(), torch.randn_like(fading.coefficients)
    problem.fading_misfit(u, fading.with_coefficients(leaf), flow)
    ends = [problem.fading_misfit(u, fading.with_coefficients(leaf.detach() + s * 0.02 * way), flow) for s in (1, -1)]
    assert leaf.grad is not None
    assert float((leaf.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / 0.04, rel=0.02)
    problem.fade(fading, flow)
    gradient = problem(u + 0.1)[1]()
    step = torch.rand_like(u) - 0.3
    values = [problem(u + 0.1 + s * 1e-2 * step)[0] for s in (1, -1)]
    assert float((gradient * step).sum()) == pytest.approx((values[0] - values[1]) / 2e-2, rel=0.01)
    assert problem.misfit(u)[2] == pytest.approx(problem._still[2].frames(problem._still[2].lines(u)).value)
    _, history = likelier_fading(problem, u, fading, flow, 6, 0.5)
    assert min(history) < 0.97 * history[0]


def error(found: hs.volume.Volume, true: hs.volume.Volume) -> float:
    return float(np.linalg.norm(found.delta - true.delta) / np.linalg.norm(true.delta))


def test_what_fades_is_reconstructed_better_where_it_may(tmp_path):
    """Half of the δ of lumps that drift goes from the first time to the last; on rectangular frames of odd sides."""
    scene, scan = series(drifting(fades=Fades(0.5)), 5000.0)
    grid, errors = Grid.of_views(scan.views), []
    for spread in (0.0, 0.3):
        found = search(scan, spread).solve().object
        errors.append([error(found.at(t).voxelise(grid), scene.at(t).voxelise(grid)) for t in TIMES])
        assert (found.fading is None) == (spread == 0)
    assert np.mean(errors[1]) < 0.88 * np.mean(errors[0])
    assert max(errors[1]) < max(errors[0])
    write_object(tmp_path / "object.h5", found)
    again = read_object(tmp_path / "object.h5")
    assert again.at(TIMES[3]).voxelise(grid).delta == pytest.approx(found.at(TIMES[3]).voxelise(grid).delta, abs=1e-12)


def test_what_fades_in_its_place_is_said_to_change():
    """A flow alone explains little of it; and what neither moves nor fades is said to do neither."""
    _, fading = series(drifting((0.0, 0.0, 0.0), Fades(0.5)), 3000.0)
    _, still = series(drifting((0.0, 0.0, 0.0)), 3000.0)
    for scan, wanted in ((fading, True), (still, False)):
        made = search(scan, 1.0)
        assert made.moves(made.by_itself(merged(scan), "mean")) is wanted


def test_fadings_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="a fading must have coefficients of the shape"):
        Fading(torch.zeros(2, 3, 3, 3), LATTICE)
    with pytest.raises(InputError, match="fading"):
        replace(FlowOptions(), fading=-1.0)
