"""Deformable surfaces: their projector against closed forms and the other mesh projector, its gradient, extraction,
and the Object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.bumpy import BETA, DELTA, SHAPE, bumpy, poses, surfaces
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.model import measure
from holosplat.projectors.mesh import mesh_line_integrals, voxelise_meshes
from holosplat.projectors.surface import surface_occupancy, surface_thickness
from holosplat.representations import SurfaceMesh, isosurface
from holosplat.scan import Exposures
from holosplat.specimens.repair import closed
from holosplat.specimens.scene import MeshScene


def tensors(mesh: TriangleMesh) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(mesh.vertices.copy()), torch.from_numpy(mesh.faces.copy())


def thickness(vertices: Tensor, faces: Tensor, views: Views, lines: int = 2, backend: str = "cpu") -> Tensor:
    """Thickness [V, H, W] in the units of the vertices."""
    at, p = Poses.of(views), views.pixel_size
    return p * surface_thickness(vertices / p, faces, at.rotations, at.shifts / p, views.shape, lines, backend)


def volume_gradient(vertices: Tensor, faces: Tensor) -> Tensor:
    """Derivative of the enclosed volume, by autograd of Σ a·(b × c)/6."""
    leaf = vertices.clone().requires_grad_()
    a, b, c = leaf[faces].unbind(1)
    ((a * torch.linalg.cross(b, c)).sum() / 6).backward()
    assert leaf.grad is not None
    return leaf.grad


# --- the projector ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("edges", [None, (1.0, 1.3, 0.8, 1.0)])
@pytest.mark.parametrize("shape", [(31, 44), (1, 44), (31, 1)])
def test_the_compiled_gradient_is_the_plain_one(shape, edges):
    vertices, faces = tensors(bumpy(4, 12.0, (20.0, -9.0, 40.0)))  # partly outside of the raster
    at = Poses.of(poses(4, shape))
    pixels = None if edges is None else torch.tensor(edges, dtype=torch.float64)
    upstream = torch.from_numpy(np.random.default_rng(0).normal(size=(4, *shape)))
    both = []
    for backend in ("cpu", "reference"):
        leaf = vertices.clone().requires_grad_()
        image = surface_thickness(leaf, faces, at.rotations, at.shifts, shape, 2, backend, pixels=pixels)
        image.backward(upstream)
        assert leaf.grad is not None
        both.append(leaf.grad)
    assert both[0].abs().max() > 0.1
    assert torch.allclose(*both, rtol=0, atol=1e-12)


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_the_compiled_kernel_is_the_plain_one(lines):
    vertices, faces = tensors(bumpy(2, 12.0, (20.0, -9.0, 40.0)))  # partly outside of the raster
    views = poses(4)
    both = [thickness(vertices, faces, views, lines, backend) for backend in ("cpu", "reference")]
    assert both[0].abs().max() > 10
    assert torch.allclose(*both, rtol=0, atol=1e-12)


def test_lines_through_vertices_and_flat_faces_leave_no_crack():
    """An octahedron on whole pixels: lines pass through its vertices, and faces stand on edge."""
    corners = 8.0 * np.concatenate([np.eye(3), -np.eye(3)])
    signs = [(x, y, z) for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    faces = np.array([f if np.linalg.det(corners[list(f)]) > 0 else f[::-1] for f in signs])
    for backend in ("cpu", "reference"):
        views = Views.from_angles([0.0, 45.0], (25, 31), 1.0)
        found = thickness(torch.from_numpy(corners), torch.from_numpy(faces), views, 1, backend)
        assert found.min() > -1e-12
        assert torch.allclose(found.sum((1, 2)), torch.full((2,), 4 / 3 * 8.0**3, dtype=torch.float64), rtol=0.01)
        x, y = abs(torch.arange(31.0) - 15)[None], abs(torch.arange(25.0) - 12)[:, None]
        exact = 2 * (8 - x - y - 0.25 * (x == 0)).double()  # the mean of |x| over the middle pixel is 1/4
        assert torch.allclose(found[0][x + y < 7], exact[x + y < 7], atol=1e-9)


def test_a_box_covers_pixels_in_part():
    """Along rows exactly, across them in steps of a line."""
    unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    vertices = torch.from_numpy(unit * (6.3, 4.25, 5.0) + (-2.1, -3.0, 7.0))
    quads = ([0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3])
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    views = Views.from_angles([0.0], (15, 20), 1.0)
    found = thickness(vertices, faces, views, 4)[0].numpy()
    x, y = np.arange(20) - 10.0, np.arange(15) - 7.5
    across = np.clip(np.minimum(x + 1, 4.2) - np.maximum(x, -2.1), 0, 1)
    down = np.clip(np.minimum(y + 1, 1.25) - np.maximum(y, -3.0), 0, 1)
    assert np.allclose(found, 5.0 * down[:, None] * across, atol=1e-12)


def test_it_agrees_with_the_other_projector_to_second_order_in_the_pixel():
    mesh = bumpy(3, 12.0, (1.3, 0.4, -7.7))
    errors = []
    for factor in (1, 2, 4):
        views = poses(3).refined(factor)
        exact = mesh_line_integrals(mesh.vertices, mesh.faces, np.ones((1, len(mesh.faces))), views, 16 // factor)[:, 0]
        errors.append(float((thickness(*tensors(mesh), views) - exact).abs().mean()))
    assert errors[0] < 0.01 * 2 * 12
    assert errors[0] / errors[1] > 2.5  # the rims, where the slope is infinite, fall with the power 3/2 and their area
    assert errors[1] / errors[2] > 2.5


def test_every_view_holds_the_volume():
    mesh = bumpy(3, 11.0)
    sums = thickness(*tensors(mesh), poses(6, (41, 46)), 4).sum((1, 2))
    assert np.allclose(sums, mesh.volume, rtol=2e-4)


def test_cavities_are_empty_and_overlaps_add_up():
    outer, inner = bumpy(2, 12.0), bumpy(2, 5.0)
    vertices = torch.from_numpy(np.concatenate([outer.vertices, inner.vertices]))
    views = poses(2)
    alone = [thickness(*tensors(mesh), views) for mesh in (outer, inner)]
    for sign, turned in ((1, inner.faces), (-1, inner.faces[:, ::-1])):
        faces = torch.from_numpy(np.concatenate([outer.faces, turned + len(outer.vertices)]))
        assert torch.allclose(thickness(vertices, faces, views), alone[0] + sign * alone[1], atol=1e-10)


def test_the_gradient_of_the_volume_is_exact():
    vertices, faces = tensors(bumpy(2, 11.0))
    leaf = vertices.clone().requires_grad_()
    thickness(leaf, faces, poses(3, (41, 46))).sum().backward()
    assert torch.allclose(leaf.grad, 3 * volume_gradient(vertices, faces), rtol=1e-10, atol=1e-12)


def weights(views: Views) -> Tensor:
    """A smooth image of derivatives, the same function of position on every raster."""
    (h, w), p = views.shape, views.pixel_size
    x = ((torch.arange(w, dtype=torch.float64) + 0.5 - w / 2) * p)[None, None]
    y = ((torch.arange(h, dtype=torch.float64) + 0.5 - h / 2) * p)[None, :, None]
    sx, sy = torch.from_numpy(views.shifts).T[..., None, None]
    return 1 + 0.7 * torch.sin(0.21 * (x + sx) + 0.4) * torch.cos(0.17 * (y + sy))


@pytest.mark.parametrize("projector", ["this", "the other"])
def test_the_gradient_converges_to_finite_differences(projector):
    """Of both projectors: the image's derivative along a deformation, weighted and summed."""
    mesh = bumpy(3, 11.0)
    vertices, faces = tensors(mesh)
    along = vertices / 11 * (1 + 0.5 * torch.sin(vertices[:, 1:2] / 4))
    gaps = []
    for factor in (1, 2, 4):
        views = poses(3, (41, 46)).refined(factor)
        area = views.pixel_size**2
        leaf = vertices.clone().requires_grad_()
        (thickness(leaf, faces, views) * weights(views)).sum().mul(area).backward()

        def value(x: Tensor, views: Views = views, factor: int = factor) -> Tensor:
            if projector == "this":
                return thickness(x, faces, views) * weights(views)
            ones = np.ones((1, len(faces)))
            return mesh_line_integrals(x.numpy(), mesh.faces, ones, views, 8 // factor)[:, 0] * weights(views)

        step = 0.05
        wanted = (value(vertices + step * along) - value(vertices - step * along)).sum() * area / (2 * step)
        assert leaf.grad is not None
        gaps.append(abs(float((leaf.grad * along).sum() / wanted) - 1))

    assert gaps[0] < 5e-3
    assert gaps[1] < 1e-3
    assert gaps[2] < 3e-4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v, f: (v.float(), f, 2), "vertices must be float64"),
        (lambda v, f: (v[:, :2], f, 2), "vertices must be float64"),
        (lambda v, f: (v, f.int(), 2), "faces must be int64"),
        (lambda v, f: (v, f + 1, 2), "faces must name existing vertices"),
        (lambda v, f: (v, f, 0), "lines must be from 1"),
        (lambda v, f: (v, f, 2**40), "lines must be from 1 to 1024"),
        (lambda v, f: (v * torch.nan, f, 2), "vertices must be finite"),
    ],
)
def test_bad_arguments_are_refused(change, words):
    vertices, faces, lines = change(*tensors(bumpy(1, 5.0)))
    at = Poses.of(poses(1))
    with pytest.raises(InputError, match=words):
        surface_thickness(vertices, faces, at.rotations, at.shifts, SHAPE, lines)


def test_occupancy_agrees_with_the_other_voxeliser():
    mesh = bumpy(3, 6.2, (7.9, 7.1, 9.4))
    found = surface_occupancy(*tensors(mesh), (21, 15, 17)).numpy()
    wanted = voxelise_meshes(mesh.vertices, mesh.faces, np.ones((1, len(mesh.faces))), _unit_grid((21, 15, 17)), 8)[0]
    assert found.min() > -1e-9
    assert found.max() < 1 + 1e-9
    assert abs(found.sum() / mesh.volume - 1) < 1e-3
    assert np.abs(found - wanted).mean() < 1e-3


def test_occupancy_is_cut_at_the_grid():
    mesh = bumpy(2, 6.0, (1.0, 5.0, -1.0))
    whole = surface_occupancy(*tensors(mesh.transformed(np.eye(3), np.full(3, 8.0))), (30, 31, 32))
    part = surface_occupancy(*tensors(mesh), (9, 14, 11))
    assert part.sum() > 100
    assert torch.allclose(part, whole[8:17, 8:22, 8:19], atol=1e-9)


def _unit_grid(shape: tuple[int, int, int]) -> Grid:
    return Grid(shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


# --- extraction ---------------------------------------------------------------------------------------------


def ball(radius: float, grid: Grid, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A smooth occupancy that crosses one half on the sphere."""
    x, y, z = (axis - c for axis, c in zip(grid.axes(), centre))
    r = np.sqrt(x[None, None] ** 2 + y[None, :, None] ** 2 + z[:, None, None] ** 2)
    return 1 / (1 + np.exp((r - radius) / 0.8))


def test_volume_and_area_of_spheres_converge_to_second_order():
    r = 6.1
    gaps = []
    for pitch in (1.0, 0.5, 0.25):
        shape = (round(17 / pitch), round(19 / pitch), round(16 / pitch))
        grid = Grid.centred(shape, pitch)
        mesh = isosurface(ball(r, grid), grid, smoothing=0)
        gaps.append((abs(mesh.volume / (4 / 3 * np.pi * r**3) - 1), abs(mesh.area / (4 * np.pi * r**2) - 1)))
    for volume, surface in ((0, 1), (1, 2)):
        assert gaps[volume][0] / gaps[surface][0] > 3.2
        assert gaps[volume][1] / gaps[surface][1] > 3.2
    assert max(gaps[2]) < 2e-3


def test_surfaces_are_closed_and_smoothing_keeps_their_volume():
    grid = Grid((19, 22, 17), (1.0, 1.0, 1.0), (-9.0, -11.0, -8.0))
    hard = (ball(6.3, grid) > 0.5).astype(float)
    hard[0, 4:8, 4:9] = 1  # a body that the grid cuts
    rough, smooth = (isosurface(hard, grid, least_volume=1.0, smoothing=n) for n in (0, 10))
    assert np.array_equal(closed(smooth).faces.shape, smooth.faces.shape)
    assert abs(smooth.volume / rough.volume - 1) < 0.03
    assert smooth.area < 0.97 * rough.area


def test_specks_are_left_out_and_an_empty_volume_is_refused():
    grid = Grid.centred((16, 17, 31), 2.0)
    values = ball(9.0, grid, (-12, 0, 0))
    values[8, 8, 26] = 1.0
    assert isosurface(values, grid, least_volume=8.0).bounds[1][0] < 5
    assert isosurface(values, grid, least_volume=0.0, smoothing=0).bounds[1][0] > 15
    with pytest.raises(InputError, match=r"no body of 8 voxels or more reaches the level 0\.5 .* lower the level"):
        isosurface(0.4 * values, grid)
    with pytest.raises(InputError, match="least_volume must not be negative"):
        isosurface(values, grid, least_volume=-1.0)


# --- the Object ---------------------------------------------------------------------------------------------


def test_units_scale_and_voxels_hold_what_projections_hold():
    mesh = bumpy(3, 9.0, (1.0, 2.0, -1.5))
    found = surfaces(mesh)
    volume = mesh.volume * 1e-18
    for pitch in (1e-6, 0.8e-6):
        views = poses(2, (44, 47), pitch=pitch)
        B, D = found.project(views)
        assert np.allclose(D.sum((1, 2)) * pitch**2, DELTA * volume, rtol=1e-3)
        assert np.allclose(B.sum((1, 2)) * pitch**2, BETA * volume, rtol=1e-3)
        voxels = found.voxelise(Grid((33, 31, 35), (pitch, 0.9 * pitch, pitch), (-16e-6, -13e-6, -16e-6)))
        assert np.isclose(voxels.delta.sum(dtype=float) * 0.9 * pitch**3, DELTA * volume, rtol=1e-3)
        assert np.isclose(voxels.beta.sum(dtype=float) * 0.9 * pitch**3, BETA * volume, rtol=1e-3)


def test_it_measures_as_the_same_scene_does():
    mesh = bumpy(3, 9.0)
    exposures = Exposures.of(poses(2, (33, 36), pitch=1e-6), 20.0, 0.02, 0.6)
    scene = MeshScene.of_one_material([replace(mesh, vertices=1e-6 * mesh.vertices)], HAEMOGLOBIN.delta_beta(20.0))
    wanted, found = (measure(o, exposures, 4, torch.float64) for o in (scene, surfaces(mesh)))
    assert (found - wanted).abs().mean() < 0.01 * (wanted - 1).abs().mean()


def test_bodies_come_with_their_cavities_the_largest_first():
    near, far, inner = bumpy(2, 5.0), bumpy(2, 7.0, (20.0, 0, 0)), bumpy(1, 2.0, (20.0, 1.0, 0))
    hollow = replace(inner, faces=inner.faces[:, ::-1])
    first, second = surfaces(near, hollow, far).bodies()
    assert (first.name, second.name) == ("body000", "body001")
    assert np.isclose(first.volume, 1e-18 * (far.volume - inner.volume))
    assert np.isclose(second.volume, 1e-18 * near.volume)
    assert len(closed(first).faces) == len(far.faces) + len(inner.faces)
    with pytest.raises(InputError, match="enclose no matter"):
        surfaces(hollow).bodies()
    with pytest.raises(InputError, match="at least one face"):
        SurfaceMesh(torch.zeros(3, 3), torch.zeros(0, 3), 1.0, Matter.one(DELTA, BETA))
