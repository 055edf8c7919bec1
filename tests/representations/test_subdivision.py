"""Finer triangles, and Gaussians of several sizes."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.bumpy import area, bumpy
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.mesh import TriangleMesh
from holosplat.representations.octree import cloud_in_octree
from holosplat.representations.subdivision import edge_lengths, subdivided

TETRAHEDRON = (
    torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64),
    torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]),
)


def arrays(mesh: TriangleMesh) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces)


def test_a_tetrahedron_by_hand():
    """n = 3 has β = 3/16: corners go to 7/16 of themselves and 3/16 of the others'; middles to 3/8, 3/8, 1/8, 1/8."""
    vertices, faces = subdivided(*TETRAHEDRON)
    corners = TETRAHEDRON[0]
    assert vertices.shape == (4 + 6, 3)
    assert faces.shape == (16, 3)
    assert torch.allclose(vertices[:4], (7 / 16 - 3 / 16) * corners)  # the four corners add up to nothing
    middle = 0.375 * (corners[0] + corners[1]) + 0.125 * (corners[2] + corners[3])
    assert float((vertices[4:] - middle).norm(dim=1).min()) < 1e-12


def test_surfaces_stay_closed_and_wound_outwards():
    start = bumpy(2, 9.0, (0.6, -0.4, 0.3), depth=0.25)
    vertices, faces = subdivided(*arrays(start))
    finer = TriangleMesh(vertices.numpy(), faces.numpy(), "finer")
    assert len(faces) == 4 * len(start.faces)
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {tuple(side) for side in sides.tolist()}
    assert len(there) == len(sides)  # no side twice in one direction, and each in both
    assert {(b, a) for a, b in there} == there
    assert finer.volume == pytest.approx(start.volume, rel=0.05)
    assert edge_lengths(vertices, faces).mean() == pytest.approx(
        0.5 * float(edge_lengths(*arrays(start)).mean()), rel=0.05
    )


def test_facets_become_round():
    """The angle between a sphere's triangles halves, and the surface is as smooth as a finer sphere."""
    start = bumpy(2, 9.0, depth=0.0)
    vertices, faces = arrays(start)
    for _ in range(2):
        vertices, faces = subdivided(vertices, faces)
    radii = vertices.norm(dim=1)
    finer = TriangleMesh(vertices.numpy(), faces.numpy(), "finer")
    assert float(radii.std() / radii.mean()) < 0.002  # facets of the start are up to 1.4 % nearer than its corners
    isoperimetric = 36 * math.pi * finer.volume**2 / area(finer) ** 3
    assert 0.998 < isoperimetric <= 1
    before = 36 * math.pi * start.volume**2 / area(start) ** 3
    assert isoperimetric > before


# --- Gaussians of several sizes -------------------------------------------------------------------------------------


def ball(grid: Grid, radius: float) -> torch.Tensor:
    """Occupancy of a ball with an edge of one voxel."""
    x, y, z = (torch.from_numpy(axis) for axis in grid.axes())
    distance = (z[:, None, None] ** 2 + y[:, None] ** 2 + x**2).sqrt()
    return ((radius - distance) / grid.voxel_size[0] + 0.5).clamp(0, 1).float()


def test_the_cloud_of_an_octree_keeps_mass_and_is_flat_inside():
    grid = Grid.centred((41, 39, 46), 0.5e-6)
    occupancy = ball(grid, 8.5e-6)
    cloud = cloud_in_octree(occupancy, grid, (1e-6, 1e-9), 0.5e-6, 3)
    single = cloud_in_octree(occupancy, grid, (1e-6, 1e-9), 0.5e-6, 1)
    sizes = torch.exp(cloud.log_scales[:, 0]) / 0.5
    assert sorted(set(sizes.round().int().tolist())) == [1, 2, 4]
    assert len(cloud) < 0.75 * len(single)
    density = cloud.density(grid)[0].detach()
    assert float(density.sum() / occupancy.sum()) == pytest.approx(1.0, abs=0.01)
    inside = ball(grid, 7e-6) == 1
    ripple = (density - occupancy)[inside]  # the edge of a large Gaussian is wider than that of those beside it
    assert float(ripple.abs().max()) < 0.35
    assert float(ripple.square().mean().sqrt()) < 0.12
    assert abs(float(ripple.mean())) < 0.03
    for found in (cloud, single):
        assert torch.allclose((found.masses()[:, 0:1] * found.centres).sum(0), torch.zeros(3), atol=0.5)


def test_larger_blocks_touch_nothing_that_changes():
    grid = Grid.centred((32, 24, 40), 1.0)
    occupancy = torch.zeros(grid.shape)
    occupancy[8:24, 4:20, 8:32] = 1.0
    cloud = cloud_in_octree(occupancy, grid, (1e-6, 1e-9), 1.0, 2)
    large = torch.exp(cloud.log_scales[:, 0]) > 0.75
    offset = cloud.centres[large] - torch.tensor(grid.centre, dtype=torch.float32)
    assert len(offset) > 0
    limit = torch.tensor([12.0, 8.0, 8.0]) - 2.9  # half the box, less a block around and half a block
    assert bool((offset.abs() <= limit + 0.01).all())


def test_an_empty_volume_is_refused():
    with pytest.raises(InputError, match="there is no matter"):
        cloud_in_octree(torch.zeros(4, 5, 6), Grid.centred((4, 5, 6), 1.0), (1e-6, 1e-9), 1.0, 2)
