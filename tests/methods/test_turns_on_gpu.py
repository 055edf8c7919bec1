"""Turns of surfaces and volume with all tensors where a GPU's would be."""

from __future__ import annotations

import pytest

from helpers.noisy_cells import error, mesh_of, occupancy, task_of
from helpers.pretended_gpu import pretended_gpu
from holosplat.backends import Backend
from holosplat.baselines import HolographicTV
from holosplat.fit.problem import Schedule
from holosplat.methods import Gaussians, SurfaceOptions
from holosplat.methods.coarse import CoarseToFine, missing_matter
from holosplat.methods.first_surfaces import in_turns
from holosplat.methods.surface_fit import SurfaceFit
from holosplat.representations import SurfaceMesh

triton = pytest.importorskip("triton")


def turned(backend: Backend) -> SurfaceMesh:
    """Cells of which one is missing, after a turn."""
    task, how = task_of(2000.0), SurfaceOptions(fit=SurfaceFit(schedule=Schedule(steps=20), backend=backend))
    coarse = CoarseToFine(coarse_steps=3, views=1, turns=1)
    options = Gaussians(volume=HolographicTV(corrections=2, settling=1, backend=backend), coarse=coarse)
    found = in_turns(task, mesh_of(3), options, how)
    assert missing_matter(found, task, how) < missing_matter(mesh_of(3), task, how)
    return found


def test_turns_end_where_they_end_on_the_cpu(monkeypatch):
    true = turned("cpu")
    with pretended_gpu(monkeypatch, kernels=False):
        same = turned("cuda").on("cpu")
    assert error(true) < error(mesh_of(3))
    assert occupancy(same) == pytest.approx(occupancy(true), abs=1e-3)
