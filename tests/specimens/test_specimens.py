"""Red cells against Evans & Fung's published numbers, their placement against VTK's distances, and repair."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from scipy.integrate import quad
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

from holosplat.checks import InputError
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import (
    RedCell,
    _random_rotation,
    evans_fung_cell,
    icosphere,
    place_cells,
    random_cells,
)
from holosplat.specimens.repair import closed

UM = 1e-6


def near(value, rel=1e-6, abs=0.0):
    """pytest.approx without its absolute tolerance of 1e-12, which is more than most numbers here."""
    return pytest.approx(tuple(value) if isinstance(value, tuple) else value, rel=rel, abs=abs)


def thickness(r: float) -> float:
    """Evans & Fung's D(r) [µm] as printed, r in µm."""
    t = (r / 3.91) ** 2
    return math.sqrt(1 - t) * (0.81 + 7.83 * t - 4.39 * t**2)


def sphere(radius: float, centre=(0.0, 0.0, 0.0), inwards: bool = False) -> TriangleMesh:
    vertices, faces = icosphere(2)
    return TriangleMesh(radius * vertices + np.array(centre), faces[:, ::-1] if inwards else faces, "sphere")


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + o for m, o in zip(meshes, offsets)])
    return TriangleMesh(np.concatenate([m.vertices for m in meshes]), faces, "joined")


# --- the resting shape


def test_published_volume_area_and_thickness():
    """94 µm³, 135 µm², 0.81 and 2.58 µm (Evans & Fung 1972, table 3, 300 mosmol)."""
    cell = evans_fung_cell(subdivisions=5)
    assert cell.volume / UM**3 == near(94.1, abs=0.2)
    assert cell.area / UM**2 == near(135, abs=1.5)
    assert np.ptp(cell.vertices, axis=0) / UM == near([7.82, 7.82, 2.565], abs=0.01)
    middle = np.abs(cell.vertices[np.linalg.norm(cell.vertices[:, :2], axis=1) < 0.1 * UM, 2])
    assert 2 * middle.max() / UM == near(0.81, abs=0.01)


def test_vertices_lie_on_the_published_profile():
    x, y, z = evans_fung_cell().vertices.T / UM
    radius = np.minimum(np.hypot(x, y), 3.91)
    assert 2 * np.abs(z) == near(np.array([thickness(r) for r in radius]), abs=1e-6)


def test_mesh_converges_to_the_solid_of_revolution_with_order_two():
    exact = 2 * math.pi * quad(lambda r: r * thickness(r), 0, 3.91)[0]
    errors = [exact - evans_fung_cell(subdivisions=s).volume / UM**3 for s in (2, 3, 4, 5)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == near([2, 2, 2], abs=0.15)
    assert errors[1] / exact < 0.01  # the default mesh


def test_default_mesh_is_closed_outward_and_scales():
    cell = evans_fung_cell()
    assert len(cell.vertices) == 642
    assert np.array_equal(closed(cell).faces, cell.faces)
    large = evans_fung_cell(64e-6)
    assert large.volume / cell.volume == near((64 / 7.82) ** 3)
    assert np.ptp(large.vertices[:, 0]) == near(64e-6, rel=1e-6)


def test_inside_test_agrees_with_the_profile():
    rng = np.random.default_rng(1)
    points = rng.uniform([-4.5, -4.5, -2], [4.5, 4.5, 2], (20000, 3))
    radius = np.hypot(points[:, 0], points[:, 1])
    half = np.array([0.5 * thickness(r) if r < 3.91 else -1.0 for r in radius])
    assert np.array_equal(RedCell().contains(points * UM), np.abs(points[:, 2]) < half)


def test_inside_test_of_a_deformed_turned_cell_follows_its_surface():
    cell = place_cells(1, (30 * UM,) * 3, seed=4, deform=0.05)[0]
    vertices, _ = icosphere(4)
    assert cell.level(cell.surface(vertices)) == near(np.ones(len(vertices)), abs=1e-9)
    assert cell.contains(cell.surface(0.999 * vertices)).all()
    assert not cell.contains(cell.surface(1.001 * vertices)).any()


def test_icosphere_is_regular_and_nested():
    fine, faces = icosphere(3)
    assert fine.shape == (642, 3)
    assert faces.shape == (1280, 3)
    assert np.array_equal(fine[:162], icosphere(2)[0])
    assert np.linalg.norm(fine, axis=1) == near(np.ones(642))
    with pytest.raises(InputError, match="subdivisions"):
        icosphere(2.5)


# --- placement


def polydata(mesh: TriangleMesh) -> vtkPolyData:
    data, points, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.vertices / UM), deep=True))
    rows = np.concatenate([np.full((len(mesh.faces), 1), 3), mesh.faces], axis=1)
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(rows.reshape(-1).astype(np.int64), deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data


def clear_distance(meshes: list[TriangleMesh]) -> float:
    """Smallest distance [µm] from a vertex of one mesh to another's surface, by VTK; negative inside."""
    smallest = math.inf
    for i, mesh in enumerate(meshes):
        signed = vtkImplicitPolyDataDistance()
        signed.SetInput(polydata(mesh))
        low, high = mesh.bounds
        for j, other in enumerate(meshes):
            close = other.vertices[((other.vertices > low - UM) & (other.vertices < high + UM)).all(1)]
            if i != j:
                smallest = min([smallest, *(signed.EvaluateFunction(p) for p in close / UM)])
    return smallest


def test_crowded_cells_keep_their_distance():
    box = (24 * UM, 20 * UM, 22 * UM)
    meshes = random_cells(14, box, seed=3, margin=0.3 * UM, shape="box")
    assert 0.27 < clear_distance(meshes) < 0.6  # crowded enough to mean something
    limits = np.array(box) / 2 - 0.3 * UM
    assert all((np.abs(m.vertices) <= limits + 1e-12).all() for m in meshes)


def test_no_point_lies_in_two_cells():
    cells = place_cells(18, (24 * UM, 20 * UM, 22 * UM), seed=5, deform=0.06, shape="box")
    points = np.random.default_rng(0).uniform([-12, -10, -11], [12, 10, 11], (60000, 3)) * UM
    owners = sum(cell.contains(points).astype(int) for cell in cells)
    assert owners.max() == 1
    filled = sum(cell.mesh(5).volume for cell in cells) / (24 * 20 * 22 * UM**3)
    assert (owners > 0).mean() == near(filled, rel=0.05)


def test_benchmark_scene_is_quick_and_inside_the_cylinder():
    start = time.perf_counter()
    meshes = random_cells(24, (409.6 * UM,) * 3, seed=0, diameter=64 * UM)
    assert time.perf_counter() - start < 2
    assert len(meshes) == 24
    assert meshes[0].name != meshes[1].name
    for mesh in meshes:
        x, y, z = mesh.vertices.T
        assert np.hypot(x, z).max() <= 204.8 * UM
        assert np.abs(y).max() <= 204.8 * UM
    assert clear_distance(meshes) > 0


def test_seed_reproduces_the_cells():
    first, again, other = (random_cells(5, (60 * UM,) * 3, seed=s) for s in (7, 7, 8))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, again))
    assert not np.array_equal(first[0].vertices, other[0].vertices)


@pytest.mark.parametrize(("deform", "strain"), [(0.0, 1e-12), (0.03, 0.06), (0.1, 0.6)])
def test_deformation_keeps_the_volume_and_nearly_the_area(deform, strain):
    rest = evans_fung_cell()
    for mesh in random_cells(20, (120 * UM,) * 3, seed=2, deform=deform):
        assert mesh.volume == near(rest.volume, rel=1e-3)
        assert -1e-12 <= mesh.area / rest.area - 1 <= strain


def test_deform_is_the_typical_bending_in_diameters():
    vertices, _ = icosphere(4)
    squares = []
    for cell in place_cells(60, (200 * UM,) * 3, seed=6, deform=0.04):
        flat = RedCell(cell.diameter, cell.rotation, cell.centre, stretch=cell.stretch)
        moved = cell.surface(vertices) - flat.surface(vertices)
        inner = np.hypot(vertices[:, 0], vertices[:, 1])
        weights = np.abs(vertices[:, 2]) * (inner < 1)  # the sphere's area, projected onto the disc
        squares.append(np.average((moved**2).sum(1), weights=weights))
    assert math.sqrt(np.mean(squares)) / (7.82 * UM) == near(0.04, rel=0.2)


def test_rotations_are_uniform():
    rng = np.random.default_rng(0)
    rotations = np.stack([_random_rotation(rng) for _ in range(4000)])
    assert rotations @ rotations.transpose(0, 2, 1) == near(np.broadcast_to(np.eye(3), (4000, 3, 3)), abs=1e-12)
    assert np.abs(rotations.mean(0)).max() < 0.04
    assert (rotations**2).mean(0) == near(np.full((3, 3), 1 / 3), abs=0.03)


def test_cells_that_do_not_fit():
    with pytest.raises(InputError, match=r"200 red cells of 7\.82 µm must fit.*would fill 297% of it"):
        random_cells(200, (20 * UM,) * 3)
    with pytest.raises(InputError, match="would fill 75% of it"):
        random_cells(1, (5 * UM,) * 3, shape="box")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"count": 0}, "number of red cells"),
        ({"count": 2.5}, "number of red cells"),
        ({"box": (1e-5, 1e-5)}, "three extents"),
        ({"box": (1e-5, -1e-5, 1e-5)}, "box extent y"),
        ({"box": (60, 60, 60)}, "box extent x"),
        ({"diameter": 0.0}, "cell diameter"),
        ({"diameter": 7.82}, "cell diameter"),
        ({"deform": 0.5}, "deform"),
        ({"deform": math.nan}, "deform"),
        ({"margin": -1e-6}, "margin"),
        ({"shape": "sphere"}, "shape"),
    ],
)
def test_bad_arguments(change, said):
    with pytest.raises(InputError, match=said):
        random_cells(**{"count": 2, "box": (60 * UM,) * 3, **change})


# --- repair


def test_closed_returns_a_good_mesh_unchanged():
    mesh = sphere(UM)
    same = closed(mesh)
    assert np.array_equal(same.vertices, mesh.vertices)
    assert np.array_equal(same.faces, mesh.faces)


def test_closed_turns_meshes_outwards():
    assert closed(sphere(UM, inwards=True)).volume == near(sphere(UM).volume)


def test_closed_unifies_scrambled_winding():
    mesh = joined(sphere(UM), sphere(UM, (3 * UM, 0, 0)), sphere(2 * UM, (0, 9 * UM, 0)))
    swap = np.random.default_rng(0).random(len(mesh.faces)) < 0.4
    scrambled = TriangleMesh(mesh.vertices, np.where(swap[:, None], mesh.faces[:, ::-1], mesh.faces))
    assert closed(scrambled).volume == near(10 * sphere(UM).volume)


@pytest.mark.parametrize(("outer", "inner"), [(False, False), (False, True), (True, False), (True, True)])
def test_closed_keeps_the_sense_of_inner_shells_relative_to_the_outer(outer, inner):
    shell, core = sphere(2 * UM, inwards=outer), sphere(UM, inwards=inner)
    one = sphere(UM).volume
    assert closed(joined(shell, core)).volume == near((8 + (1 if outer == inner else -1)) * one)


def test_closed_makes_an_inconsistent_inner_shell_a_cavity():
    mesh = joined(sphere(2 * UM), sphere(UM))
    faces = mesh.faces.copy()
    faces[-7:] = faces[-7:, ::-1]
    assert closed(TriangleMesh(mesh.vertices, faces)).volume == near(7 * sphere(UM).volume)


def test_closed_joins_torn_vertices_and_drops_degenerate_triangles():
    mesh = sphere(UM)
    soup = mesh.vertices[mesh.faces].reshape(-1, 3)
    unused = np.array([[9e-6, 9e-6, 9e-6]])
    faces = np.concatenate([np.arange(len(soup)).reshape(-1, 3), [[0, 0, 5], [4, 7, 4]]])
    repaired = closed(TriangleMesh(np.concatenate([unused, soup]), faces + 1))
    assert repaired.vertices.shape == mesh.vertices.shape
    assert repaired.faces.shape == mesh.faces.shape
    assert repaired.volume == near(mesh.volume)


def test_closed_drops_a_sliver_that_hangs_on():
    mesh = sphere(UM)
    a, b = mesh.faces[0, :2]
    middle = 0.5 * (mesh.vertices[a] + mesh.vertices[b])
    spoiled = TriangleMesh(
        np.concatenate([mesh.vertices, middle[None]]),
        np.concatenate([mesh.faces, [[a, b, len(mesh.vertices)]]]),
    )
    assert closed(spoiled).volume == near(mesh.volume)


def test_closed_says_how_many_edges_are_open_and_where():
    mesh = sphere(UM, (10 * UM, 20 * UM, 30 * UM))
    hole = TriangleMesh(mesh.vertices, mesh.faces[1:], "cell07.vtk")
    with pytest.raises(InputError, match=r"cell07\.vtk .*3 open edges.*near \(.*\) um") as error:
        closed(hole)
    place = [float(v) for v in str(error.value).split("near (")[1].split(")")[0].split(",")]
    corners = mesh.vertices[mesh.faces[0]] / UM
    assert np.linalg.norm(place - corners.mean(0)) < np.linalg.norm(corners[0] - corners[1])
    with pytest.raises(InputError, match=r"near \(.*e-05.*\) m;"):
        closed(hole, length_unit="m")


def test_closed_says_non_manifold():
    mesh = sphere(UM)
    doubled = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:1]]))
    with pytest.raises(InputError, match="3 non-manifold edges"):
        closed(doubled)


def test_closed_says_flat():
    flat = TriangleMesh(np.eye(3) * UM, np.array([[0, 1, 2], [2, 1, 0]]))
    with pytest.raises(InputError, match="enclose"):
        closed(flat)


def test_closed_says_one_sided():
    """A Klein bottle: a torus grid, glued with a reflection in one direction (closed, without an inside)."""
    n = 8
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def index(i, j):
        return (i % n) * n + np.where(i >= n, -j, j) % n

    corners = [index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)]
    a, b, c, d = (x.reshape(-1) for x in corners)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.random.default_rng(0).random((n * n, 3)) * UM
    with pytest.raises(InputError, match="one side"):
        closed(TriangleMesh(vertices, faces))
