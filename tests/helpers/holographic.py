"""Cells and balls whose holograms the tests of the classical reconstructions share."""

from __future__ import annotations

import numpy as np

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN, DeltaBeta
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

PIXEL = 3.2e-6
SHAPE = (36, 40)
CELL = HAEMOGLOBIN.delta_beta(20)


def cells(material: DeltaBeta) -> MeshScene:
    """Four red cells in the field."""
    box = (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL)
    return MeshScene.of_one_material(random_cells(4, box, 2, 13 * PIXEL), material)


def scan_of(scene: MeshScene, views: Views) -> Scan:
    return simulate(scene, Exposures.of(views, 20.0, 0.1), is_test=np.zeros(len(views), dtype=bool))
