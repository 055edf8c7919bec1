"""Finer triangles."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.bumpy import bumpy
from holosplat.mesh import TriangleMesh
from holosplat.representations.isosurface import edge_lengths, loop_subdivision

TETRAHEDRON = (
    torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64),
    torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]),
)


def arrays(mesh: TriangleMesh) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces)


def test_a_tetrahedron_by_hand():
    """n = 3 has β = 3/16: corners go to 7/16 of themselves and 3/16 of the others'; middles to 3/8, 3/8, 1/8, 1/8."""
    vertices, faces = loop_subdivision(*TETRAHEDRON)
    corners = TETRAHEDRON[0]
    assert vertices.shape == (4 + 6, 3)
    assert faces.shape == (16, 3)
    assert torch.allclose(vertices[:4], (7 / 16 - 3 / 16) * corners)  # the four corners add up to nothing
    middle = 0.375 * (corners[0] + corners[1]) + 0.125 * (corners[2] + corners[3])
    assert float((vertices[4:] - middle).norm(dim=1).min()) < 1e-12


def test_surfaces_stay_closed_and_wound_outwards():
    start = bumpy(2, 9.0, (0.6, -0.4, 0.3), depth=0.25)
    vertices, faces = loop_subdivision(*arrays(start))
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
        vertices, faces = loop_subdivision(vertices, faces)
    radii = vertices.norm(dim=1)
    finer = TriangleMesh(vertices.numpy(), faces.numpy(), "finer")
    assert float(radii.std() / radii.mean()) < 0.002  # facets of the start are up to 1.4 % nearer than its corners
    isoperimetric = 36 * math.pi * finer.volume**2 / finer.area**3
    assert 0.998 < isoperimetric <= 1
    before = 36 * math.pi * start.volume**2 / start.area**3
    assert isoperimetric > before
