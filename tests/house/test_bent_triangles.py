"""Triangles that a benchmark divides where the surface bends (benchmarks/bent_triangles.py)."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from helpers.bumpy import bumpy
from holosplat.mesh import TriangleMesh

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
AXES = np.array([11.0, 7.0, 4.0])


@pytest.fixture
def bent(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("bent_triangles")


def ellipsoid(subdivisions: int) -> TriangleMesh:
    ball = bumpy(subdivisions, 1.0, depth=0.0)
    return TriangleMesh(AXES * ball.vertices, ball.faces)


def angles(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F, 3], radians."""
    corners = points[faces]
    found = []
    for k in range(3):
        one, other = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        found.append((one * other).sum(1) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1))
    return np.arccos(np.stack(found, 1))


def test_surfaces_stay_closed_and_only_bent_parts_are_divided(bent):
    """Each side is there once in both directions; Euler's number is 2; four rounds leave no thin triangles."""
    start = ellipsoid(3)
    points, faces, before = start.vertices, start.faces, len(start.faces)
    thinnest = angles(points, faces).min()
    for _ in range(4):
        points, faces = bent.divided(points, faces, longer=0.2, beside=0.01)
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {tuple(side) for side in sides.tolist()}
    assert len(there) == len(sides)
    assert {(b, a) for a, b in there} == there
    assert len(points) - len(sides) // 2 + len(faces) == 2
    assert before < len(faces) < 0.5 * before * 4**4
    assert angles(points, faces).min() > 0.4 * thinnest
    middles = points[faces].mean(1)
    tip, waist = np.abs(middles[:, 0]) > 9.5, np.abs(middles[:, 2]) > 3.5
    sizes = np.linalg.norm(points[faces[:, 0]] - points[faces[:, 1]], axis=1)
    assert sizes[tip].mean() < 0.7 * sizes[waist].mean()
    volume = 4 / 3 * np.pi * AXES.prod()
    assert TriangleMesh(points, faces).volume == pytest.approx(volume, rel=0.004)
    assert start.volume < 0.992 * volume


def test_where_all_edges_are_divided_each_triangle_is_four(bent):
    start = ellipsoid(2)
    points, faces = bent.divided(start.vertices, start.faces, longer=0.0, beside=-1.0)
    assert len(faces) == 4 * len(start.faces)
    assert len(points) == len(start.vertices) + 3 * len(start.faces) // 2


def test_what_is_flat_or_short_stays(bent):
    start = ellipsoid(2)
    for longer, beside in ((0.0, 10.0), (100.0, 0.0)):
        points, faces = bent.divided(start.vertices, start.faces, longer, beside)
        assert np.array_equal(points, start.vertices)
        assert np.array_equal(np.sort(faces, axis=1), np.sort(start.faces, axis=1))


def test_new_points_come_near_the_surface_by_the_fourth_order(bent):
    """Of a sphere: its normals are exact, and half the edges leave a sixteenth. Of an ellipsoid more than a sixth."""
    for shape, least in (((1, 1, 1), 15.0), ((11 / 7, 1, 4 / 7), 6.0)):
        left = []
        for subdivisions in (2, 3):
            ball = bumpy(subdivisions, 7.0, depth=0.0)
            start = TriangleMesh(np.array(shape) * ball.vertices, ball.faces)
            points, _ = bent.divided(start.vertices, start.faces, 0.0, -1.0)
            away = np.linalg.norm(points[len(start.vertices) :] / np.array(shape), axis=1) - 7
            left.append(float(np.sqrt(np.square(away).mean())))
        assert left[0] / left[1] > least


def test_an_edge_of_a_sphere_bends_by_its_chord_height(bent):
    ball = bumpy(3, 9.0, depth=0.0)
    edges, _ = bent.edges_of(ball.faces)
    lengths = np.linalg.norm(ball.vertices[edges[:, 0]] - ball.vertices[edges[:, 1]], axis=1)
    found = np.linalg.norm(bent.sagittae(ball.vertices, ball.faces, edges), axis=1)
    assert found == pytest.approx(lengths**2 / 72, rel=0.01)
