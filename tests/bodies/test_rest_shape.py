"""What is known of bodies at rest: meshes that are read, their sizes, and those of red cells by a guess."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.bodies.rest_shape import GUESSED, KnownBody, extent_like, guessed_cells, thinned
from holosplat.checks import InputError
from holosplat.io.vtk import write_mesh
from holosplat.mesh import TriangleMesh
from holosplat.specimens.membrane.rest import resting_cell
from holosplat.specimens.red_cells import evans_fung_cell, icosphere


def cells(*factors: float) -> list[TriangleMesh]:
    rest = resting_cell()
    return [TriangleMesh(factor * rest.vertices, rest.faces) for factor in factors]


def test_pieces_do_not_count_as_cells():
    extent = float(np.ptp(resting_cell().vertices, axis=0).max())
    assert extent_like(cells(1.2)) == pytest.approx(1.2 * extent)
    assert extent_like(cells(1.0, 0.5, 1.0, 0.4, 0.5, 0.4, 1.02, 0.3)) == pytest.approx(extent)


def test_guessed_cells_have_that_size_and_may_have_another():
    body = guessed_cells(9e-6)
    assert float(np.ptp(body.mesh(0.5e-6).vertices, axis=0).max()) == pytest.approx(18, rel=1e-3)
    assert body.uncertain == GUESSED


def test_meshes_are_read_sized_and_thinned(tmp_path):
    fine = evans_fung_cell(subdivisions=4)
    write_mesh(tmp_path / "body.vtp", fine, "um")
    body = KnownBody(str(tmp_path / "body.vtp"), size=8e-6)
    mesh = body.mesh(0.5e-6)
    assert len(mesh.faces) < 1000
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(16, rel=0.01)
    assert mesh.volume == pytest.approx(
        fine.volume * (8e-6 / np.ptp(fine.vertices, axis=0).max() / 0.5e-6) ** 3, rel=1e-6
    )
    same = thinned(fine, len(fine.faces))
    assert same.area == pytest.approx(fine.area)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"shape": "blue-cell"}, "must be red-cell or a mesh file"), ({"size": 1e-7}, "3 to 300 pixels"),
     ({"size": 1.0}, "3 to 300 pixels"), ({"uncertain": 0.5}, "uncertain"), ({"instants": 1}, "instants")],
)  # fmt: skip
def test_what_is_wrong_with_a_body_is_said(wrong, message):
    with pytest.raises(InputError, match=message):
        KnownBody(**wrong).mesh(0.5e-6)


def test_an_open_mesh_is_no_body(tmp_path):
    sphere, faces = icosphere(1)
    write_mesh(tmp_path / "open.vtp", TriangleMesh(1e-6 * sphere, faces[1:]), "um")
    with pytest.raises(InputError, match="must be a closed surface"):
        KnownBody(str(tmp_path / "open.vtp")).mesh(1e-7)
