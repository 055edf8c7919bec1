"""The object of a run is the one that its summary names."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.atomic import write_json
from holosplat.io.objects import write_object
from holosplat.matter import Matter
from holosplat.representations import VoxelGrid
from holosplat.workflows.run_folder import OBJECT_SUM, RunFolder

PIXEL = 1e-6


def voxels(value: float) -> VoxelGrid:
    grid = Grid.centred((5, 3, 4), PIXEL)
    return VoxelGrid(torch.full((1, *grid.shape), value), grid, Matter.one(1e-7, 1e-10))


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    found = RunFolder(tmp_path)
    write_json(found.config, {"run": "abc"})
    write_object(found.object, voxels(0.5))
    found.write_summary({"finished": True})
    return found


def test_what_was_written_is_read(folder):
    read = folder.read_result()
    assert isinstance(read, VoxelGrid)
    assert torch.equal(read.values, voxels(0.5).values)


def test_values_that_another_program_changed_are_not_taken_for_the_result(folder):
    """They could be any, and all are in range."""
    with h5py.File(folder.object, "r+") as file:
        file["values"][0, 0, 0, 0] = 0.75
    with pytest.raises(InputError, match=r"object\.h5 must be what summary\.json says was written"):
        folder.read_result()


def test_the_object_of_another_run_is_refused_and_a_new_summary_takes_it(folder):
    write_object(folder.object, voxels(0.25))
    with pytest.raises(InputError, match="go on with --resume"):
        folder.read_result()
    folder.write_summary({"finished": True})
    assert isinstance(folder.read_result(), VoxelGrid)


def test_runs_of_older_versions_name_no_object(folder):
    summary = json.loads(folder.summary.read_text())
    del summary[OBJECT_SUM]
    folder.summary.write_text(json.dumps(summary))
    write_object(folder.object, voxels(0.25))
    assert isinstance(folder.read_result(), VoxelGrid)


def test_a_summary_without_an_object_names_none(tmp_path):
    found = RunFolder(tmp_path)
    write_json(found.config, {"run": "abc"})
    found.write_summary({"finished": False})
    assert OBJECT_SUM not in json.loads(found.summary.read_text())
