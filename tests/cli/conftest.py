"""The tiny scene, its scan and a run, which the tests of the commands read."""

from __future__ import annotations

import json

import pytest

from helpers.cli import COLUMNS, PIXEL, QUICK, ROWS, Workshop, holosplat, known, simulate, worked
from holosplat.io.vtk import write_mesh
from holosplat.specimens.red_cells import random_cells
from holosplat.tables import to_table


@pytest.fixture(scope="session")
def shop(tmp_path_factory) -> Workshop:
    """Two red cells, eight views of them (the fourth and eighth held out), and a run on these."""
    path = tmp_path_factory.mktemp("shop")
    cells = random_cells(2, (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL), 1, 12 * PIXEL)
    files = tuple(path / f"{cell.name}.vtk" for cell in cells)
    for cell, file in zip(cells, files):
        write_mesh(file, cell, "um")
    made = Workshop(path, files, path / "scan.nxs", path / "truth.h5", path / "quick.json", path / "run")
    made.quick.write_text(json.dumps(to_table(QUICK)))
    worked(simulate(made, "--views", 8, "--out", made.scan, "--truth", made.truth))
    worked(holosplat("reconstruct", made.scan, "--out", made.run, *known(made), "--seed", 5))
    return made


@pytest.fixture(autouse=True)
def _undrawn(undrawn_reports: None) -> None:
    """Tests of the commands do not draw the figures of reports. The shop's run, which is made before, has them."""


@pytest.fixture(scope="module", autouse=True)
def _once(plain_light: None) -> None:
    """Commands in the tests' process share what runs begin with, and take light for plain where nothing is told."""
