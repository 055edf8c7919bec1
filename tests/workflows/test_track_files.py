"""tracks.csv: what is written is what is read."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import PIXEL, TIMES, scan, true_paths
from holosplat.bodies.rest_shape import KnownBody, guessed_cells
from holosplat.checks import InputError
from holosplat.motion.known import at_rest
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.workflows.reconstruction import read_rest, write_rest
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


def test_a_shape_at_rest_is_read_as_it_was_written(tmp_path):
    """With the stiffness that the run was told; of runs without it there is none, and other triangles are refused."""
    folder, bodies = RunFolder(tmp_path / "run"), true_paths()
    folder.begin({})
    config = {"method": {"body": {"stiffness": 70.0}}}
    assert read_rest(folder, bodies, config) is None
    known = at_rest(KnownBody(), 0.5 * PIXEL, 1.03)
    mesh = known.elastic.membrane.mesh
    shape = replace(mesh, vertices=PIXEL * mesh.vertices)
    places = [np.stack([shape.vertices + [0, k * 1e-5, 0]] * 2) for k in range(2)]
    cells = MovingSurfaces.of_bodies(places, [shape.faces] * 2, TimeBasis(0.0, 1.0, 1), PIXEL, bodies.matter)
    write_rest(folder, shape)
    found = read_rest(folder, cells, config)
    assert found is not None
    assert found.stiffness == 70
    untold = read_rest(folder, cells, {"method": {"body": None}})  # red cells that the run found by itself
    assert untold is not None
    assert untold.stiffness == guessed_cells(8e-6).stiffness
    nodes = torch.from_numpy(1.1 * mesh.vertices)
    assert float(found.elastic(nodes)) == pytest.approx(float(known.elastic(nodes)), rel=1e-5)
    with pytest.raises(InputError, match="has others"):
        read_rest(folder, bodies, config)
    with pytest.raises(InputError, match=r"config\.json"):
        read_rest(folder, cells, {"method": {}})
