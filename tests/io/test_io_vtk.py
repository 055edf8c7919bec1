"""VTK files of other programs and of VTK's own writers; truncation, damage, and VTK's silence."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkIdList, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkImageData, vtkPolyData, vtkUnstructuredGrid
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter, vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from holosplat.checks import InputError
from holosplat.io.solids import write_stl
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import evans_fung_cell, icosphere
from holosplat.specimens.repair import closed

UM = 1e-6
TETRAHEDRON = ((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 4))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
HEADER = "# vtk DataFile Version 3.0\ntest\nASCII\nDATASET {}\n"
STRIP, POLYGON, QUAD, TRIANGLE, TETRA, LINE = 6, 7, 9, 5, 10, 3


def dataset(cls, cells, points=TETRAHEDRON, strips=False, dtype=np.float32):
    """A vtkPolyData or vtkUnstructuredGrid of `cells`: lists of points, or (type, points)."""
    data, vtk_points = cls(), vtkPoints()
    vtk_points.SetData(numpy_to_vtk(np.asarray(points, dtype=dtype), deep=True))
    data.SetPoints(vtk_points)
    array = vtkCellArray()
    for cell in cells:
        kind, corners = cell if isinstance(cell[1], (list, tuple)) else (TRIANGLE, cell)
        ids = vtkIdList()
        for corner in corners:
            ids.InsertNextId(corner)
        if cls is vtkUnstructuredGrid:
            data.InsertNextCell(kind, ids)
        else:
            array.InsertNextCell(ids)
    if cls is vtkPolyData:
        (data.SetStrips if strips else data.SetPolys)(array)
    return data


def write(data, path, mode="Binary", compress=False):
    poly = data.IsA("vtkPolyData")
    if path.suffix == ".vtk":
        writer = vtkPolyDataWriter() if poly else vtkUnstructuredGridWriter()
        getattr(writer, {"Ascii": "SetFileTypeToASCII", "Binary": "SetFileTypeToBinary"}[mode])()
    else:
        writer = vtkXMLPolyDataWriter() if poly else vtkXMLUnstructuredGridWriter()
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetEncodeAppendedData(False)
        if not compress:
            writer.SetCompressorTypeToNone()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    assert writer.Write()
    return path


def volume_um3(mesh: TriangleMesh) -> float:
    return mesh.volume / UM**3


FORMATS = [
    ("vtk", "Ascii", False),
    ("vtk", "Binary", False),
    *(("xml", mode, compress) for mode in ("Ascii", "Binary", "Appended") for compress in (False, True)),
]


@pytest.fixture(params=FORMATS, ids=["-".join(map(str, f)) for f in FORMATS])
def sample(request, tmp_path):
    """A function writing a data set in one of VTK's formats."""
    kind, mode, compress = request.param

    def put(data):
        suffix = "vtk" if kind == "vtk" else "vtp" if data.IsA("vtkPolyData") else "vtu"
        return write(data, tmp_path / f"cell.{suffix}", mode, compress)

    return put


# --- what is read


@pytest.mark.parametrize("cls", [vtkPolyData, vtkUnstructuredGrid])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_triangles_of_every_format(sample, cls, dtype):
    path = sample(dataset(cls, FACES, dtype=dtype))
    (mesh,) = read_meshes([path], "um")
    assert mesh.name == path.name
    assert mesh.vertices == pytest.approx(np.array(TETRAHEDRON) * UM, rel=1e-6, abs=0)
    assert mesh.faces.tolist() == [list(f) for f in FACES]
    assert volume_um3(mesh) == pytest.approx(64 / 6)


def test_strips_of_polydata_and_grids(sample):
    strips = [[0, 2, 1, 3], [1, 3, 0, 2]]  # every second triangle of a strip is wound the other way
    for data in (
        dataset(vtkPolyData, strips, strips=True),
        dataset(vtkUnstructuredGrid, [(STRIP, strip) for strip in strips]),
    ):
        (mesh,) = read_meshes([sample(data)], "um")
        assert len(mesh.faces) == 4
        assert volume_um3(mesh) == pytest.approx(64 / 6)


def test_quads_and_polygons_are_cut_into_triangles(sample):
    cube = [(x, y, z) for z in (0, 2) for y in (0, 2) for x in (0, 2)]
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    grid = dataset(vtkUnstructuredGrid, [(QUAD, q) for q in quads[:3]] + [(POLYGON, q) for q in quads[3:]], cube)
    for data in (dataset(vtkPolyData, quads, cube), grid):
        (mesh,) = read_meshes([sample(data)], "um")
        assert len(mesh.faces) == 12
        assert volume_um3(mesh) == pytest.approx(8)


def test_strips_beside_triangles_in_one_grid(sample):
    mixed = [(STRIP, [0, 2, 1, 3]), (TRIANGLE, FACES[1]), (TRIANGLE, FACES[2]), (LINE, [0, 1])]
    (mesh,) = read_meshes([sample(dataset(vtkUnstructuredGrid, mixed))], "um")
    assert volume_um3(mesh) == pytest.approx(64 / 6)


def test_boundary_of_solid_cells(sample):
    solid = dataset(vtkUnstructuredGrid, [(TETRA, [0, 1, 2, 3])])
    assert volume_um3(closed(read_meshes([sample(solid)], "um")[0])) == pytest.approx(64 / 6)


def test_duplicate_vertices_become_one_and_order_is_kept(tmp_path):
    mesh = evans_fung_cell(subdivisions=1)
    torn = TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    write_mesh(tmp_path / "torn.vtk", torn)
    (read,) = read_meshes(tmp_path / "torn.vtk", "um")
    assert len(read.vertices) == 42
    assert closed(read).volume / mesh.volume == pytest.approx(1)
    order = [np.flatnonzero((np.abs(torn.vertices - v) < 1e-15).all(1))[0] for v in read.vertices]
    assert order == sorted(order)


def test_length_unit_scales_and_must_be_known(tmp_path):
    path = write(dataset(vtkPolyData, FACES), tmp_path / "cell.vtk")
    assert read_meshes(path, "mm")[0].volume / read_meshes(path, "um")[0].volume == pytest.approx(1e9)
    with pytest.raises(InputError, match=r"length_unit.*furlong"):
        read_meshes(path, "furlong")


@pytest.mark.parametrize(("scale", "unit"), [(1e30, "um"), (100, "m"), (1e-12, "um")])
def test_bodies_of_absurd_sizes_are_refused(tmp_path, scale, unit):
    """Their frames would be blank."""
    mesh = TriangleMesh(np.array(TETRAHEDRON, dtype=float), FACES)
    write_mesh(tmp_path / "a.vtp", mesh.transformed(scale * np.eye(3), np.zeros(3)), "m")
    with pytest.raises(InputError, match=r"a\.vtp must hold a body of 1e-09 m or more, at most 10 m from its origin"):
        read_meshes(tmp_path / "a.vtp", unit)


@pytest.mark.parametrize("suffix", [b".vtk", b".vtp", b".STL"])
def test_a_name_that_is_no_utf8_is_read_and_written(tmp_path, suffix):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xff"))
    folder.mkdir()
    path = folder / os.fsdecode(b"cell\xe9" + suffix)
    if suffix == b".STL":
        write_stl(path, [evans_fung_cell(8e-6, 1)])
    else:
        write_mesh(path, evans_fung_cell(8e-6, 1))
    (found,) = read_meshes(path, "um")
    assert found.name == f"cell\ufffd{suffix.decode()}"
    assert len(found.faces) == len(evans_fung_cell(8e-6, 1).faces)


def test_folders_are_read_in_natural_order(tmp_path):
    for number in (10, 9, 1):
        write(dataset(vtkPolyData, FACES), tmp_path / f"cell{number}.vtk")
    (tmp_path / "notes.txt").write_text("not a mesh")
    assert [m.name for m in read_meshes(tmp_path, "um")] == ["cell1.vtk", "cell9.vtk", "cell10.vtk"]


@pytest.mark.parametrize(("name", "start"), [("cell.vtk", b"# vtk DataFile"), ("cell.vtp", b"<?xml")])
def test_written_meshes_are_read_back(tmp_path, name, start):
    mesh = evans_fung_cell()
    for unit in ("um", "m"):
        write_mesh(tmp_path / name, mesh, unit)
        assert (tmp_path / name).read_bytes().startswith(start)
        (back,) = read_meshes(tmp_path / name, unit)
        assert back.vertices == pytest.approx(mesh.vertices, rel=1e-12, abs=0)
        assert np.array_equal(back.faces, mesh.faces)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_writing_where_one_cannot(tmp_path):
    with pytest.raises(InputError, match="existing folder"):
        write_mesh(tmp_path / "none" / "cell.vtk", evans_fung_cell())
    with pytest.raises(InputError, match="is a folder"):
        write_mesh(tmp_path, evans_fung_cell())


# --- files of another program


def test_red_cells_of_both_kinds(espresso_rbc):
    grids = read_meshes(sorted((espresso_rbc / "vtk").glob("rbc*_000.vtk")), "um")
    strips = read_meshes(espresso_rbc / "raw_oif_vtk" / "first", "um")
    assert len(grids) == len(strips) == 16
    for grid, strip in zip(grids, strips):
        assert grid.vertices.shape == (374, 3)
        assert grid.faces.shape == strip.faces.shape == (744, 3)
        assert volume_um3(grid) == pytest.approx(90.75, rel=0.0062)  # outward normals
        assert volume_um3(strip) == pytest.approx(-volume_um3(grid), rel=2e-3)  # inward ones
        assert volume_um3(closed(strip)) == pytest.approx(volume_um3(closed(grid)), rel=2e-3)
        assert np.array_equal(closed(grid).faces, grid.faces)
        # the same cell but for the periodic fold along x
        assert strip.vertices[:, 1:] == pytest.approx(grid.vertices[:, 1:], rel=0, abs=1e-3 * UM)


@pytest.mark.parametrize("name", ["vtk/rbc00_000.vtk", "raw_oif_vtk/first/cell0_0.vtk"])
def test_truncated_red_cells(espresso_rbc, tmp_path, capfd, name):
    truncations_are_noticed((espresso_rbc / name).read_bytes(), tmp_path / "cut.vtk", capfd)


# --- damage


def truncations_are_noticed(whole: bytes, path, capfd, steps: int = 40) -> None:
    """Every cut gives an InputError naming the file, or (if only a line's end is lost) the whole mesh."""
    path.write_bytes(whole)
    (complete,) = read_meshes(path, "um")
    tail = range(len(whole) - 12, len(whole))
    messages: list[str] = []
    for cut in sorted({*range(0, len(whole), max(1, len(whole) // steps)), *tail}):
        path.write_bytes(whole[:cut])
        try:
            (mesh,) = read_meshes(path, "um")
        except InputError as error:
            messages.append(str(error))
        else:
            assert not whole[cut:].strip(), f"cut at byte {cut} of {len(whole)} went unnoticed"
            assert np.array_equal(mesh.vertices, complete.vertices)
            assert np.array_equal(mesh.faces, complete.faces)
    assert all(str(path) in message for message in messages)
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


@pytest.mark.parametrize("cls", [vtkPolyData, vtkUnstructuredGrid])
def test_truncated_files(sample, cls, capfd):
    vertices, faces = icosphere(2)
    path = sample(dataset(cls, faces.tolist(), 4 * vertices))
    truncations_are_noticed(path.read_bytes(), path, capfd)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("solid ascii stl\n", "does not start like"),
        ("\x89PNG\r\n", "does not start like"),
        (HEADER.format("POLYDATA") + "POINTS 0 float\n", "truncated or damaged"),
        (HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 1 0 0 0 1 0\n", "3 points and 0 cells"),
        (
            HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 nan 0 0 0 1 0\nPOLYGONS 1 4\n3 0 1 2\n",
            "finite",
        ),
        (HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 1 0 0 0 1 0\nPOLYGONS 1 4\n3 0 1 3\n", "point 3"),
        (
            HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 1 0 0 0 1 0\nPOLYGONS 1 4\n3 0 1 -2\n",
            "damaged",
        ),
        (HEADER.format("POLYDATA") + "POINTS -3 float\n", "truncated or damaged"),
        (
            HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 1 0 0 0 1 0\nLINES 1 3\n2 0 1\n",
            "must hold triangles",
        ),
        (
            HEADER.format("POLYDATA") + "POINTS 3 float\n0 0 0 1 0 0 0 0 0\nPOLYGONS 1 4\n3 0 1 2\n",
            "degenerate",
        ),
        (
            HEADER.format("STRUCTURED_POINTS") + "DIMENSIONS 2 2 2\nORIGIN 0 0 0\nSPACING 1 1 1\n",
            "must hold a surface",
        ),
        (HEADER.format("NONSENSE"), "truncated or damaged"),
    ],
)
def test_bad_legacy_files(tmp_path, capfd, text, said):
    path = tmp_path / "bad.vtk"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=said) as error:
        read_meshes([path], "um")
    assert "bad.vtk" in str(error.value)
    assert "\n" not in str(error.value)
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


TRIANGLES = "POINTS 4 float\n0 0 0 4 0 0 0 4 0 0 0 4\nPOLYGONS 4 16\n3 0 2 1 3 0 1 3 3 0 3 2 3 1 2 3\n"


@pytest.mark.parametrize(
    ("good", "bad", "said"),
    [
        ("3 0 2 1", "9000 0 2 1", "POLYGONS must be 4 cells of 16 integers"),
        ("3 0 2 1", "-3 0 2 1", "cell 0 has -3 corners"),
        ("3 0 2 1", "3 0 2", "POLYGONS must hold 16 integers"),
        ("3 0 2 1", "3 0 x 1", "POLYGONS must hold 16 integers"),
        ("4 16", "4 15", "POLYGONS must be 4 cells of 15 integers"),
        ("4 16", "9 16", "POLYGONS must be 9 cells of 16 integers"),
        ("4 16", "4 999999999999", "it declares 999999999999 values"),
        ("3 1 2 3", "3 1 2 99999999", "point 99999999, but there are 4"),
        ("Version 3.0", "Version 5.1", "POLYGONS must be laid out"),
    ],
)
def test_damaged_cells_do_not_crash(tmp_path, good, bad, said):
    """VTK's reader follows such counts and indices out of its arrays, which ends the process."""
    text = HEADER.format("POLYDATA") + TRIANGLES
    assert good in text
    (tmp_path / "good.vtk").write_text(text)
    (tmp_path / "bad.vtk").write_text(text.replace(good, bad))
    assert volume_um3(read_meshes(tmp_path / "good.vtk", "um")[0]) == pytest.approx(64 / 6)
    with pytest.raises(InputError, match=said):
        read_meshes(tmp_path / "bad.vtk", "um")


@pytest.mark.parametrize("kind", [12, 3, 99, 0], ids=["hexahedron", "line", "unknown", "empty"])
def test_damaged_cell_types_do_not_crash(tmp_path, kind):
    cells = "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES)
    points = "POINTS 4 float\n0 0 0 4 0 0 0 4 0 0 0 4\n"
    text = HEADER.format("UNSTRUCTURED_GRID") + points + "CELLS 4 16\n" + cells + "CELL_TYPES 4\n5 5 {} 5\n"
    (tmp_path / "good.vtk").write_text(text.format(5))
    (tmp_path / "bad.vtk").write_text(text.format(kind))
    assert len(read_meshes(tmp_path / "good.vtk", "um")[0].faces) == 4
    with pytest.raises(InputError, match=f"type {kind} "):
        read_meshes(tmp_path / "bad.vtk", "um")


@pytest.mark.parametrize("cls", [vtkPolyData, vtkUnstructuredGrid])
def test_damaged_bytes_do_not_crash(tmp_path, cls):
    vertices, faces = icosphere(1)
    for mode in ("Ascii", "Binary"):
        path = write(dataset(cls, faces.tolist(), 4 * vertices), tmp_path / "cell.vtk", mode)
        whole = path.read_bytes()
        rng = np.random.default_rng(0)
        outcomes = set()
        for _ in range(150):
            spoilt = bytearray(whole)
            for place in rng.integers(len(whole), size=2):
                spoilt[place] = rng.integers(256)
            path.write_bytes(bytes(spoilt))
            try:
                outcomes.add(type(read_meshes(path, "um")))
            except InputError:
                outcomes.add(InputError)
        assert InputError in outcomes


def test_image_data_is_no_surface(tmp_path):
    image, writer = vtkImageData(), vtkXMLImageDataWriter()
    image.SetDimensions(2, 2, 2)
    writer.SetFileName(str(tmp_path / "image.vti"))
    writer.SetInputData(image)
    writer.Write()
    with pytest.raises(InputError, match=r"image\.vti.*ImageData"):
        read_meshes([tmp_path / "image.vti"], "um")


def test_missing_files_and_empty_folders(tmp_path):
    with pytest.raises(InputError, match=r"none\.vtk.*no such file"):
        read_meshes([tmp_path / "none.vtk"], "um")
    with pytest.raises(InputError, match="holds none"):
        read_meshes(tmp_path, "um")
    with pytest.raises(InputError, match="list of paths is empty"):
        read_meshes([], "um")


def test_vtk_speaks_again_afterwards(tmp_path, capfd):
    (tmp_path / "bad.vtk").write_text(HEADER.format("NONSENSE"))
    with pytest.raises(InputError):
        read_meshes(tmp_path / "bad.vtk", "um")
    writer = vtkPolyDataWriter()
    writer.SetFileName(str(tmp_path / "no" / "folder.vtk"))
    writer.SetInputData(vtkPolyData())
    writer.Write()
    captured = capfd.readouterr()
    assert "ERR" in captured.out + captured.err
