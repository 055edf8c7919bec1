"""Faces along the beam, where the phase jumps within a sample, are simulated by the mean of the wave."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from holosplat.beamline.simulate import Simulation, _Sharp, simulated_frames
from holosplat.geometry import Views
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model import measure
from holosplat.scan import Exposures
from holosplat.specimens.drawn import box_mesh
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavenumber

DELTA = 1e-6


def ball(radius: float, delta: float) -> MeshScene:
    vertices, faces = icosphere(3)
    return MeshScene((TriangleMesh(radius * vertices, faces),), (DeltaBeta(delta, 0.0),))


@pytest.mark.parametrize(("phase", "turned"), [(1.5, False), (2.0, False), (4.0, False), (4.0, True)])
def test_flat_faces_along_the_beam(phase, turned):
    """A slab between two faces along the beam: its wave is 1 + (exp(-iφ) - 1)(F(x - a) - F(x - b)), F by Fresnel's
    integrals (Born & Wolf 1999, 8.7.3). The error of frames falls with their samples, and the wave's mean is better
    than that of the phase. Turned: the faces are above each other."""
    shape, pixel, energy, z = (5, 63), 0.5e-6, 20.0, 0.05
    k = float(wavenumber(energy))
    left, right, depth = -6.13e-6, 5.29e-6, phase / (k * DELTA)
    low, high = (left, -1e-4, -depth / 2), (right, 1e-4, depth / 2)
    order = [1, 0, 2] if turned else [0, 1, 2]
    box = box_mesh(np.array(low)[order], np.array(high)[order])
    slab = MeshScene((box,), (DeltaBeta(DELTA, 0.0),))
    taken = Exposures.of(Views.from_angles([0.0], shape[::-1] if turned else shape, pixel), energy, z)
    parts = 100
    x = ((np.arange(shape[1] * parts) + 0.5) / parts - shape[1] / 2) * pixel
    sine, cosine = fresnel(np.sqrt(k / (np.pi * z)) * (x - np.array([[left], [right]])))
    edges = 0.5 + (cosine + 1j * sine) * (1 - 1j) / 2
    wave = 1 + (np.exp(-1j * phase) - 1) * (edges[0] - edges[1])
    exact = (np.abs(wave) ** 2).reshape(shape[1], parts).mean(1)

    def error(frame: np.ndarray) -> float:
        return float(np.linalg.norm((frame.T if turned else frame)[2] - exact) / np.linalg.norm(exact - 1))

    found = [error(next(simulated_frames(slab, taken, Simulation(oversample=n)))) for n in (4, 6, 8, 12)]
    assert max(found) < 0.05
    assert found[2] < 0.02
    assert found[3] < 0.5 * found[0]
    assert error(measure(slab, taken, 4, torch.float64)[0].numpy()) > 0.05


def test_what_is_not_steep_is_sampled_as_it_was():
    """Soft balls, whose phase does not jump, bit for bit: one that is not looked at more
    finely, and one that is. Frames of a steep one come nearer to the limit."""
    taken = Exposures.of(Views.from_angles([20.0], (31, 44), 1e-6), 20.0, 0.02)
    soft, steep, limit = ball(6e-6, 4e-7), ball(6e-6, 1e-5), 24
    for one in (soft, ball(6e-6, 1.2e-6)):
        np.testing.assert_array_equal(_Sharp(one, taken).project(taken.views)[1], one.project(taken.views)[1])
    exact = measure(steep, taken, limit, torch.float64)[0]
    found = [measure(obj, taken, 6, torch.float64)[0] for obj in (_Sharp(steep, taken), steep)]
    sharp, plain = (float((frame - exact).norm()) for frame in found)
    assert sharp < 0.9 * plain


def test_both_sides_of_a_face_between_tiles_are_looked_at():
    """And a last tile that would stand out of the raster ends with it."""
    phase = torch.zeros(19, 21)
    phase[:, 8:] = 2
    assert _Sharp._tiles(phase, 8, 8) == [(i, j) for i in (0, 8, 11) for j in (0, 8)]
    assert _Sharp._tiles(phase.T[:, :11].contiguous(), 8, 8) == [(i, j) for i in (0, 8) for j in (0, 3)]
    assert _Sharp._tiles(0.2 * phase, 8, 8) == []
