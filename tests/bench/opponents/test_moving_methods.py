"""Other ways to reconstruct all times, on a ball that moves: better than its mean, by seed, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.unjudged import unjudged
from holosplat.baselines import HolographicTV
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import HolographicVoxels, Method, Task, VoxelFit, Voxels, solve
from holosplat.methods.ground import ground
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, MeshSeries
from holosplat.volume import Object
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat_bench.opponents.moving import (
    Deformed,
    EachTime,
    HexPlane,
    LowRank,
    SpaceTimeFit,
    SpaceTimeTV,
    TimesFit,
    each_time,
)
from holosplat_bench.opponents.moving.deformed_voxels import Deformation
from holosplat_bench.opponents.moving.hexplane_field import HexPlanes
from holosplat_bench.opponents.moving.moving_voxels import OnVoxels
from holosplat_bench.opponents.moving.times import DrawnTimes, spectral_objective, weight_of
from holosplat_bench.opponents.pinn import Pinn

PIXEL, SHAPE = 1e-6, (21, 17)
MATTER = DeltaBeta(8e-7, 8e-10)
KNOWN = MaterialPrior.known(MATTER)
TIMES = np.array([0.0, 1e-3, 2e-3, 3e-3])
VOLUME = HolographicTV(retrieval=20, iterations=30, corrections=1, inner=4, refine=1, beyond=False)
WAY = np.array([0.5, 2.0, -0.5])
"""Of the ball, from one time to the next [pixels]."""
ONE = DrawnTimes(1)
METHODS: dict[str, Method] = {
    "each-time": EachTime(VOLUME),
    "space-time-tv": SpaceTimeTV(VOLUME, SpaceTimeFit(steps=8)),
    "low-rank": LowRank(VOLUME, rank=3, fit=TimesFit(steps=20)),
    "hexplane": HexPlane(HexPlanes(6, 6, 1.5), rate=0.05, decoder_rate=0.02, fit=TimesFit(steps=120, drawn=ONE)),
    "deformed": Deformed(
        VOLUME, Deformation(2, 16, 1, 1, 4.0, 5.0), network_rate=0.01, fit=TimesFit(40, drawn=DrawnTimes(2, 0.5))
    ),
}


def balls() -> MeshSeries:
    """A ball of four pixels that moves by three of its radii or so."""
    vertices, faces = icosphere(2)
    return MeshSeries(
        tuple(
            MeshScene.of_one_material([TriangleMesh(PIXEL * (4 * vertices + k * WAY), faces.copy(), "ball")], MATTER)
            for k in (-1.5, -0.5, 0.5, 1.5)
        ),
        TIMES,
    )


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Three views of the ball at four times."""
    exposures = Exposures.of(Views.from_angles([0.0, 60.0, 120.0], SHAPE, PIXEL), 20.0, 0.1).repeated(TIMES)
    nothing = np.zeros(len(exposures), dtype=bool)
    return hs.simulate(balls(), exposures, photons_per_pixel=3000, seed=1, is_test=nothing, oversample=1)


def wrong(found: Callable[[float], Object], scan: Scan) -> float:
    """Relative error of δ, mean over the times."""
    grid, truth, every = Grid.of_views(scan.views), balls(), list[float]()
    for t in TIMES:
        true = truth.at(float(t)).voxelise(grid).delta
        with torch.no_grad():
            every.append(float(np.linalg.norm(found(float(t)).voxelise(grid).delta - true) / np.linalg.norm(true)))
    return float(np.mean(every))


@pytest.fixture(scope="module")
def mean(scan) -> float:
    """The error of the mean of all times, as if the ball stood still."""
    still = solve(HolographicVoxels(VOLUME), Task(scan.as_static(), KNOWN), "levels")
    return wrong(lambda t: still, scan)


@pytest.mark.parametrize("name", METHODS)
def test_a_ball_that_moves_is_nearer_to_the_truth_than_the_mean_of_all_times(name, scan, mean):
    told: list[float] = []
    task = Task(scan, KNOWN, 1, lambda stage, part: told.append(part))
    found = solve(METHODS[name], task, "levels")
    assert isinstance(found, OnVoxels)
    assert wrong(found.at, scan) < 0.85 * mean
    assert found.upper == 1.0
    assert name == "each-time" or told[-1] == 1.0


@pytest.mark.parametrize("name", ["low-rank", "hexplane", "deformed"])
def test_the_same_seed_gives_the_same_and_a_run_goes_on(name, scan, tmp_path):
    method = METHODS[name]
    method = replace(method, fit=replace(method.fit, steps=6))  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue, reportArgumentType]
    folder = RunFolder(tmp_path / "run")

    def stop(stage: str, part: float, record: dict[str, float]) -> None:
        if record.get("step") == 3:
            raise KeyboardInterrupt

    with unjudged():
        whole = reconstruct(scan, KNOWN, method, 3, matter="levels")
        assert not reconstruct(scan, KNOWN, method, 3, matter="levels", folder=folder, on_progress=stop).finished
        done = reconstruct(scan, KNOWN, method, 3, matter="levels", folder=folder, resume=True)
    assert done.finished
    for found in (done.object, load_reconstruction(folder).object):
        for key, value in whole.object.parameters().items():
            assert torch.equal(found.parameters()[key], value)


def test_times_begin_with_their_neighbour(scan, mean):
    """The first time is as by itself; the others come from it, and are near the truth, too."""
    voxels = Voxels(VOLUME, VoxelFit(steps=40, refine=1))
    cold = each_time(scan, KNOWN, voxels, 1, "levels")
    told: list[float] = []
    warm = each_time(scan, KNOWN, voxels, 1, "levels", warm=True, on_progress=lambda stage, part: told.append(part))
    first, again, second = (found.at(t) for found, t in ((cold, 0.0), (warm, 1e-4), (warm, 1e-3)))
    assert isinstance(first, VoxelGrid)
    assert torch.equal(first.values, again.parameters()["values"])
    assert not torch.equal(cold.at(1e-3).parameters()["values"], second.parameters()["values"])
    assert told == [0.0, 0.25, 0.5, 0.75]
    assert wrong(warm.at, scan) < 0.85 * mean


def test_continuous_matter_has_no_bound(scan):
    found = solve(SpaceTimeTV(VOLUME, SpaceTimeFit(steps=1)), Task(scan, KNOWN), "continuous")
    assert isinstance(found, OnVoxels)
    assert found.upper == 0.0


def test_the_weight_of_variation_goes_with_noise_up_for_levels_and_down_for_other_matter(scan):
    volumes = solve(METHODS["each-time"], Task(scan, KNOWN), "levels")
    base = ground(scan, volumes, volumes.matter, spectral_objective(), Schedule(), "cpu")
    assert base.frames.spectral is not None
    noise, floor = base.frames.spectral.noise, base.frames.spectral.floor
    assert weight_of(base, 0.05, 0.03, True) == pytest.approx(0.05 + 0.03 * noise)
    assert weight_of(base, 0.05, 0.03, False) == pytest.approx(0.05 / (1 + floor**2))


@pytest.mark.parametrize("name", METHODS)
def test_one_time_is_refused(name, scan):
    with pytest.raises(InputError, match="training frames of 2 times or more"):
        solve(METHODS[name], Task(scan.at_instant(1), KNOWN), "levels")


def test_what_does_not_fit_is_refused(scan):
    with pytest.raises(InputError, match="needs a method that takes one time, but pinn takes several"):
        each_time(scan, KNOWN, Pinn())
    with pytest.raises(InputError, match="holographic-tv fits nothing that could begin at another time"):
        each_time(scan, KNOWN, HolographicVoxels(VOLUME), 0, "levels", warm=True)
    with pytest.raises(InputError, match="training frames of 2 times or more"):
        each_time(scan.at_instant(0), KNOWN, HolographicVoxels(VOLUME))
    for options in (TimesFit, SpaceTimeFit):
        with pytest.raises(InputError, match="smoothing must be a positive number"):
            options(smoothing=0.0)
    with pytest.raises(InputError, match=r"decay must be a positive number"):
        TimesFit(decay=0.0)
    with pytest.raises(InputError, match="rank must be at least 1"):
        LowRank(rank=0)
