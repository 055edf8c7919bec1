"""What is read of a run that goes on: the object of a fit's state, in every form of checkpoint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.splats import cloud
from holosplat.geometry import Grid
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import GaussianCloud, MovingSurfaces, TimeBasis, VoxelGrid
from holosplat.representations.gaussians import raw_of
from holosplat.specimens.red_cells import icosphere
from holosplat.workflows.run_folder import RunFolder, RunStatus, read_status

MATTER = Matter((DeltaBeta(4e-7, 2e-10),))


def gaussians(count: int) -> GaussianCloud:
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, count)
    return GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1)), 2e-6, MATTER)


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    made = RunFolder(tmp_path / "run")
    made.begin({"resolved": {"start": {}, "fit": {}}})
    return made


def test_gaussians_are_those_of_the_last_step(folder):
    """Of which there may be other numbers than at the start."""
    begun, now = gaussians(20), gaussians(30)
    free = {f"object.{name}": value for name, value in now.parameters().items()} | {"light.still": torch.zeros(2)}
    fit = {"trainable": {"parameters": free}}
    folder.start_metrics(["step", "loss"])
    folder.append_metrics([{"step": 1, "loss": 0.5}, {"step": 2, "loss": 0.25}])
    folder.save_checkpoint({"stage": 1, "start": {"kind": begun.kind, "state": begun.state()}, "fit": fit})
    found = read_status(folder)
    assert (found.stage, found.step, found.loss) == ("fit", 2, 0.25)
    assert found.lines() == ["stage: fit", "step 2, loss 0.25"]
    assert torch.equal(found.object.centres, now.centres)


def test_other_fits_show_their_volume_or_what_they_begin_with(folder):
    begun = gaussians(20)
    start = {"kind": begun.kind, "state": begun.state()}
    volume = VoxelGrid(torch.rand(1, 3, 4, 5), Grid.centred((3, 4, 5), 1e-6), MATTER)
    folder.save_checkpoint({"stage": 0, "start": start, "fit": {"volume": volume.state()}})
    assert torch.equal(read_status(folder).object.values, volume.values)
    folder.save_checkpoint({"stage": 0, "start": start, "fit": {"trainable": {"parameters": {"object.other": 1.0}}}})
    assert len(read_status(folder).object) == 20


def test_bodies_in_motion_are_those_of_their_fit(folder):
    points, faces = icosphere(1)
    paths = torch.from_numpy(np.stack([points, points + 1]))
    body = torch.zeros(len(faces), dtype=torch.int64)
    bodies = MovingSurfaces(paths, torch.from_numpy(faces.copy()), body, TimeBasis(0.0, 1e-5, 1), 2e-6, MATTER)
    state = {"next": "soft", "bodies": bodies.state(), "records": [{"step": 7, "loss": 0.5}], "fit": None}
    folder.save_checkpoint(state)
    found = read_status(folder)
    assert (found.stage, found.step, found.object.count) == ("soft", 7, 1)
    moved = {"trainable": {"parameters": {"object.coefficients": bodies.coefficients + 1}}}
    folder.save_checkpoint(state | {"fit": moved})
    assert torch.equal(read_status(folder).object.coefficients, bodies.coefficients + 1)
    folder.save_checkpoint(state | {"bodies": None, "next": "first paths", "records": []})
    assert read_status(folder) == RunStatus("first paths")


def test_matter_in_motion_says_its_steps_and_a_run_without_a_state_nothing(folder):
    assert read_status(folder).lines() == ["nothing is kept yet"]
    folder.save_checkpoint({"steps": 3, "history": [], "timing": {}, "strength": 1.0})
    assert read_status(folder).lines() == ["stage: 3 steps are done"]
