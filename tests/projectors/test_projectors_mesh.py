"""Line integrals and voxel occupancy of meshes against closed forms: spheres, boxes, cavities; and voxels.

Lengths are in units of the detector's pitch (`Views` takes any unit of length); rasters are rectangular.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.mesh import TriangleMesh
from holosplat.projectors.mesh import mesh_line_integrals, reference, voxelise_meshes
from holosplat.projectors.voxels import SliceProjector, voxel_line_integrals

SHAPE = (33, 46)


def icosphere(subdivisions: int, radius: float = 1.0) -> TriangleMesh:
    """An icosahedron subdivided and blown up, outward oriented; its vertices lie on the sphere."""
    g = (1 + 5**0.5) / 2
    points = [np.roll((0.0, a, b * g), k) for k in range(3) for a in (-1, 1) for b in (-1, 1)]
    vertices = np.array(points) / np.hypot(1, g)
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) < 1.06  # the edges are 1.0515 long
    triples = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[k, i]
    ]
    faces = np.array([t if np.linalg.det(vertices[list(t)]) > 0 else t[::-1] for t in triples])
    for _ in range(subdivisions):
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        ab, bc, ca = a + b, b + c, c + a
        soup = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
        soup /= np.linalg.norm(soup, axis=1, keepdims=True)
        vertices, faces = np.unique(soup.round(12), axis=0, return_inverse=True)
        faces = faces.reshape(-1, 3)
    return TriangleMesh(radius * vertices, faces)


def box(low, high, pieces: int = 1) -> TriangleMesh:
    """The box from corner `low` to `high`; each side is made of `pieces²` squares of two triangles."""
    low, high, n = np.asarray(low, float), np.asarray(high, float), pieces
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(n)))
    corners = np.stack([np.stack([i + a, j + b], 1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1))], 1)
    flat = corners.reshape(-1, 2) / n
    soup = []
    for axis in range(3):
        for side in (0.0, 1.0):
            points = np.roll(np.insert(flat, 2, side, axis=1), axis + 1, axis=1)  # flat side along `axis`
            soup.append(points if side else points.reshape(-1, 3, 3)[:, ::-1].reshape(-1, 3))
    points = np.concatenate(soup)
    return TriangleMesh(low + points * (high - low), np.arange(len(points)).reshape(-1, 3)).merged()


def joined(*meshes: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of several meshes in one."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return np.concatenate([m.vertices for m in meshes]), np.concatenate([m.faces + s for m, s in zip(meshes, starts)])


def image(mesh: TriangleMesh, views: Views, rays: int = 1) -> np.ndarray:
    """Thickness [V, H, W] of one mesh."""
    return mesh_line_integrals(mesh.vertices, mesh.faces, np.ones((1, len(mesh.faces))), views, rays)[:, 0].numpy()


def poses(count: int, shape: tuple[int, int] = SHAPE, seed: int = 0) -> Views:
    """Views from all directions, on detectors shifted by a few pixels, of pitch 1."""
    shifts = np.random.default_rng(seed).uniform(-2, 2, (count, 2))
    return Views(Rotation.random(count, rng=seed).as_matrix(), shifts, shape, 1.0)


def lab_points(views: Views, v: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of pixel centres of view v: x [1, W], y [H, 1] (docs/conventions.md)."""
    (h, w), p, (sx, sy) = views.shape, views.pixel_size, views.shifts[v]
    return ((np.arange(w) + 0.5 - w / 2) * p + sx)[None], ((np.arange(h) + 0.5 - h / 2) * p + sy)[:, None]


def sphere_chords(views: Views, centre: np.ndarray, radius: float) -> np.ndarray:
    """Chords `2 √(R² - r²)` [V, H, W] of a ball, at pixel centres."""
    chords = []
    for v, rotation in enumerate(views.rotations):
        (x, y), (cx, cy, _) = lab_points(views, v), rotation @ centre
        chords.append(2 * np.sqrt(np.clip(radius**2 - (x - cx) ** 2 - (y - cy) ** 2, 0, None)))
    return np.stack(chords)


def box_chords(views: Views, low, high) -> np.ndarray:
    """Chords [V, H, W] of a box by the slab method in the object frame, at pixel centres."""
    chords = []
    for v, rotation in enumerate(views.rotations):
        x, y = lab_points(views, v)
        start = x[..., None] * rotation[0] + y[..., None] * rotation[1]  # Rᵀ (x, y, 0)
        with np.errstate(divide="ignore"):
            near, far = ((np.asarray(bound, float) - start) / rotation[2] for bound in (low, high))
        enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
        chords.append(np.clip(leave - enter, 0, None))
    return np.stack(chords)


BOX = ((-7.3, -4.1, -5.9), (3.2, 8.6, 6.5))


def test_the_test_bodies_are_right():
    assert icosphere(0).volume == pytest.approx(2.5361507, rel=1e-7)  # of the icosahedron in the unit sphere
    assert icosphere(4).volume == pytest.approx(4 / 3 * np.pi, rel=3e-3)
    assert box(*BOX).volume == pytest.approx(10.5 * 12.7 * 12.4, rel=1e-12)
    assert box(*BOX, pieces=3).volume == pytest.approx(10.5 * 12.7 * 12.4, rel=1e-12)
    assert len(box(*BOX, pieces=3).faces) == 6 * 9 * 2


# --- line integrals -----------------------------------------------------------------------------------------


def test_sphere_converges_with_the_square_of_the_edges():
    """Chords of inscribed polyhedra: each subdivision halves the edges and quarters the mean error."""
    views, centre = poses(3), np.array([2.3, -1.7, 4.0])
    truth = sphere_chords(views, centre, 9.0)
    assert truth.max() > 17.9
    bodies = [icosphere(n, 9.0).transformed(np.eye(3), centre) for n in (2, 3, 4)]
    errors = np.array([np.abs(image(body, views) - truth).mean() for body in bodies])
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all((orders > 1.8) & (orders < 2.2)), orders
    assert errors[-1] < 3e-3 * truth.mean()


@pytest.mark.parametrize("pieces", [1, 4])
def test_box_is_exact_at_any_angle(pieces):
    views = poses(6)
    assert np.abs(image(box(*BOX, pieces), views) - box_chords(views, *BOX)).max() < 1e-5


def test_a_pixel_is_the_mean_of_its_rays():
    views, rays = poses(2), 3
    (h, w), fine = views.shape, box_chords(views.refined(rays), *BOX)
    means = fine.reshape(2, h, rays, w, rays).mean((2, 4))
    assert np.abs(image(box(*BOX), views, rays) - means).max() < 1e-5


@pytest.mark.parametrize("body", [icosphere(3, 9.0), box(*BOX)], ids=["sphere", "box"])
def test_mass_is_kept_in_every_pose(body):
    """Σ thickness · p² is the volume, whatever the pose; a finer raster comes closer."""
    views = poses(5)
    for factor, bound in ((1, 1e-2), (4, 1e-3)):
        fine = views.refined(factor)
        mass = image(body, fine).sum((1, 2)) * fine.pixel_size**2
        assert np.abs(mass / body.volume - 1).max() < bound


def test_units_scale():
    """Lengths in metres as in pixels: a micrometre of matter is 1e-6, on a raster of any pitch."""
    views, scale = poses(2), 3.1e-7
    metres = Views(views.rotations, views.shifts * scale, views.shape, scale)
    small = replace(box(*BOX), vertices=box(*BOX).vertices * scale)
    assert np.abs(image(small, metres) / scale - image(box(*BOX), views)).max() < 1e-6


def test_the_conventions():
    """x_lab = R x_obj, R(θ) about y, columns along x, rows along y (down), and a shift moves the detector."""
    mark = box((5, -9, -2), (7, -6, 3))  # right of the axis, above the middle; 2 × 3 × 5
    views = Views.from_angles([0, 90], (31, 41), 1.0)
    front, side = image(mark, views)
    rows, columns = np.nonzero(front)
    assert (rows.mean() - 15, columns.mean() - 20) == pytest.approx((-7.5, 6.0), abs=0.51)
    assert np.unique(front.round(6)).tolist() == [0, 5]
    rows, columns = np.nonzero(side)  # at 90°, x_lab = z_obj
    assert (rows.mean() - 15, columns.mean() - 20) == pytest.approx((-7.5, 0.5), abs=0.51)
    assert np.unique(side.round(6)).tolist() == [0, 2]
    moved = image(mark, replace(views, shifts=np.array([[4.0, -3.0], [4.0, -3.0]])))
    assert np.allclose(moved[0, 3:, :-4], front[:-3, 4:], atol=1e-6)


def test_opposite_views_are_mirrored():
    views = Views.from_angles([23.0, 203.0], (31, 45), 1.0)
    front, back = image(box(*BOX), views)
    assert np.abs(front[:, ::-1] - back).max() < 1e-5
    assert np.abs(front - back).max() > 1


def test_bodies_have_values_and_cavities():
    """Channels are independent, bodies add up, an inward shell takes away, the order of faces is free."""
    views, inner = poses(4), ((-3.1, -1.0, -2.2), (1.7, 5.3, 4.4))
    outside, hole = box(*BOX), box(*inner)
    hole = replace(hole, faces=hole.faces[:, ::-1])
    other = box((0.0, 0.0, 0.0), (9.0, 7.0, 5.0))
    vertices, faces = joined(outside, hole, other)
    values = np.repeat([[2.0, 2.0, -0.5], [0.0, 0.0, 3.0]], 12, axis=1)  # δ and β of two bodies
    got = mesh_line_integrals(vertices, faces, values, views, rays=1).numpy()
    shell, solid = (
        box_chords(views, *BOX) - box_chords(views, *inner),
        box_chords(views, (0, 0, 0), (9, 7, 5)),
    )
    assert got.dtype == np.float64
    assert np.abs(got[:, 0] - (2 * shell - 0.5 * solid)).max() < 3e-5
    assert np.abs(got[:, 1] - 3 * solid).max() < 3e-5
    order = np.random.default_rng(0).permutation(len(faces))
    mixed = mesh_line_integrals(vertices, faces[order], values[:, order], views, rays=1).numpy()
    assert np.abs(got - mixed).max() < 1e-12


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("pieces", [1, 8])
@pytest.mark.parametrize("shape", [(21, 31), (20, 30)])
def test_vertices_on_rays_leave_no_cracks_and_no_doubles(shape, pieces, exact):
    """A cube with corners and inner vertices on rays: 8 × 8 rays see its full depth, the others nothing.

    Also when rounding (cos 90° = 6e-17) tilts the faces along the beam a little.
    """
    move = 0.0 if shape[0] % 2 else 0.5
    cube = box((-4 + move,) * 3, (4 + move,) * 3, pieces)
    views = Views.from_angles([0, 90, 180, 270], shape, 1.0)
    if exact:
        views = replace(views, rotations=views.rotations.round())
    for thickness in image(cube, views):
        assert np.allclose(thickness[thickness != 0], 8, rtol=1e-12)
        assert np.count_nonzero(thickness) == 64


def test_what_lies_outside_the_detector_is_ignored():
    views = poses(3)
    seen = image(box(*BOX), views)
    small = image(box(*BOX), replace(views, shape=(9, 12)))
    assert np.abs(seen[:, 12:21, 17:29] - small).max() < 1e-12
    assert not image(box((90, 0, 0), (99, 5, 5)), views).any()


# --- occupancy ----------------------------------------------------------------------------------------------

UNEVEN = Grid((21, 17, 30), (0.8, 1.3, 0.9), (-11.0, -9.5, -8.7))


def occupied(mesh: TriangleMesh, grid: Grid, rays: int = 4) -> np.ndarray:
    """Partial occupancy [Z, Y, X] of one mesh."""
    return voxelise_meshes(mesh.vertices, mesh.faces, np.ones((1, len(mesh.faces))), grid, rays)[0]


@pytest.mark.parametrize("body", [icosphere(3, 6.5), box((-6.1, -5.2, -7.3), (5.5, 7.7, 6.9))], ids=["sphere", "box"])
def test_occupancy_adds_up_to_the_volume(body):
    part = occupied(body, UNEVEN, rays=16)
    assert part.min() > -1e-9
    assert part.max() < 1 + 1e-9
    assert part.sum() * np.prod(UNEVEN.voxel_size) == pytest.approx(body.volume, rel=3e-3)
    x, y, z = UNEVEN.axes()
    centre = [float((part * axis).sum() / part.sum()) for axis in (x, y[:, None], z[:, None, None])]
    middle = np.mean(body.bounds, axis=0)
    assert centre == pytest.approx(middle, abs=0.02)


def test_a_slab_fills_voxels_by_their_share():
    """Depth is exact: a slab from 0.3 into a voxel to 0.75 into another; across, half the rays of a voxel."""
    (dx, dy, dz), (ox, oy, oz) = UNEVEN.voxel_size, UNEVEN.origin
    slab = box((-99, -99, oz + (4.5 + 0.3) * dz), (99, 99, oz + (8.5 + 0.75) * dz))
    assert np.allclose(occupied(slab, UNEVEN)[4:11, 3, 5], [0, 0.7, 1, 1, 1, 0.75, 0], atol=1e-9)
    wall = box((ox + 3 * dx, -99, -99), (ox + 6 * dx, 99, 99))
    assert np.allclose(occupied(wall, UNEVEN)[7, 3, 2:8], [0, 0.5, 1, 1, 0.5, 0], atol=1e-9)
    floor = box((-99, oy + 3 * dy, -99), (99, oy + 6 * dy, 99))
    assert np.allclose(occupied(floor, UNEVEN)[7, 2:8, 5], [0, 0.5, 1, 1, 0.5, 0], atol=1e-9)


def test_bodies_may_reach_beyond_the_grid():
    """Whatever lies outside is cut, on every side, and fills nothing inside."""
    wide = occupied(box((-99,) * 3, (99,) * 3), UNEVEN)
    assert np.allclose(wide, 1, atol=1e-9)
    for axis in range(3):
        for side in (-50.0, 50.0):
            away = np.zeros(3)
            away[axis] = side
            assert np.abs(occupied(box(away - 9, away + 9), UNEVEN)).max() < 1e-9


def test_occupancy_along_a_view_is_the_line_integral():
    """Summed along z, voxels hold what the same rays see from there."""
    views = Views.from_angles([0], (25, 31), 1.0)
    body = icosphere(2, 8.0).transformed(np.eye(3), np.array([1.3, -0.4, 2.2]))
    grid = replace(Grid.of_views(views), shape=(40, 25, 31), voxel_size=(1.0, 1.0, 0.7), origin=(-15.0, -12.0, -14.0))
    assert np.abs(occupied(body, grid, rays=3).sum(0) * 0.7 - image(body, views, rays=3)[0]).max() < 1e-9


def test_values_of_voxels():
    """Two channels, bodies that add up, and a cavity."""
    outside, hole = box((-6,) * 3, (6,) * 3), box((-2,) * 3, (2,) * 3)
    vertices, faces = joined(outside, replace(hole, faces=hole.faces[:, ::-1]))
    values = np.stack([np.full(24, 2.0), np.repeat([1.0, 0.0], 12)])
    shell, solid = voxelise_meshes(vertices, faces, values, UNEVEN)
    cell = np.prod(UNEVEN.voxel_size)
    assert shell.sum() * cell == pytest.approx(2 * (12**3 - 4**3), rel=5e-3)
    assert solid.sum() * cell == pytest.approx(12**3, rel=5e-3)
    assert shell[9, 7, 14] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("rays", [1, 3])
def test_batches_change_nothing(monkeypatch, rays):
    """Overlapping bodies, one of them cut by the field, in views about no axis in particular."""
    vertices, faces = joined(icosphere(2, 6.0), *(
        icosphere(2, radius).transformed(np.eye(3), np.array(at))
        for radius, at in ((3.5, (4.0, -3.0, 2.0)), (4.0, (21.0, 2.0, -5.0)))
    ))  # fmt: skip
    values = np.random.default_rng(0).normal(size=(2, len(faces)))
    whole = mesh_line_integrals(vertices, faces, values, poses(3), rays, "reference")
    monkeypatch.setattr(reference, "MAX_HITS", {"cpu": 100})
    parts = mesh_line_integrals(vertices, faces, values, poses(3), rays, "reference")
    assert torch.allclose(parts, whole, rtol=0, atol=1e-12 * float(whole.abs().max()))


@pytest.mark.parametrize("shape", [(33, 46), (1, 7), (40, 9)])
@pytest.mark.parametrize("source", [None, 90.0])
@pytest.mark.parametrize("rays", [1, 2, 3])
def test_the_kernel_is_its_twin(shape, source, rays):
    """Meshes with a cavity that overlap and that the field cuts, in parallel beams and in cones; for every number of
    threads to the last bit, though each has its own rows."""
    hole = icosphere(2, 3.0)
    vertices, faces = joined(
        icosphere(3, 9.0),
        replace(hole, faces=hole.faces[:, ::-1]),
        icosphere(2, 4.0).transformed(np.eye(3), np.array([21.0, 2.0, -5.0])),
        box((-8.0, -30, -3), (-2.0, 30, 3), 4),
    )
    values = np.random.default_rng(0).normal(size=(2, len(faces)))
    views = poses(3, shape)
    views = views if source is None else replace(views, sources=np.full(3, source))
    wanted = mesh_line_integrals(vertices, faces, values, views, rays, "reference")
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.append(mesh_line_integrals(vertices, faces, values, views, rays, "cpu"))
    finally:
        torch.set_num_threads(threads)
    assert float(wanted.abs().max()) > 5
    assert torch.allclose(found[0], wanted, rtol=0, atol=1e-12 * float(wanted.abs().max()))
    assert all(torch.equal(one, found[0]) for one in found[1:])


def test_an_empty_field_is_no_trouble():
    body = box((-3.0, -3, -3), (3.0, 3, 3)).transformed(np.eye(3), np.array([1e3, 0, 0]))
    assert not image(body, poses(1)).any()


# --- between projectors -------------------------------------------------------------------------------------


def test_voxels_approach_the_mesh():
    """Line integrals of the occupancy, by rays and by slices, converge to the mesh's as voxels shrink."""
    body = icosphere(3, 8.0).transformed(np.eye(3), np.array([1.3, -0.4, 2.2]))
    views = Views.from_angles([0.0, 17.0, 64.0, 121.0], (25, 31), 1.0)
    errors = {"rays": [], "slices": []}
    for factor in (1, 2, 4):
        fine, grid = views.refined(factor), Grid.of_views(views, factor)
        truth = image(body, fine, rays=4)
        voxels = torch.from_numpy(occupied(body, grid))
        by_rays = voxel_line_integrals(voxels[None], grid, fine)[:, 0].numpy()
        slices = SliceProjector(grid, fine)
        by_slices = slices.lines_out(slices.project(slices.volume_in(voxels.float()))).numpy()
        for name, lines in (("rays", by_rays), ("slices", by_slices)):
            errors[name].append(np.abs(lines - truth).mean() / truth.mean())
    for name, values in errors.items():
        assert values[2] < 4e-3, (name, values)
        assert np.all(np.diff(np.log2(values)) < -1.2), (name, values)


# --- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("corner", [-1, 8])
def test_faces_name_vertices_that_are_there(corner):
    faces = np.full((12, 3), corner)
    with pytest.raises(InputError, match=f"faces must name vertices 0 to 7, but one names {corner}"):
        mesh_line_integrals(np.zeros((8, 3)), faces, np.zeros((1, 12)), poses(1))


@pytest.mark.parametrize(
    ("vertices", "faces", "values", "rays", "message"),
    [
        ((8, 2), (12, 3), (1, 12), 1, "vertices"),
        ((8, 3), (12, 4), (1, 12), 1, "faces"),
        ((8, 3), (12, 3), (1, 11), 1, "face_values"),
        ((8, 3), (12, 3), (1, 12), 0, "rays"),
    ],
)
def test_bad_input_is_named(vertices, faces, values, rays, message):
    arrays = np.zeros(vertices), np.zeros(faces, dtype=np.int64), np.zeros(values)
    with pytest.raises(InputError, match=message):
        mesh_line_integrals(*arrays, poses(1), rays)
    with pytest.raises(InputError, match=message):
        voxelise_meshes(*arrays, UNEVEN, rays)
