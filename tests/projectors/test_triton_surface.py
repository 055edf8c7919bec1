"""The GPU's projector of closed surfaces against the reference: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from helpers.bumpy import bumpy, poses, surfaces
from helpers.poses import relative
from holosplat.geometry import Poses
from holosplat.projectors.surface import reference, surface_occupancy, surface_thickness

VALUES, SHARES, POSES = 1e-12, 1e-12, 1e-10
"""Largest differences, relative to the largest value."""

FINE = surfaces(bumpy(2, 3.5, (1.5, 1.0, 4.0)), bumpy(2, 3.0, (-2.0, 1.5, -1.0)))
"""Two bodies in each other, of triangles that pass between lines, and between pixels."""
COARSE = surfaces(bumpy(1, 12.0, (9.0, -6.0, 3.0)), bumpy(0, 7.0, (-4.0, 3.0, -2.0)))
"""The same of triangles larger than pixels, partly outside of the raster."""


@pytest.fixture(autouse=True)
def few_programs(gpu, monkeypatch):
    """Programs of many faces, which the interpreter does at once."""
    if gpu.type != "cuda":
        from holosplat.projectors.surface import triton_surface

        monkeypatch.setattr(triton_surface, "DRAWN", 1024)
        monkeypatch.setattr(triton_surface, "GATHERED", 1024)
        monkeypatch.setattr(triton_surface, "POSED", 1024)


def leaves_of(mesh, shape: tuple[int, int], gpu: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Vertices, rotations, shifts and edges of three views, each of which asks for a gradient."""
    at = Poses.of(poses(3, shape, seed=1))
    edges = torch.tensor([1.0, 1.3, 0.8], dtype=torch.float64)
    vertices, rotations, shifts, edges = (
        a.to(gpu, copy=True).requires_grad_() for a in (mesh.vertices, at.rotations, at.shifts, edges)
    )
    return vertices, rotations, shifts, edges


def image_and_gradients(mesh, shape: tuple[int, int], lines: int, backend: str, gpu: torch.device) -> list[Tensor]:
    """The images, and the gradients of a fixed random sum over them."""
    leaves = leaves_of(mesh, shape, gpu)
    vertices, rotations, shifts, edges = leaves
    image = surface_thickness(
        vertices, mesh.faces.to(gpu), rotations, shifts, shape, lines, backend, pixels=edges, trusted=True
    )
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(gpu)
    return [image.detach(), *torch.autograd.grad(image, leaves, weights)]


@pytest.mark.parametrize(
    ("mesh", "shape", "lines"),
    [(FINE, (13, 18), 2), (COARSE, (23, 30), 3), (COARSE, (1, 31), 1), (COARSE, (31, 1), 2)],
    ids=["fine", "coarse", "one row", "one column"],
)
def test_the_same_as_the_reference(mesh, shape, lines, gpu):
    found, wanted = (image_and_gradients(mesh, shape, lines, backend, gpu) for backend in ("cuda", "reference"))
    assert wanted[0].abs().max() > 5
    for mine, true, tolerance in zip(found, wanted, (VALUES, SHARES, POSES, POSES, POSES)):
        assert float(true.abs().max()) > 0.1
        assert relative(mine, true) < tolerance


def test_several_programs_share_the_faces(gpu, monkeypatch):
    """With the sizes of production."""
    from holosplat.projectors.surface import cuda, triton_surface

    monkeypatch.setattr(triton_surface, "DRAWN", 32)
    monkeypatch.setattr(triton_surface, "GATHERED", 128)
    monkeypatch.setattr(triton_surface, "POSED", 64)
    vertices = COARSE.vertices.to(gpu)
    faces = torch.cat([COARSE.faces, COARSE.faces.roll(1, 1)]).to(gpu)  # 200 faces, no multiple of a block
    points = torch.stack([vertices + 11.3, vertices.flip(1) + 9.0])
    image, weights = torch.randn(2, 23, 20, dtype=torch.float64).to(gpu), torch.tensor([0.7, 1.9]).double().to(gpu)
    images = [of.thickness(points, faces, (23, 20), 2) for of in (cuda, reference)]
    assert relative(*images) < VALUES
    shares = [of.corner_shares(points, faces, image, weights) for of in (cuda, reference)]
    assert relative(*shares) < SHARES
    for mine, true in zip(*(of.pose_gradients(points, vertices, faces, image) for of in (cuda, reference))):
        assert relative(mine, true) < POSES


def test_what_is_not_seen_and_what_is_no_number_draws_nothing(gpu):
    """A surface beside the raster, one whose vertices have diverged, and none."""
    at, mesh = Poses.of(poses(2, (15, 18))), surfaces(bumpy(0, 4.0))
    rotations, shifts, faces = (a.to(gpu) for a in (at.rotations, at.shifts, mesh.faces))
    for vertices in (mesh.vertices + 1e12, torch.full_like(mesh.vertices, torch.nan)):
        leaf = vertices.to(gpu).requires_grad_()
        image = surface_thickness(leaf, faces, rotations, shifts, (15, 18), 2, "cuda", trusted=True)
        image.sum().backward()
        assert not image.any()
        assert leaf.grad is not None
        assert not leaf.grad.nan_to_num().any()
    empty = surface_thickness(mesh.vertices.to(gpu), faces[:0], rotations, shifts, (15, 18), 2, "cuda")
    assert empty.shape == (2, 15, 18)
    assert not empty.any()


def test_projections_and_voxels_are_made_where_the_mesh_is(gpu):
    views = poses(2, (15, 18), pitch=1e-6)
    mesh = surfaces(bumpy(1, 5.0))
    there = mesh.on("cuda")
    assert there.vertices.device.type == there.faces.device.type == gpu.type
    assert there.with_parameters({}).backend == "cuda"
    found, wanted = there.project(views), mesh.project(views)
    assert found.channels.device.type == gpu.type
    assert relative(found.channels.cpu(), wanted.channels) < VALUES
    grid = mesh.enclosing_grid(1000)
    assert there.enclosing_grid(1000) == grid
    assert relative(torch.from_numpy(there.voxelise(grid).delta), torch.from_numpy(mesh.voxelise(grid).delta)) < 1e-6
    assert there.bodies()[0].volume == pytest.approx(mesh.bodies()[0].volume, rel=1e-12)
    back = there.on("cpu")
    assert back.vertices.device.type == "cpu"
    assert back.backend == "cpu"
    occupancy = surface_occupancy(there.vertices + 7, there.faces, (15, 15, 15))
    assert occupancy.device.type == gpu.type
