"""Matter in motion after the last frames: how a flow goes on, which way is taken, and how sure it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers import fading_lumps
from helpers.fading_lumps import MATTER, PIXEL, series
from holosplat.checks import InputError
from holosplat.matter import Matter
from holosplat.motion.flow_forecast import FEWEST, NAME, FlowHistory, forecast_matter, gone_on
from holosplat.representations import Flow, GaussianCloud, Lattice, MovingGaussians, TimeBasis
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Scan
from holosplat.workflows.evaluate import render_object

LATTICE = Lattice.around((24.0, 20.0, 22.0), 5)
AHEAD = np.array([1.25, 1.5, 1.75, 2.0])


def cloud(count: int = 40, spread: float = 2.5) -> GaussianCloud:
    draw = torch.Generator().manual_seed(3)
    centres = spread * torch.randn(count, 3, generator=draw)
    logs, turns = 0.2 * torch.randn(count, 3, generator=draw), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return GaussianCloud([centres, logs, turns, raw_of(torch.full((count, 1), 0.4))], PIXEL, Matter.one(*MATTER))


def potential(of, lattice: Lattice = LATTICE) -> torch.Tensor:
    """[1, 3, Z, Y, X] float32 of a vector potential [P, 3] at the nodes [P, 3]."""
    z, y, x = lattice.counts
    return of(lattice.nodes()).reshape(x, y, z, 3).permute(3, 2, 1, 0)[None].float().contiguous()


def drift(nodes: torch.Tensor, way=(3.0, -1.0, 2.0)) -> torch.Tensor:
    """v = ∇ × (½ v × r)."""
    return 0.5 * torch.linalg.cross(torch.tensor(way, dtype=nodes.dtype).expand_as(nodes), nodes)


def turning(nodes: torch.Tensor, rate: float = 1.0) -> torch.Tensor:
    """About the z axis."""
    found = torch.zeros_like(nodes)
    found[:, 2] = -0.5 * rate * nodes[:, :2].square().sum(1)
    return found


def matter(of, degree: int = 0, spread: float = 2.5) -> MovingGaussians:
    """Gaussians in a flow over one second, whose potential grows from 0 with time, where its degree is one."""
    now = potential(of)
    whole = now if degree == 0 else torch.cat([torch.zeros_like(now), now])
    return MovingGaussians(cloud(spread=spread), Flow(whole, LATTICE, TimeBasis(0.0, 1.0, degree), 0.5))


def volumes(of: GaussianCloud) -> torch.Tensor:
    return of.log_scales.sum(1)


@pytest.mark.parametrize("way", ["steady", "inertia", "paths"])
def test_a_drift_goes_on(way):
    """By its velocity, at the times ahead and between them, and each Gaussian with its volume."""
    before = matter(drift, spread=1.2)
    later = gone_on(before, 1.0, AHEAD[1::2], way)
    begun, slack = before.at(1.0), 0.2 if way == "inertia" else 2e-3  # fluid at rest beyond the lattice slows it
    for time in (1.0, 1.1, 1.5, 2.0):
        wanted = begun.centres + (time - 1.0) * torch.tensor([3.0, -1.0, 2.0])
        assert later.at(time).centres == pytest.approx(wanted, abs=slack)
        assert volumes(later.at(time)) == pytest.approx(volumes(begun), abs=1e-3)


def test_a_vortex_goes_on_turning():
    """A turn about an axis is a steady solution of Euler's equations: the pressure, which keeps volumes, bends paths.
    Steps along straight lines come near it in the first order, as far as the lattice tells the vortex."""

    def vortex(nodes):
        along = torch.tensor([[0.0, 0.0, 25.0]], dtype=nodes.dtype)
        return along * torch.exp(-nodes[:, :2].square().sum(1, keepdim=True) / 50)

    before = matter(vortex)
    steady = gone_on(before, 1.0, AHEAD, "steady").at(2.0).centres
    moved = steady - before.at(1.0).centres
    missed = []
    for count in (2, 4):
        found = gone_on(before, 1.0, 1.0 + np.arange(1, count + 1) / count, "inertia").at(2.0).centres
        missed.append(float((found - steady).norm() / moved.norm()))
    assert missed[0] < 0.03
    assert missed[1] < 0.65 * missed[0]


def test_a_steady_flow_turns_what_it_carries():
    """By the angle in closed form."""
    before = matter(turning)
    later = gone_on(before, 1.0, AHEAD, "steady").at(2.0).centres
    x, y, z = before.at(1.0).centres.T
    cos, sin = np.cos(1.0), np.sin(1.0)
    assert later == pytest.approx(torch.stack([cos * x - sin * y, sin * x + cos * y, z], 1), abs=5e-3)


def test_a_jet_goes_on_by_inertia_and_leaves_a_steady_flow():
    """Of a flow about the middle alone: fluid takes its velocity along."""

    def jet(nodes):
        return drift(nodes, (20.0, 0.0, 0.0)) * torch.exp(-nodes.square().sum(1, keepdim=True) / (2 * 5.0**2))

    before = matter(jet)
    begun = before.at(1.0).centres[:, 0].mean()
    steady, inertia = (
        float(gone_on(before, 1.0, AHEAD, way).at(2.0).centres[:, 0].mean() - begun) for way in ("steady", "inertia")
    )
    assert inertia > 1.15 * steady > 0


def test_the_fitted_change_goes_on_by_paths():
    """Of a velocity that grows with time from 0: half of the square of the time, all of it after the reference."""
    before = matter(drift, degree=1)
    later = gone_on(before, 1.0, AHEAD, "paths")
    way = torch.tensor([3.0, -1.0, 2.0])
    for time in (1.25, 1.6, 2.0):
        assert later.at(time).centres == pytest.approx(before.at(1.0).centres + 0.5 * (time**2 - 1) * way, abs=2e-3)
    steady = gone_on(before, 1.0, AHEAD, "steady").at(2.0).centres
    assert steady == pytest.approx(before.at(1.0).centres + way, abs=2e-3)


def test_matter_at_rest_stays_as_it_is():
    before = matter(drift)
    later = gone_on(before, 1.0, AHEAD, "rest")
    ours, theirs = later.at(2.0), before.at(1.0)
    assert ours.centres == pytest.approx(theirs.centres, abs=1e-5)
    assert ours.log_scales.sort(1)[0] == pytest.approx(theirs.log_scales.sort(1)[0], abs=1e-4)


def test_a_flow_with_sources_has_no_inertia():
    before = matter(drift)
    with_sources = replace(before.flow, sources=torch.zeros_like(before.flow.potential[:, 0]))
    with pytest.raises(InputError, match="inertia needs a flow without sources"):
        gone_on(MovingGaussians(before.cloud, with_sources), 1.0, AHEAD, "inertia")


TIMES = np.linspace(0.0, 1.0, 6)
SPEED = np.array([4e-6, -2e-6, 3e-6])


@pytest.fixture(scope="module")
def drifting() -> tuple[MovingGaussians, Scan]:
    """Soft lumps as Gaussians in their true drift, and their frames at six times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fading_lumps, "TIMES", TIMES)
        scene, scan = series(fading_lumps.drifting(tuple(SPEED)), 3000.0)
    way = tuple(SPEED / PIXEL)
    places = torch.tensor(np.stack([e.centre for e in scene.scene.elements]) + TIMES[3] * SPEED) / PIXEL
    lengths = torch.log(torch.tensor([[1.3, 1.05, 1.2]]).repeat(3, 1))
    turns, amplitudes = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), raw_of(torch.full((3, 1), 0.9))
    lumps = GaussianCloud([places.float(), lengths, turns, amplitudes], PIXEL, Matter.one(*MATTER))
    coarse = Lattice.around((23.0, 19.0, 23.0), 2)
    whole = potential(lambda nodes: drift(nodes, way), coarse)
    flow = Flow(whole, coarse, TimeBasis(0.0, 1.0, 0), float(TIMES[3]), 2)
    return MovingGaussians(lumps, flow), scan


def history(matter: MovingGaussians, scan: Scan) -> FlowHistory:
    return FlowHistory(
        matter, scan, lambda moving, part: torch.from_numpy(render_object(moving, part.exposures, 1, "cpu"))
    )


def test_a_forecast_is_where_matter_goes_within_its_error(drifting):
    matter, scan = drifting
    ahead = TIMES[-1] + 0.2 * np.arange(1, 4)
    found, decision, way = forecast_matter(history(matter, scan), ahead, None, True, lambda stage, part: None)
    assert decision is not None
    assert (decision.name, decision.choice) == (NAME, way)
    assert [each.name for each in decision.compared] == ["steady", "inertia"]
    assert decision.choice != "rest"
    band = found.usual_band()
    assert (np.diff(band) > 0).all()
    assert 0 < band[0] < 0.3 * PIXEL
    true = matter.at(1.0).centres + torch.from_numpy((ahead[-1] - 1.0) * SPEED / PIXEL).float()
    assert PIXEL * float((found.object.at(ahead[-1]).centres - true).square().mean().sqrt()) < 0.3 * PIXEL


def test_the_early_flow_never_sees_late_frames(drifting):
    matter, scan = drifting
    dark = scan.frames.copy()
    late = scan.exposures.time > TIMES[3] + 1e-6
    dark[late] = 1.0
    seen, unseen = history(matter, scan), history(matter, replace(scan, frames=dark))
    assert seen.early_times == pytest.approx(TIMES[:4])
    assert torch.equal(seen.early().flow.potential, unseen.early().flow.potential)
    assert not torch.equal(seen.half(0).flow.potential, unseen.half(0).flow.potential)
    assert seen.early().flow.potential.abs().max() > 0


def test_errors_are_those_of_halves_and_grow_with_noise(drifting, monkeypatch):
    """Half of what halves differ by is about what they miss."""
    matter, scan = drifting
    monkeypatch.setattr(FlowHistory, "early", lambda self: matter)  # which misses nothing
    draw = np.random.default_rng(2).normal(0, 0.1, scan.frames.shape).astype(np.float32)
    ahead = TIMES[-1] + 0.2 * np.arange(1, 3)
    true, bands = gone_on(matter, 1.0, ahead, "steady").at(float(ahead[-1])).centres, list[float]()
    for one in (scan, replace(scan, frames=scan.frames + draw)):
        told = history(matter, one)
        bands.append(float(told.band("steady", ahead)[-1, 0]))
        half = gone_on(told.half(0), 1.0, ahead, "steady").at(float(ahead[-1])).centres
        missed = PIXEL * float((half - true).square().mean().sqrt())
        assert 0.5 * missed < bands[-1] < 2 * missed
    assert bands[1] > 1.2 * bands[0]


def test_of_few_times_nothing_is_said_of_errors(drifting):
    matter, scan = drifting
    few = scan[np.flatnonzero(scan.exposures.time < TIMES[FEWEST - 1])]
    short = replace(matter.flow, reference=float(TIMES[1]))
    found, decision, way = forecast_matter(
        history(MovingGaussians(matter.cloud, short), few), TIMES[3:5], None, True, lambda stage, part: None
    )
    assert (decision, way) == (None, "steady")
    assert np.isnan(found.band).all()


def test_matter_that_fades_is_refused(drifting):
    matter, scan = drifting
    fading = MovingGaussians(matter.cloud, matter.flow, torch.zeros(2, 3))
    with pytest.raises(InputError, match="needs matter that stays as much"):
        history(fading, scan)
