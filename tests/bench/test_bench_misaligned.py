"""Cases whose beams are not where methods are told, and methods that look for them first."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import holosplat as hs
from helpers.bench_shop import MATERIAL, PITCH
from holosplat.align.derivatives import moved_onto
from holosplat.beamline.misalignment import Misalignment
from holosplat.matter import Matter
from holosplat.representations.voxels import VoxelGrid
from holosplat.specimens.red_cells import icosphere
from holosplat_bench.declaration import Case
from holosplat_bench.suite.methods import ALIGNED, METHODS, by_mass, by_reprojection
from holosplat_bench.suite.prepare import described, fingerprint
from holosplat_bench.suite.run import Move, judged_with

pytestmark = pytest.mark.usefixtures("unjudged_runs", "plain_light")

SHAPE = (31, 36)
ERRORS = Misalignment(1.0, 0.6, 0.02, 5)


def balls() -> hs.MeshScene:
    """Three balls, so that every turn is seen."""
    vertices, faces = icosphere(2)
    places = ((5.0, [6, -5, 3]), (4.0, [-8, 4, 5]), (3.5, [1, 7, -9]))
    meshes = [hs.mesh.TriangleMesh(PITCH * (radius * vertices + np.array(at)), faces) for radius, at in places]
    return hs.MeshScene.of_one_material(meshes, MATERIAL)


@pytest.fixture(scope="module")
def case() -> Case:
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(8, SHAPE, PITCH), 20.0, 0.01)
    known = hs.MaterialPrior.known(MATERIAL)
    return Case("balls", 2, balls(), exposures, np.arange(8) % 4 == 3, known, misalignment=ERRORS)


@pytest.fixture(scope="module")
def scan(case) -> hs.Scan:
    return case.scan()


def test_frames_are_taken_elsewhere_than_methods_are_told(case, scan):
    true = replace(ERRORS, seed=7).true_exposures(case.exposures)
    np.testing.assert_array_equal(case.true_exposures().views.shifts, true.views.shifts)
    np.testing.assert_array_equal(scan.views.rotations, case.exposures.views.rotations)
    np.testing.assert_array_equal(scan.exposures.distance, case.exposures.distance)
    np.testing.assert_array_equal(scan.frames, replace(case, exposures=true, misalignment=Misalignment()).scan().frames)
    planned = replace(case, misalignment=Misalignment())
    assert fingerprint(planned) != fingerprint(case)
    assert described(case, case.exposures, case.is_test)["misalignment"]["shift_px"] == 1.0
    assert "misalignment" not in described(planned, planned.exposures, planned.is_test)


def test_a_rigid_move_is_found_to_a_hundredth_of_a_voxel():
    rotation = Rotation.from_rotvec([0.02, -0.03, 0.04]).as_matrix()
    move = Move(rotation, PITCH * np.array([1.5, -0.7, 0.4]))
    grid = hs.Grid.centred((36, 31, 37), PITCH, (2e-6, 0.0, 1e-6))
    truth, found = (scene.voxelise(grid) for scene in (balls(), move.of(balls())))
    back = Move.best(truth, found)
    np.testing.assert_allclose(back.rotation, rotation, atol=1e-3)
    np.testing.assert_allclose(back.translation / PITCH, move.translation / PITCH, atol=0.02)


def test_steps_of_a_move_follow_each_other(monkeypatch):
    """Each turns and moves what those before have moved."""
    turn, by, steps = Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix(), np.array([2.0, -1.0, 0.5]), iter(range(99))
    still = (np.eye(3), np.zeros(3))
    monkeypatch.setattr("holosplat_bench.suite.run._step", lambda *rest: (turn, by) if next(steps) < 2 else still)
    grid = hs.Grid.centred((9, 10, 11), PITCH, (0.0, 0.0, 0.0))
    truth = balls().voxelise(grid)
    found, point = Move.best(truth, truth), np.array([3.0, 4.0, -2.0])
    moved = turn @ (turn @ point + by) + by
    np.testing.assert_allclose(found.rotation @ (PITCH * point) + found.translation, PITCH * moved, atol=1e-9 * PITCH)


def test_a_result_is_judged_where_it_lies(case, scan):
    """The truth itself, turned and moved as no frame can tell: nothing is held against it."""
    rotation = Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix()
    there = Move(rotation, PITCH * np.array([0.8, 0.0, -0.5])).of(case.scene).voxelise(case.truth().grid)
    found = VoxelGrid(torch.from_numpy(there.delta[None] / MATERIAL.delta).float(), there.grid, Matter.one(*MATERIAL))
    placed, truth = judged_with(case, found, scan, case.truth(), lambda stage, fraction: None)
    assert np.linalg.norm(truth.delta - there.delta) < 0.03 * np.linalg.norm(there.delta)
    assert np.linalg.norm(case.truth().delta - there.delta) > 0.2 * np.linalg.norm(there.delta)
    true = case.true_exposures().views
    for views, most in ((placed.views, 0.25), (scan.views, np.inf)):
        away = np.abs(moved_onto(views, true).shifts - true.shifts).max() / PITCH
        assert away < most
    np.testing.assert_array_equal(placed.is_test, scan.is_test)


def test_views_are_brought_nearer_by_mass_and_rolled_by_reprojection(case, scan):
    train, true = scan.train(), case.true_exposures()[np.flatnonzero(~scan.is_test)].views

    def away(views: hs.Views) -> tuple[float, float]:
        moved = moved_onto(views, true)
        rolls = Rotation.from_matrix(moved.rotations @ true.rotations.transpose(0, 2, 1)).as_rotvec(degrees=True)[:, 2]
        return float(np.sqrt(np.square(moved.shifts - true.shifts).mean()) / PITCH), float(np.abs(rolls).max())

    planned = away(train.views)
    mass = away(by_mass(train, case.prior, lambda *_: None).views)
    reprojected = away(by_reprojection(train, case.prior, lambda *_: None, rounds=2).views)
    assert mass[0] < 0.4 * planned[0]
    assert reprojected[0] < 0.4 * planned[0]
    assert reprojected[1] < 0.6 * planned[1]


def test_methods_on_aligned_views_are_the_others_with_an_aligner():
    for name, method in ALIGNED.items():
        base, way = name.split("+")
        assert method.aligner is not None
        assert (method.options, method.family) == (METHODS[base].options, METHODS[base].family)
        assert method.name == name
        assert way in ("mass", "reprojection", "align")
    assert not set(ALIGNED) & set(METHODS)


def test_a_method_gets_the_aligned_views(case, scan, monkeypatch):
    """And without an aligner those that are planned."""
    given: list[hs.Scan] = []

    def reconstruct(train: hs.Scan, *_: object, **__: object) -> SimpleNamespace:
        given.append(train)
        return SimpleNamespace(object="found")

    monkeypatch.setattr("holosplat_bench.suite.methods.reconstruct", reconstruct)
    there = scan.train()[[0, 1]]
    method = replace(METHODS["gaussians"], aligner=lambda *_: there)
    assert method.run(scan.train(), case.prior, 0, lambda *_: None) == "found"
    METHODS["gaussians"].run(scan.train(), case.prior, 0, lambda *_: None)
    assert given[0] is there
    assert len(given[1]) == len(scan.train())
