"""Bumpy balls as triangle surfaces, and views of them from all directions."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh, joined
from holosplat.representations import SurfaceMesh
from holosplat.specimens.red_cells import icosphere

SHAPE = (33, 46)
DELTA, BETA = HAEMOGLOBIN.delta_beta(20.0)


def bumpy(subdivisions: int, radius: float, centre=(0.0, 0.0, 0.0), depth: float = 0.15) -> TriangleMesh:
    """A ball with three smooth bumps, star-shaped about its centre."""
    sphere, faces = icosphere(subdivisions)
    bumps = 1 + depth * np.sin(2 * sphere[:, 0] + 1) * np.cos(2.5 * sphere[:, 1]) + 0.5 * depth * sphere[:, 2] ** 3
    return TriangleMesh(radius * bumps[:, None] * sphere + np.array(centre), faces)


def poses(count: int, shape=SHAPE, seed: int = 0, pitch: float = 1.0) -> Views:
    """Views from all directions, on detectors shifted by a pixel or two."""
    shifts = np.random.default_rng(seed).uniform(-2, 2, (count, 2)) * pitch
    return Views(Rotation.random(count, rng=seed).as_matrix(), shifts, shape, pitch)


def surfaces(*meshes: TriangleMesh, unit: float = 1e-6) -> SurfaceMesh:
    whole = joined(meshes)
    return SurfaceMesh(torch.from_numpy(whole.vertices), torch.from_numpy(whole.faces), unit, Matter.one(DELTA, BETA))
