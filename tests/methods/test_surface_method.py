"""Surfaces fitted to few holograms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.bumpy import DELTA, bumpy, poses, surfaces
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.loop import Fit
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid
from holosplat.materials import HAEMOGLOBIN
from holosplat.mesh import TriangleMesh
from holosplat.methods import SurfaceFit, finished
from holosplat.methods.surface_fit import surface_fit
from holosplat.model import measure
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures, Scan
from holosplat.specimens.scene import MeshScene


def fitted(scan: Scan, start: SurfaceMesh, *, steps: int = 100, curvature: float = 3.0) -> SurfaceMesh:
    """The surfaces after a fit without records."""
    fit = surface_fit(scan, start, SurfaceFit(curvature=curvature, schedule=Schedule(steps=steps)))
    fit.run(lambda record: None)
    found = finished(fit)
    assert isinstance(found, SurfaceMesh)
    return found


@pytest.fixture(scope="module")
def few_views():
    """A bumpy body in four views without a common axis, a fifth held out; and a ball to start from."""
    pitch = 1e-6
    true = bumpy(3, 9.0, (0.6, -0.4, 0.3), depth=0.25)
    views = poses(5, (35, 42), seed=3, pitch=pitch)
    exposures = Exposures.of(views, 20.0, 0.05, 0.3)
    scene = MeshScene.of_one_material([replace(true, vertices=pitch * true.vertices)], HAEMOGLOBIN.delta_beta(20.0))
    scan = simulate(scene, exposures, is_test=np.array([0, 0, 0, 0, 1], dtype=bool))
    return scan, true, surfaces(bumpy(3, 8.5, depth=0.0), unit=pitch)


def dice(found: SurfaceMesh, true: TriangleMesh) -> float:
    grid = Grid.centred((33, 33, 33), 1e-6)
    a, b = (s.voxelise(grid).delta > 0.5 * DELTA for s in (found, surfaces(true)))
    return float(2 * (a & b).sum() / (a.sum() + b.sum()))


def test_a_deformed_ball_is_recovered_from_four_views(few_views):
    scan, true, start = few_views
    records = []
    fit = surface_fit(scan, start, SurfaceFit(rate=0.5, schedule=Schedule(steps=160)))
    fit.run(records.append)
    found = finished(fit)
    assert isinstance(found, SurfaceMesh)
    assert dice(start, true) < 0.92
    assert dice(found, true) > 0.985
    assert abs(found.mesh().volume / (true.volume * 1e-18) - 1) < 0.01
    assert fit.stopped_early
    assert [r["step"] for r in records] == list(range(1, len(records) + 1))
    assert records[-1]["rounded"] < 0.1 * records[0]["rounded"]
    held_out = scan.test()
    before, after = (
        float((measure(s, held_out.exposures, 2) - torch.from_numpy(held_out.frames)).abs().mean())
        for s in (start, found)
    )
    assert after < 0.1 * before
    assert torch.equal(found.faces, start.faces)


def test_smoothness_smooths_and_no_step_changes_nothing(few_views):
    scan, _, start = few_views
    noise = 0.3 * torch.randn(start.vertices.shape, generator=torch.Generator().manual_seed(1))
    rough = start.with_parameters({"vertices": start.vertices + noise})
    assert torch.equal(fitted(scan, rough, steps=0).vertices, rough.vertices)
    areas = [fitted(scan, rough, steps=8, curvature=w).mesh().area for w in (0.0, 1e4)]
    assert areas[1] < 0.97 * areas[0]


def test_senseless_fits_are_refused(few_views, monkeypatch):
    scan, _, start = few_views
    for make, words in (
        (lambda: SurfaceFit(rate=0.0), "rate must be a positive number of pixels"),
        (lambda: Schedule(decay=0.0), "decay must be a positive number"),
        (lambda: Schedule(steps=-1), "steps must not be negative"),
        (lambda: Objective(tv_volume=-1.0), "tv_volume must not be negative"),
        (lambda: SurfaceFit(curvature=-1.0), "curvature must not be negative"),
        (lambda: SurfaceFit(stiffness=-1.0), "stiffness must not be negative"),
    ):
        with pytest.raises(InputError, match=words):
            make()
    with pytest.raises(InputError, match="all training frames are constant"):
        fitted(replace(scan, frames=np.ones_like(scan.frames)), start)
    work = Fit._work
    monkeypatch.setattr(Fit, "_work", lambda fit, batch: work(fit, batch) * math.nan)
    with pytest.raises(InputError, match=r"diverged at step 1: .* lower the rates"):
        fitted(scan, start, steps=3)
