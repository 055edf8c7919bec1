"""What tests of the study share: two balls, measured, and the thesis' configurations with few Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.scan import Exposures, interleaved_split
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat_bench.declaration import Case
from holosplat_bench.thesis.configurations import THESIS_TABLE, Configuration, Measured


@pytest.fixture(scope="session")
def balls() -> Case:
    """Two balls in six training and two held-out views of 15 × 22 pixels of 1 µm."""
    sphere, faces = icosphere(2)
    meshes = [TriangleMesh(3e-6 * sphere + np.array([x, 0, 0]), faces, "ball") for x in (-5e-6, 5e-6)]
    exposures = Exposures.of(Views.evenly_spaced(8, (15, 22), 1e-6), 20.0, 0.05)
    scene = MeshScene.of_one_material(meshes, HAEMOGLOBIN.delta_beta(20.0))
    return Case("two balls", 3, scene, exposures, interleaved_split(8), MaterialPrior.unknown())


@pytest.fixture(scope="session")
def measured(balls) -> Measured:
    """The two balls, measured as they are declared."""
    return Measured.of(balls)


@pytest.fixture(scope="session")
def few() -> tuple[Configuration, ...]:
    """The thesis' eight configurations with few Gaussians."""
    return tuple(replace(c, count=max(40, c.count // 1000)) for c in THESIS_TABLE)
