"""Simulations whose waves and rays are where a GPU's would be."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.pretended_gpu import pretended_gpu
from holosplat.beamline.simulate import Shutter, Simulation, simulated_frames
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene, MeshSeries
from holosplat.volume import Object
from holosplat_bench.specimens.soft_matter import shepp_logan

pytest.importorskip("triton")

MATERIAL, OTHER = DeltaBeta(7e-7, 2.6e-10), DeltaBeta(3e-7, 4e-10)
EXPOSURES = Exposures.of(Views.from_angles([0.0, 70.0], (21, 26), 1e-6), 20.0, 0.05, 0.6)


def cells() -> MeshScene:
    """Three cells, of two materials."""
    return MeshScene(tuple(random_cells(3, (20e-6,) * 3, 0, 8e-6)), (MATERIAL, OTHER, MATERIAL))


def moving() -> MeshSeries:
    """The cells on their way."""
    return MeshSeries((cells(), cells().moved(np.array([3e-6, 0, 0]))), np.array([-1e-3, 1e-3]))


SPECIMENS = {
    "cells": (cells(), Shutter()),
    "moving cells": (moving(), Shutter(1e-3, 3)),
    "continuous matter": (shepp_logan(15e-6, MATERIAL), Shutter()),
}


def frames(matter: Object, shutter: Shutter, backend: str) -> np.ndarray:
    how = Simulation(photons_per_pixel=1000.0, seed=2, oversample=3, shutter=shutter, backend=backend)  # type: ignore[arg-type]
    return np.array(list(simulated_frames(matter, EXPOSURES, how)))


@pytest.mark.parametrize("name", SPECIMENS)
def test_frames_are_those_of_the_cpu(name, monkeypatch):
    true = frames(*SPECIMENS[name], "cpu")
    with pretended_gpu(monkeypatch):
        found = frames(*SPECIMENS[name], "cuda")
    assert np.ptp(true) > 0.05
    np.testing.assert_allclose(found, true, atol=1e-5)
