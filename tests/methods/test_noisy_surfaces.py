"""Closed bodies in small noisy frames: where Gaussians explain these badly, surfaces of the volume that agrees with the
frames may take their place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import DELTA, bumpy, surfaces
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.schedule import Schedule
from holosplat.geometry import Grid, Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.methods import Gaussians, SurfaceOptions, Surfaces, Task
from holosplat.methods.coarse import CoarseToFine, _first, begun_surfaces, missing_matter
from holosplat.methods.coarse_cloud import cloud_of_surfaces
from holosplat.methods.first_surfaces import first_surfaces, is_noisy, surfaces_of_volume
from holosplat.methods.gaussian_options import FitOptions
from holosplat.methods.method import quiet
from holosplat.methods.surface_fit import SurfaceFit
from holosplat.methods.surfaces import BodiesStage
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures, Scan
from holosplat.specimens import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.workflows.reconstruct import reconstruct

PITCH, SHAPE = 3.2e-6, (41, 55)
MATTER = HAEMOGLOBIN.delta_beta(20.0)
CELLS = random_cells(4, (40 * PITCH, 36 * PITCH, 40 * PITCH), 5, 18 * PITCH)
OPTIONS = Gaussians(
    approximate_steps=5,
    fit=FitOptions(schedule=Schedule(steps=5)),
    coarse=CoarseToFine(coarse_steps=20, views=1),
)
HOW = SurfaceOptions(fit=SurfaceFit(schedule=Schedule(steps=20)))


def scan_of(photons: float) -> Scan:
    """Sixteen views of cells of 18 pixels, whose fringes pixels hardly resolve."""
    scene = MeshScene.of_one_material(CELLS, MATTER)
    views = Views.evenly_spaced(16, SHAPE, PITCH)
    exposures = Exposures.of(views, 20.0, 0.1, 0.05)
    return simulate(scene, exposures, photons_per_pixel=photons, seed=1, is_test=np.zeros(16, dtype=bool))


@pytest.fixture(scope="module")
def noisy() -> Task:
    """Of frames about half of whose contrast is noise."""
    task = Task(scan_of(2000.0), MaterialPrior.known(MATTER)).evened()
    assert is_noisy(task, OPTIONS)
    return task


def mesh_of(count: int = 4) -> SurfaceMesh:
    """The first cells, in pixels."""
    return surfaces(*(replace(cell, vertices=cell.vertices / PITCH) for cell in CELLS[:count]), unit=PITCH)


def error(found) -> float:
    """Of the occupancy, in parts of the truth."""
    grid = Grid.of_views(Views.evenly_spaced(16, SHAPE, PITCH))
    true, other = (np.asarray(one.voxelise(grid).delta, dtype=float) for one in (mesh_of(), found))
    return float(np.linalg.norm(other - true) / np.linalg.norm(true))


def test_what_is_missing_is_told_beyond_noise(noisy):
    assert missing_matter(mesh_of(), noisy, HOW) < 0.1
    assert missing_matter(mesh_of(3), noisy, HOW) > 0.3
    assert missing_matter(surfaces(bumpy(1, 0.01), unit=PITCH), noisy, HOW) > 0.9


def test_rounds_of_agreement_in_noise_are_more_and_smoother():
    usual = HolographicTV(corrections=5, weight=0.2)
    assert usual.in_noise() == replace(usual, noisy=1.0, corrections=10, weight=1.0)
    assert replace(usual, weight=2.0).in_noise().weight == 2.0


def test_a_volume_that_agrees_with_noisy_frames_is_nearer_to_the_truth(noisy):
    errors, true = [], np.asarray(mesh_of().voxelise(Grid.of_views(noisy.scan.views)).delta) / DELTA
    for how in (HolographicTV(), HolographicTV().in_noise()):
        found, _ = holographic_tv(noisy.scan, MATTER, replace(how, refine=1), quiet)
        errors.append(float(np.linalg.norm(found.numpy() - true) / np.linalg.norm(true)))
    assert errors[1] < 0.8 * errors[0]


# --- which way is gone --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "asked", "taken"),
    [((0.05, 0.01), 1, 0), ((0.5, 0.05), 2, 1), ((0.3, 0.5), 2, 0), ((0.5,), 1, 0)],
    ids=["the first explains", "the second does", "none does", "there is one"],
)
def test_the_next_way_is_gone_where_the_first_explains_badly(noisy, left, asked, taken, monkeypatch):
    cells, tried = [mesh_of(1 + k) for k in range(len(left))], list[int]()
    judged = {len(mesh.faces): share for mesh, share in zip(cells, left)}

    def way(k: int) -> Callable[[], SurfaceMesh]:
        return lambda: (tried.append(k), cells[k])[1]

    monkeypatch.setattr("holosplat.methods.coarse.missing_matter", lambda mesh, task, how: judged[len(mesh.faces)])
    how = CoarseToFine(coarse_steps=1, chord=0.0)
    found = _first(noisy, lambda task: [way(k) for k in range(len(left))], HOW, how)
    assert found is not None
    assert len(found.faces) == len(cells[taken].faces)
    assert tried == list(range(asked))


def test_gaussians_come_first_in_noise_and_a_way_without_surfaces_is_none(noisy):
    asked = list[str]()

    def fitted(task: Task):
        asked.append("Gaussians")
        raise InputError("no matter")

    gaussians, _ = first_surfaces(noisy, OPTIONS, HOW, fitted)
    assert gaussians() is None
    assert asked == ["Gaussians"]
    clean = Task(scan_of(1e7), MaterialPrior.known(MATTER)).evened()
    assert len(first_surfaces(clean, OPTIONS, HOW, fitted)) == 1


EXPLAINED = replace(OPTIONS, coarse=replace(OPTIONS.coarse, missing_matter=0.3))
"""What so few noisy pixels tell."""


def best_cut(task: Task, count: int, options: Gaussians = EXPLAINED) -> tuple[SurfaceMesh, int]:
    """What surfaces begin with after Gaussians of so many cells, and how often those of the Gaussians were cut."""
    cuts, cloud = list[int](), cloud_of_surfaces(mesh_of(count), task)
    stage = BodiesStage(options, surfaces=HOW)
    found = stage.best_cut(task, cloud, lambda: (cuts.append(count), mesh_of(count))[1])
    return found, len(cuts)


def test_gaussians_that_explain_the_frames_are_cut(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: pytest.fail("not asked for"))
    found, cuts = best_cut(noisy, 4)
    assert cuts == 1
    assert torch.equal(found.vertices, mesh_of().vertices)


def test_gaussians_that_lost_cells_give_way_to_the_volume(noisy):
    found, cuts = best_cut(noisy, 2)
    assert cuts == 1
    assert error(found) < 0.25 < error(mesh_of(3))


def test_of_two_that_explain_little_the_better_is_taken(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: mesh_of(1))
    found, _ = best_cut(noisy, 3)
    assert len(found.faces) == len(mesh_of(3).faces)
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    found, _ = best_cut(noisy, 1)
    assert torch.equal(found.vertices, mesh_of(1).vertices)


def test_gaussians_without_a_surface_give_way(noisy, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: mesh_of(2))

    def none() -> SurfaceMesh:
        raise InputError("no surface")

    cloud = cloud_of_surfaces(mesh_of(1), noisy)
    stage = BodiesStage(OPTIONS, surfaces=HOW)
    assert len(stage.best_cut(noisy, cloud, none).faces) == len(mesh_of(2).faces)
    monkeypatch.setattr("holosplat.methods.surfaces.begun_surfaces", lambda *given: None)
    with pytest.raises(InputError, match="no surface"):
        stage.best_cut(noisy, cloud, none)


def test_frames_without_much_noise_ask_nothing(monkeypatch):
    monkeypatch.setattr("holosplat.methods.surfaces.missing_matter", lambda *given: pytest.fail("not asked for"))
    clean = Task(scan_of(1e7), MaterialPrior.known(MATTER)).evened()
    assert best_cut(clean, 1)[1] == 1
    learned = replace(OPTIONS, start="learned")
    assert best_cut(Task(scan_of(2000.0), MaterialPrior.known(MATTER)).evened(), 1, learned)[1] == 1


def test_surfaces_of_the_volume_explain_noisy_frames(noisy):
    found = begun_surfaces(noisy, lambda task: surfaces_of_volume(task, OPTIONS, HOW), HOW, OPTIONS.coarse)
    assert found is not None
    assert missing_matter(found, noisy, HOW) < 1.5 * missing_matter(mesh_of(), noisy, HOW)
    assert error(found) < 0.25


def test_a_run_ends_with_them(noisy):
    """Gaussians of five steps explain nothing."""
    found = reconstruct(noisy.scan, noisy.prior, Surfaces(fit=HOW.fit, gaussians=OPTIONS), matter="levels")
    assert isinstance(found.object, SurfaceMesh)
    assert error(found.object) < 0.25
