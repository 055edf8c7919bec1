"""Files of a run are of one run, and of the settings that its config.json has."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from helpers.runs import KNOWN, RANDOM, Interruption
from holosplat.checks import InputError
from holosplat.fit import run as engine
from holosplat.geometry import Grid
from holosplat.io.atomic import read_json, write_json
from holosplat.io.hdf5 import new_hdf5
from holosplat.io.light import write_light
from holosplat.io.objects import write_object
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior, Matter
from holosplat.representations import VoxelGrid
from holosplat.workflows.provenance import CONFIG_SUM, RESUMED_WITH, RUN, config_sum
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")

WATER = MaterialPrior.known(parse_material("water").delta_beta(20))
OTHER = r"must be of a run with the settings in .*config\.json, but it was written with others; bring back the config"


def alter(folder: RunFolder, name: str, value: object) -> None:
    """Another value of an entry of config.json; the name of the run stays."""
    write_json(folder.config, read_json(folder.config) | {name: value})


def test_a_run_whose_material_was_exchanged_does_not_go_on(scan, tmp_path, monkeypatch):
    """It was killed, so that there is no summary yet; its checkpoint is of the material that it began with."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 0.0)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(RuntimeError):
        reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, on_progress=Interruption(4, RuntimeError))
    assert not folder.summary.exists()
    began = read_json(folder.config)["prior"]
    alter(folder, "prior", WATER.as_dict())
    with pytest.raises(InputError, match=r"checkpoint\.pt " + OTHER):
        reconstruct(scan, WATER, RANDOM, seed=3, folder=folder, resume=True)
    alter(folder, "prior", began)
    assert reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, resume=True).finished
    for path in (folder.object, folder.light):
        if path.exists():
            with h5py.File(path) as file:
                assert file.attrs[RUN] == folder.name()
    assert read_json(folder.summary)[CONFIG_SUM] == config_sum(read_json(folder.config))
    alter(folder, "prior", WATER.as_dict())
    with pytest.raises(InputError, match=r"summary\.json " + OTHER):
        load_reconstruction(folder)


def voxels() -> VoxelGrid:
    grid = Grid.centred((5, 3, 4), 1e-6)
    return VoxelGrid(torch.full((1, *grid.shape), 0.5), grid, Matter.one(1e-7, 1e-10))


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """All files that say of which run they are."""
    found = RunFolder(tmp_path / "run")
    found.begin({name: name for name in RESUMED_WITH if name not in ("method", "prior", "light", "uncertain")})
    write_object(found.object, voxels(), found.marks())
    write_light(found.light, None, np.ones((3, 4)), found.marks())
    found.save_checkpoint({"step": 2})
    found.write_summary({"finished": True})
    found.write_source({"scan": "a.nxs"})
    return found


READERS: dict[str, Callable[[RunFolder], object]] = {
    "checkpoint.pt": lambda found: found.load_checkpoint(),
    "summary.json": lambda found: found.read_summary(),
    "light.h5": lambda found: found.require_own(found.light),
    "object.h5": lambda found: found.require_own(found.object),
}


@pytest.mark.parametrize("name", list(READERS))
@pytest.mark.parametrize("entry", list(RESUMED_WITH))
def test_each_file_is_of_the_settings_that_it_was_written_with(folder, name, entry):
    READERS[name](folder)
    alter(folder, "resolved", {"fit": {}})  # which is told while it runs
    READERS[name](folder)
    alter(folder, entry, {"kind": "water"})
    with pytest.raises(InputError, match=re.escape(name) + " " + OTHER):
        READERS[name](folder)


@pytest.mark.parametrize("name", list(READERS))
def test_each_file_is_of_its_run(folder, name):
    alter(folder, RUN, "0123456789abcdef")
    with pytest.raises(InputError, match=re.escape(name) + r" must be of the run in .*, but it is of another one"):
        READERS[name](folder)


def test_the_light_and_the_object_are_looked_at_when_a_run_is_read(folder, monkeypatch):
    seen = list[Path]()
    monkeypatch.setattr(RunFolder, "require_own", lambda self, path: seen.append(path))
    with pytest.raises(InputError):  # its summary has no times
        load_reconstruction(folder)
    assert seen == [folder.object, folder.light]


def test_where_the_frames_are_is_said_of_the_run(folder):
    assert json.loads(folder.source.read_text()) == {"scan": "a.nxs", **folder.marks()}
    assert set(folder.marks()) == {RUN, CONFIG_SUM}


def test_files_of_older_versions_say_nothing_and_are_read(folder):
    torch.save({"run": folder.name(), "state": {"step": 2}}, folder.checkpoint)
    write_json(folder.summary, {"run": folder.name(), "finished": True})
    write_object(folder.object, voxels())
    with new_hdf5(folder.light) as file:
        file.attrs["format"] = "holosplat light 1"
    alter(folder, "prior", {"kind": "water"})
    for read in READERS.values():
        read(folder)


def test_before_a_run_has_begun_nothing_is_said(tmp_path):
    assert RunFolder(tmp_path).marks() == {}
    write_json(RunFolder(tmp_path).config, {"seed": 1})  # of version 0.1
    assert RunFolder(tmp_path).marks() == {}
