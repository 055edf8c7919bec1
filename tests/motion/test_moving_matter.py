"""Matter in motion: volumes and flows that frames of several times ask for, by gradients, and on a small series."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers import fading_lumps
from helpers.fading_lumps import EVEN, MATTER, PIXEL, TIMES, series
from holosplat.checks import InputError
from holosplat.fit.flow_volume import FlowProblem, likelier_flow, strain
from holosplat.fit.smooth_volume import ContinuousPrior
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import SmoothVolume, Task
from holosplat.motion.flow_reconstruction import MOTION, STILL, FlowOptions, FlowSearch
from holosplat.motion.timed_frames import merged, of_degree, on_lattice
from holosplat.representations import Flow, Lattice, TimeBasis, VoxelGrid
from holosplat.scan import Scan
from holosplat_bench.specimens.carried import CarriedScene

QUICK = SmoothVolume(coarser=(), rounds=1, iterations=8)


@pytest.fixture(scope="module")
def drifting() -> tuple[CarriedScene, Scan]:
    return series(fading_lumps.drifting())


def search(scan: Scan, **options: object) -> FlowSearch:
    usual = {"cells": 2, "most_degree": 0, "most_cells": 2, "steps": 2, "iterations": 6, "final": 16, "most_final": 24}
    how = FlowOptions(**{**usual, "volume": QUICK, "spacing_px": 1.0, **options})  # pyright: ignore[reportArgumentType]
    return FlowSearch(Task(scan, MaterialPrior.known(MATTER), light=EVEN), MATTER, how)


def error(found: hs.volume.Volume, true: hs.volume.Volume) -> float:
    return float(np.linalg.norm(found.delta - true.delta) / np.linalg.norm(true.delta))


def problem_of(scan: Scan, flow: Flow, noise) -> FlowProblem:
    frames = [WhitenedFrames(scan.at_instant(k), MATTER, noise[k]) for k in range(len(TIMES))]
    return FlowProblem(frames, TIMES.tolist(), ContinuousPrior(), 0.5, flow, 1)


def test_gradients_of_volume_and_flow_are_those_of_finite_differences(drifting):
    scene, scan = drifting
    torch.manual_seed(0)
    flow = Flow.still(Lattice.around((23.0, 19.0, 23.0), 2), TimeBasis(0, 1, 1), float(TIMES[2]), 3, sources=True)
    flow = flow.with_parameters({n: 6 * torch.randn_like(p) for n, p in flow.parameters().items()})
    problem = problem_of(scan, flow, search(scan).frames.noise)
    u = torch.from_numpy(scene.at(TIMES[2]).voxelise(Grid.of_views(scan.views)).delta / MATTER.delta).float() + 0.1
    gradient = problem(u)[1]()
    way = torch.rand_like(u) - 0.3
    ends = [problem(u + s * 1e-2 * way)[0] for s in (1, -1)]
    assert float((gradient * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-2, rel=0.01)
    leaves = {n: p.clone().requires_grad_() for n, p in flow.parameters().items()}
    problem.flow_misfit(u, flow.with_parameters(leaves))
    for name, leaf in leaves.items():
        way, step = torch.randn_like(leaf), 0.05
        moved = [{**flow.parameters(), name: leaf.detach() + sign * step * way} for sign in (1, -1)]
        ends = [problem.flow_misfit(u, flow.with_parameters(one)) for one in moved]
        assert leaf.grad is not None
        assert float((leaf.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.05)


def test_steps_never_make_it_less_likely(drifting):
    scene, scan = drifting
    flow = Flow.still(Lattice.around((23.0, 19.0, 23.0), 2), TimeBasis(0, 1, 0), float(TIMES[2]), 3)
    problem = problem_of(scan, flow, search(scan).frames.noise)
    u = torch.from_numpy(scene.at(TIMES[2]).voxelise(Grid.of_views(scan.views)).delta / MATTER.delta).float()
    found, values = likelier_flow(problem, u, flow, 12)
    assert values[-1] < 0.97 * values[0]
    places = np.stack([e.centre for e in scene.scene.elements]) + TIMES[2] * np.array([4e-6, -2e-6, 3e-6])
    mean = found.velocity(torch.from_numpy(places / PIXEL).float(), 0.5).mean(0).numpy()
    wanted = np.array([4.0, -2.0, 3.0])
    assert mean @ wanted > 0.8 * np.linalg.norm(mean) * np.linalg.norm(wanted)
    assert np.linalg.norm(mean - wanted) < 0.6 * np.linalg.norm(wanted)


def test_a_drift_is_found_and_all_times_are_better_than_each_by_itself():
    """In so few photons that single times hardly show the matter."""
    scene, scan = series(fading_lumps.drifting(), 300.0)
    how = search(scan)
    found, grid = how.solve(), Grid.of_views(scan.views)
    moments = range(len(TIMES))
    own = [
        error(how.by_itself(scan.at_instant(k), "one").voxelise(grid), scene.at(TIMES[k]).voxelise(grid))
        for k in moments
    ]
    together = [error(found.object.at(TIMES[k]).voxelise(grid), scene.at(TIMES[k]).voxelise(grid)) for k in moments]
    assert np.mean(together) < 0.97 * np.mean(own)  # of all times: one of them may be lucky, on one processor alone
    between = error(found.object.at(0.3).voxelise(grid), scene.at(0.3).voxelise(grid))
    assert between < 1.05 * np.mean(own)


def test_where_one_time_shows_nothing_all_of_them_begin(drifting, monkeypatch):
    _, scan = drifting
    how, asked = search(scan), list[str]()
    grid = Grid.of_views(scan.views)
    shown = {"middle time": torch.zeros(1, *grid.shape), "mean of all times": torch.ones(1, *grid.shape)}

    def by_itself(one, name):
        asked.append(name)
        return VoxelGrid(shown[name], grid, Matter.one(*MATTER))

    monkeypatch.setattr(how, "by_itself", by_itself)
    assert bool((how.first().values == 1).all())
    assert asked == ["middle time", "mean of all times"]
    assert "begun with the mean" in how.history[-1]
    shown["middle time"] += 2
    assert bool((how.first().values == 2).all())


def test_a_drift_is_said_to_move(drifting):
    """Though a frame of one time is missing."""
    part = drifting[1][np.delete(np.arange(12), 2)]
    how = search(part)
    assert how.moves(how.by_itself(merged(part), "mean"))


def test_what_stands_still_is_not_said_to_move():
    _, scan = series(fading_lumps.drifting((0.0, 0.0, 0.0)))
    how = search(scan)
    assert not how.moves(how.by_itself(merged(scan), "mean"))
    assert [(one.name, one.choice, one.by) for one in how.decisions] == [(MOTION, STILL, "frames set aside")]


def test_merged_frames_are_means_of_the_times(drifting):
    _, scan = drifting
    mean = merged(scan)
    assert len(mean) == 3
    assert mean.frames == pytest.approx(scan.frames.reshape(4, 3, 19, 23).mean(0), rel=1e-6)
    part = merged(scan[np.arange(11)])
    assert len(part) == 3
    np.testing.assert_array_equal(part.frames[:2], mean.frames[:2])
    assert part.frames[2] == pytest.approx(scan.frames[[2, 5, 8]].mean(0), rel=1e-6)


def test_freer_flows_begin_as_the_ones_before():
    torch.manual_seed(0)
    flow = Flow.still(Lattice.around((23.0, 19.0, 23.0), 2), TimeBasis(0, 1, 1), 0.5, 3, sources=True)
    flow = flow.with_parameters({n: torch.randn_like(p) for n, p in flow.parameters().items()})
    at = 16 * torch.rand(20, 3) - 8
    assert torch.allclose(of_degree(flow, 2).velocity(at, 0.3), flow.velocity(at, 0.3), atol=1e-5)
    finer = [on_lattice(flow, Lattice.around((23.0, 19.0, 23.0), cells)) for cells in (4, 8)]
    away = [float((one.velocity(at, 0.3) - flow.velocity(at, 0.3)).norm()) for one in finer]
    assert max(away) < 0.15 * float(flow.velocity(at, 0.3).norm())


def test_turns_have_no_strain_and_shears_do():
    lattice = Lattice.around((23.0, 19.0, 23.0), 4)
    nodes = lattice.nodes()
    z, y, x = lattice.counts
    turn = -0.5 * nodes.square().sum(1, keepdim=True) * torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    values = turn.reshape(x, y, z, 3).permute(3, 2, 1, 0)[None].contiguous()
    flow = Flow(values, lattice, TimeBasis(0, 1, 0), 0.5)
    inner = torch.zeros(1, 3, dtype=torch.float64)
    shear = flow.gradient(inner + 2.0, 0.0)
    assert float((shear + shear.mT).abs().max()) > 0  # -|x|²/2 e_y turns about y, and shears beside
    assert float(strain(flow, [0.0])) > 0
    still = Flow.still(lattice, TimeBasis(0, 1, 0), 0.5)
    assert float(strain(still, [0.0])) == 0


def test_options_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="strain must be a positive number"):
        FlowOptions(strain=0.0)
