"""tracks.csv: what is written is what is read."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from helpers.moving_ellipsoids import TIMES, scan, true_paths
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.track import STRAIN, TRACKS, read_errors, write_tracks


def test_more_columns_stand_beside_those_of_every_run(tmp_path):
    """Each value in the row of its body and time; standard errors are read again, other columns are none."""
    energies = 1e-17 * (1 + np.arange(3.0 * TIMES).reshape(TIMES, 3))
    errors = 1e-9 * (100 + np.arange(3.0 * TIMES).reshape(TIMES, 3))
    folder = RunFolder(tmp_path / "run")
    folder.begin({})
    write_tracks(folder, true_paths(), scan(), {STRAIN: energies, "se_x_m": errors})
    with (folder.path / TRACKS).open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row[STRAIN]) for row in rows] == pytest.approx(energies.ravel(), rel=1e-3, abs=0)
    assert (rows[4]["body"], float(rows[4]["time_s"])) == ("1", pytest.approx(1e-5, abs=0))
    assert list(read_errors(folder)) == ["x_m"]
    assert read_errors(folder)["x_m"] == pytest.approx(errors, rel=1e-3, abs=0)
    write_tracks(folder, true_paths(), scan())  # again, over what is there
    assert read_errors(folder) == {}
