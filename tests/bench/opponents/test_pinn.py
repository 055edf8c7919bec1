"""Fields of space and time on a small scan: what moves is found to move so, runs resume, and one time is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.unjudged import unjudged
from holosplat.baselines import HolographicTV
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import Task, solve
from holosplat.methods.presets import method_called
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, MeshSeries
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat_bench.opponents.fields import SpaceTime, SpaceTimeField
from holosplat_bench.opponents.fields.terms import Equations
from holosplat_bench.opponents.pinn import FLOW_ALONE, THROUGH_WAVES, Pinn, PinnFit

PIXEL, SHAPE = 1e-6, (17, 23)
MATTER = DeltaBeta(8e-7, 8e-10)
KNOWN = MaterialPrior.known(MATTER)
WAY = np.array([1.0, 1.5, -0.5])
"""Of all balls, from one time to the next [pixels]."""
TIMES = np.array([0.0, 1e-3, 2e-3])
BALLS = ((-3.0, -2.0, 2.0), (3.0, 1.0, -3.0))
"""Centres at the time in the middle [pixels]."""
VOLUME = HolographicTV(retrieval=20, iterations=30, corrections=1, inner=4, refine=1)
POOR = HolographicTV(retrieval=5, iterations=5, corrections=0, refine=1)


def quick(steps: int = 12, **options: object) -> Pinn:
    usual = PinnFit(SpaceTime(), Equations(points=200, momentum_points=20), flow_steps=60)
    fit = replace(usual, schedule=replace(usual.schedule, steps=steps, views_per_step=4), **options)  # pyright: ignore[reportArgumentType]
    return Pinn(VOLUME, fit)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Three views of two balls of three pixels that drift, at three times."""
    vertices, faces = icosphere(2)
    snapshots = tuple(
        MeshScene.of_one_material(
            [TriangleMesh(PIXEL * (3.0 * vertices + ball + k * WAY), faces.copy(), f"ball{n}")
             for n, ball in enumerate(np.array(BALLS))],
            MATTER,
        )
        for k in (-1, 0, 1)
    )  # fmt: skip
    exposures = Exposures.of(Views.from_angles([0.0, 60.0, 120.0], SHAPE, PIXEL), 20.0, 0.1).repeated(TIMES)
    nothing = np.zeros(len(exposures), dtype=bool)
    return hs.simulate(
        MeshSeries(snapshots, TIMES), exposures, photons_per_pixel=3000, seed=1, is_test=nothing, oversample=1
    )


def test_a_drift_is_found(scan):
    """Its direction and roughly its size, in metres a second, and matter that goes that way."""
    told: list[tuple[str, float]] = []
    found = solve(quick(), Task(scan, KNOWN, 1, lambda stage, part: told.append((stage, part))), "levels")
    assert isinstance(found, SpaceTimeField)
    points = torch.tensor(BALLS) * PIXEL
    velocity = found.velocity(points, 1e-3).double().mean(0).numpy()
    wanted = WAY * PIXEL / 1e-3
    assert velocity @ wanted > 0.9 * np.linalg.norm(velocity) * np.linalg.norm(wanted)
    assert 0.5 < np.linalg.norm(velocity) / np.linalg.norm(wanted) < 1.5
    assert told[-1] == (THROUGH_WAVES, 1.0)
    assert FLOW_ALONE in dict(told)
    early, late = ((found.at(t).values[0] > 0.5).float() for t in TIMES[[0, 2]])
    rows = torch.arange(SHAPE[0], dtype=torch.float32)
    ways = [float((one.sum((0, 2)) * rows).sum() / one.sum()) for one in (early, late)]
    assert ways[1] - ways[0] == pytest.approx(2 * WAY[1], abs=0.8)


def test_without_equations_nothing_flows(scan):
    method = replace(quick(3, equations=Equations(continuity=0.0)), volume=POOR)
    assert [stage.name for stage in method.stages()][1:] == [THROUGH_WAVES]
    found = solve(method, Task(scan, KNOWN, 1), "levels")
    assert isinstance(found, SpaceTimeField)
    first = found.options.velocity.started(1)
    assert all(torch.equal(first[name], weight) for name, weight in found.weights.items())


def test_one_time_is_refused(scan):
    with pytest.raises(InputError, match=r"training frames of 2 times or more.*--motion flow"):
        solve(quick(), Task(scan.at_instant(1), KNOWN), "levels")


def test_it_is_known_by_its_name():
    assert method_called("pinn") == Pinn()


def test_a_run_that_is_stopped_in_either_stage_goes_on_bit_for_bit(scan, tmp_path):
    method = replace(quick(5, flow_steps=6), volume=POOR)
    folder = RunFolder(tmp_path / "run")

    def stopped(stage: str, resume: bool) -> bool:
        def stop(name: str, part: float, record: dict[str, float]) -> None:
            if name == stage and record.get("step") == 3:
                raise KeyboardInterrupt

        found = reconstruct(scan, KNOWN, method, 3, matter="levels", folder=folder, resume=resume, on_progress=stop)
        return not found.finished

    with unjudged():
        whole = reconstruct(scan, KNOWN, method, 3, matter="levels")
        assert stopped(FLOW_ALONE, False)
        assert stopped(THROUGH_WAVES, True)
        done = reconstruct(scan, KNOWN, method, 3, matter="levels", folder=folder, resume=True)
    assert done.finished
    for name, tensor in done.object.parameters().items():
        assert torch.equal(tensor, whole.object.parameters()[name]), name
    kept = load_reconstruction(folder)
    assert isinstance(kept.object, SpaceTimeField)
    assert torch.equal(kept.object.coefficients, done.object.parameters()["coefficients"])
    assert folder.read_summary()["times_s"] == pytest.approx(TIMES, abs=0)
    assert kept.total is None
