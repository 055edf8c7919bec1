"""Bodies in one .vtu file: other readers find each with its data, and ours takes them apart again."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.io.paraview import write_vtu
from holosplat.io.vtk import read_meshes
from holosplat.matter import DeltaBeta, Matter
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import icosphere

MATTER = Matter((DeltaBeta(4e-7, 2e-10),))


def bodies() -> list[TriangleMesh]:
    """Two balls of unequal meshes that share a corner, of which the first begins where the other does."""
    found = []
    for name, level, radius in (("body000", 2, 7e-6), ("body001", 1, 5e-6)):
        points, faces = icosphere(level)
        found.append(TriangleMesh(radius * (points - points[0]), faces, name))
    return found


def test_bodies_come_back_apart(tmp_path):
    write_vtu(tmp_path / "b.vtu", bodies(), [MATTER] * 2)
    found = read_meshes(tmp_path / "b.vtu", "um")
    assert [body.name for body in found] == ["body000", "body001"]
    for body, true in zip(found, bodies()):
        np.testing.assert_allclose(body.vertices, true.vertices, atol=1e-15)
        np.testing.assert_array_equal(body.faces, true.faces)


def test_another_reader_finds_the_data_of_each_body(tmp_path):
    meshio = pytest.importorskip("meshio")
    write_vtu(tmp_path / "b.vtu", bodies(), [MATTER] * 2)
    found, true = meshio.read(tmp_path / "b.vtu"), bodies()
    assert [block.type for block in found.cells] == ["triangle"]
    data = {name: blocks[0] for name, blocks in found.cell_data.items()}
    assert set(data) == {"body", "delta", "beta", "volume_m3"}
    np.testing.assert_array_equal(data["body"], np.repeat([0, 1], [len(body.faces) for body in true]))
    assert set(data["delta"]) == {4e-7}
    assert set(data["beta"]) == {2e-10}
    for number, body in enumerate(true):
        corners = found.points[found.cells[0].data[data["body"] == number]]
        np.testing.assert_allclose(1e-6 * corners, body.vertices[body.faces], atol=1e-15)
        assert data["volume_m3"][data["body"] == number] == pytest.approx(body.volume, rel=1e-12)


def test_bodies_of_several_materials_have_their_own(tmp_path):
    other, (first, second) = Matter((DeltaBeta(-3e-7, -1e-10),)), bodies()
    write_vtu(tmp_path / "b.vtu", [first, second], [MATTER, other])
    data = pytest.importorskip("meshio").read(tmp_path / "b.vtu").cell_data
    counts = [len(first.faces), len(second.faces)]
    np.testing.assert_array_equal(data["delta"][0], np.repeat([4e-7, -3e-7], counts))
    np.testing.assert_array_equal(data["beta"][0], np.repeat([2e-10, -1e-10], counts))


def test_units_are_said(tmp_path):
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    write_vtu(tmp_path / "b.vtu", bodies(), [MATTER] * 2)
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "b.vtu"))
    reader.Update()
    assert reader.GetOutput().GetFieldData().GetArray("length_unit_m").GetValue(0) == 1e-6


def test_no_bodies_and_cut_off_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="at least one body"):
        write_vtu(tmp_path / "n.vtu", [], MATTER)
    write_vtu(tmp_path / "b.vtu", bodies(), [MATTER] * 2)
    content = (tmp_path / "b.vtu").read_bytes()
    (tmp_path / "b.vtu").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"b\.vtu must be a complete mesh file"):
        read_meshes(tmp_path / "b.vtu", "um")
    assert [p.name for p in tmp_path.iterdir()] == ["b.vtu"]
