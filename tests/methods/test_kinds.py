"""Gaussians and surfaces compete by views that neither has seen: each wins on the family that it is right for."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.soft import MATERIAL, two_cells
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, Task, trials
from holosplat.methods.cross_validation import BY_VIEWS
from holosplat.methods.trials import decide_kind, unseen_kinds
from holosplat.representations import GaussianCloud, SurfaceMesh, VoxelGrid
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

MATTER = DeltaBeta(4e-7, 4e-7 / 1500)
BODIES = Auto().with_effort(0.3).suited("levels")


def of(scene, views: int) -> Task:
    exposures = Exposures.of(Views.evenly_spaced(views, (37, 42), 1e-6), 20.0, 0.05)
    scan = simulate(scene, exposures, seed=3, is_test=np.zeros(views, dtype=bool))
    return Task(scan, MaterialPrior.known(MATTER))


@pytest.fixture(scope="module")
def sharp() -> Task:
    return of(MeshScene.of_one_material(random_cells(3, (30e-6, 28e-6, 30e-6), 5, 11e-6), MATTER), 4)


def test_sharp_bodies_are_surfaces(sharp):
    found = decide_kind(sharp, BODIES, SurfaceMesh.kind, GaussianCloud.kind)
    assert found is not None
    assert (found.choice, found.by) == (SurfaceMesh.kind, BY_VIEWS)
    assert not found.compared[0].wins


def test_soft_bodies_are_gaussians():
    soft = Task(two_cells(6), MaterialPrior.known(MATERIAL))
    found = decide_kind(soft, BODIES, SurfaceMesh.kind, GaussianCloud.kind)
    assert found is not None
    assert found.choice == GaussianCloud.kind


def test_a_kind_that_the_run_on_coarse_frames_does_not_make_is_not_compared(sharp):
    """It was given the other's score: a gain of exactly 0, with which the null won."""
    for null, other in ((SurfaceMesh.kind, VoxelGrid.kind), (VoxelGrid.kind, SurfaceMesh.kind)):
        assert decide_kind(sharp, Auto().volume.with_effort(0.3), null, other) is None


def test_kinds_are_compared_after_all_steps(sharp, monkeypatch):
    """Of soft cells in uneven light, surfaces left 12 % less than Gaussians after a fifth of them, and 5 % more at the
    end."""
    ran = []
    monkeypatch.setattr(trials, "run_stages", lambda method, part, look: ran.append(method))
    assert decide_kind(sharp, BODIES, SurfaceMesh.kind, GaussianCloud.kind) is None
    assert ran == [BODIES]


def test_which_runs_have_a_choice_of_kinds(sharp):
    assert unseen_kinds(sharp, BODIES) is not None
    assert unseen_kinds(sharp, Auto().volume) is None
