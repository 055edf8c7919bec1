"""Meshes from STL, PLY and OBJ files."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from helpers.polycube import polycube
from holosplat.checks import InputError
from holosplat.io.vtk import read_meshes
from holosplat.mesh import TriangleMesh


def stl(mesh: TriangleMesh) -> bytes:
    corners = mesh.vertices[mesh.faces].astype("<f4")
    facets = b"".join(struct.pack("<3f", 0, 0, 0) + each.tobytes() + b"\0\0" for each in corners)
    return b"by hand".ljust(80) + struct.pack("<I", len(corners)) + facets


def obj(mesh: TriangleMesh) -> bytes:
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
    return "\n".join([*lines, ""]).encode()


def ply(mesh: TriangleMesh) -> bytes:
    head = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    points = [f"{x} {y} {z}" for x, y, z in mesh.vertices]
    return "\n".join([*head, *points, *(f"3 {a} {b} {c}" for a, b, c in mesh.faces), ""]).encode()


@pytest.mark.parametrize(("name", "written"), [("body.stl", stl), ("body.PLY", ply), ("body.obj", obj)])
def test_a_solid_comes_as_it_was_written(tmp_path, name, written):
    body = polycube(2.0)
    (tmp_path / name).write_bytes(written(body))
    (found,) = read_meshes(tmp_path / name, "um")
    assert found.volume == pytest.approx(1e-18 * body.volume, rel=1e-6)
    assert len(found.vertices) == len(body.vertices)
    np.testing.assert_allclose(found.bounds, 1e-6 * np.array(body.bounds), atol=1e-12)


@pytest.mark.parametrize(("name", "written"), [("body.stl", stl), ("body.ply", ply), ("body.obj", obj)])
def test_a_damaged_solid_is_refused(tmp_path, name, written):
    (tmp_path / name).write_bytes(written(polycube(2.0))[:200])
    with pytest.raises(InputError, match=name):
        read_meshes(tmp_path / name, "um")
