"""Files of runs and series that hold texts for numbers, tables for texts, or less than they should."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from holosplat.checks import InputError
from holosplat.fit.run import require_alike
from holosplat.io.reading import Reading
from holosplat.io.table import Table
from holosplat.projectors.surface import surface_thickness
from holosplat.report.info import facts_of_run
from holosplat.series.folder import Row, read_row, write_row
from holosplat.specimens.red_cells import icosphere
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder

OLD_RUN = Path(__file__).resolve().parents[1] / "data/run_0_1_0"
ROW = Row(3, "scan", 0, 0.5, "done", test={"ssim": 0.9, "psnr": "inf"}, bodies=((1e-6, 2e-6, 3e-6, 4e-18),))
OWN = {
    "step": 3,
    "rate": 0.5,
    "name": "a",
    "done": False,
    "values": torch.ones(3),
    "none": None,
    "inner": {"loss": 1.0},
}


def test_a_row_of_a_series_comes_back(tmp_path):
    write_row(tmp_path / "row.json", ROW)
    assert read_row(tmp_path / "row.json") == ROW


@pytest.mark.parametrize(
    "change",
    [
        {"seconds": "x"},
        {"number": 10**400},
        {"total": "1"},
        {"status": "perhaps"},
        {"begun": 3},
        {"bodies": [[1, 2, 3]]},
        {"bodies": 3},
        {"test": [1]},
        {"good": "yes"},
        {"unknown": 1},
    ],
)
def test_a_row_that_is_none_is_refused(tmp_path, change):
    (tmp_path / "row.json").write_text(json.dumps(asdict(ROW) | change))
    with pytest.raises(InputError, match=r"row\.json"):
        read_row(tmp_path / "row.json")


@pytest.mark.parametrize(
    "change",
    [
        {"step": "3"},
        {"rate": torch.ones(2)},
        {"name": 3},
        {"values": "x"},
        {"values": 1.0},
        {"inner": 3},
        {"inner": {"loss": "x"}},
    ],
)
def test_a_checkpoint_has_values_of_the_kinds_of_its_fit(change):
    require_alike({**OWN, "step": 4, "more": "x", "none": 1}, OWN)
    require_alike({"values": None}, OWN)
    with pytest.raises(
        InputError, match=f"{next(iter(change)) if change != {'inner': {'loss': 'x'}} else 'loss'} must be"
    ):
        require_alike({**OWN, **change}, OWN)


def test_a_name_with_a_zero_byte_is_no_name_of_a_file(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"file": "a\0.tif"}))
    with pytest.raises(InputError, match="file must be the name of a file"):
        Table.read(tmp_path / "a.json").file("file")


@pytest.mark.parametrize(
    ("rotations", "shifts", "pixels"),
    [((2, 3, 3), (3, 2), None), ((2, 3), (2, 2), None), ((2, 3, 3), (2, 3), None), ((2, 3, 3), (2, 2), (3,))],
)
def test_surfaces_are_seen_from_poses_that_are_some(rotations, shifts, pixels):
    """The kernels would read what is not there."""
    points, faces = icosphere(1)
    body = torch.tensor(points), torch.tensor(faces)
    told = None if pixels is None else torch.ones(pixels)
    with pytest.raises(InputError, match="rotations, shifts and pixels must have the shapes"):
        surface_thickness(*body, torch.ones(rotations), torch.ones(shifts), (5, 7), pixels=told)


def test_a_path_with_a_zero_byte_is_none():
    with pytest.raises(InputError, match="angles must be a path"):
        Reading.from_table({"angles": "a\0"})


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("config.json", {"versions": -1}),
        ("summary.json", {"decided": -1}),
        ("summary.json", {"decisions": [{"compared": [True]}]}),
        ("summary.json", {"timing_s": {"fit": "\0"}}),
        ("summary.json", {"unexplained": {"start": []}}),
        ("summary.json", {"detector": {"rows": 3}}),
        ("summary.json", {"verdict": []}),
    ],
)
def test_a_run_with_a_garbled_entry_is_told_of(tmp_path, name, change):
    run = Path(shutil.copytree(OLD_RUN, tmp_path / "run"))
    table = json.loads((run / name).read_text())
    (run / name).write_text(json.dumps(table | change))
    with pytest.raises(InputError, match=r"must be .*as it was written"):
        facts_of_run(RunFolder(run))


def test_true_is_no_number_of_a_run(tmp_path):
    """Python takes it for 1."""
    run = Path(shutil.copytree(OLD_RUN, tmp_path / "run"))
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps(summary | {"oversample": True}))
    with pytest.raises(InputError, match="oversample must be a number, but it is True"):
        load_reconstruction(RunFolder(run))
