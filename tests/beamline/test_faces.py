"""Faces along the beam, where the phase jumps within a sample, are simulated by the mean of the wave."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from holosplat.beamline.simulate import Simulation, _may_jump, _Sharp, _tiles, simulated_frames
from holosplat.geometry import Views
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model import measure
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavenumber
from holosplat_bench.specimens.shapes import box_mesh

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


@pytest.mark.parametrize("faces", [True, False])
def test_views_of_faces_along_the_beam_have_twice_the_samples(faces):
    """Unless their number is told; and no others do: those of a ball, and of the same box at an angle."""
    views = Views.from_angles([0.0] if faces else [30.0, 0.0], (9, 31), 1e-6)
    taken = Exposures.of(views, 20.0, 0.02)
    box = MeshScene((box_mesh((-6e-6, -1e-4, -9e-6), (5e-6, 1e-4, 9e-6)),), (DeltaBeta(DELTA, 0.0),))
    usual = Simulation().samples(taken)
    objects = [box] if faces else [box, ball(6e-6, DELTA)]
    for k, obj in enumerate(objects):
        one = taken[[k]]
        found, fine = (
            next(simulated_frames(obj, one, how)) for how in (Simulation(), Simulation(oversample=2 * usual))
        )
        plain = next(simulated_frames(obj, one, Simulation(oversample=usual)))
        assert np.array_equal(found, fine) is faces
        assert np.array_equal(found, plain) is not faces


@pytest.mark.parametrize("delta", [4e-7, 1.2e-6, 1e-5])
def test_round_edges_are_sampled_as_they_were(delta):
    """Bit for bit, on six samples a pixel: the mean of the wave would lose light there."""
    views, obj = Views.from_angles([20.0], (31, 44), 1e-6), ball(6e-6, delta)
    taken, fine = Exposures.of(views, 20.0, 0.02), views.refined(6)
    np.testing.assert_array_equal(_Sharp(obj, taken)._lines(fine), torch.stack(_Sharp(obj, taken).project(fine)))


def test_a_bevel_in_one_sample_is_no_jump():
    """Four fifths of a sample wide, of 3 rad: it is looked at more finely, and no two of these differ by half a radian;
    the face across from it is a jump."""
    taken = Exposures.of(Views.from_angles([0.0], (15, 31), 1e-6), 20.0, 0.02)
    box = box_mesh((-0.4e-6, -1e-4, 0.0), (9e-6, 1e-4, 3 / (float(wavenumber(20.0)) * DELTA)))
    bevelled = box.vertices.copy()
    bevelled[(bevelled[:, 0] < 0) & (bevelled[:, 2] > 0), 0] += 0.8e-6
    obj = _Sharp(MeshScene((TriangleMesh(bevelled, box.faces),), (DeltaBeta(DELTA, 0.0),)), taken)
    before, after = obj._lines(taken.views), torch.stack(obj.project(taken.views))
    assert _may_jump(float(wavenumber(20.0)) * before[1, 0])[7].nonzero().flatten().tolist() == [15, 24]
    assert (before != after).any(dim=0)[0, 7].nonzero().flatten().tolist() == [24]


def test_samples_within_which_the_phase_may_jump():
    """Not those of a slope, of a round edge, or of a small step; a last tile ends with the raster."""
    x = torch.arange(21.0)[None].expand(19, 21)
    step = 1.5 * (x > 7) + 0.5 * (x > 8)
    assert _may_jump(step).nonzero().unique(dim=0).tolist() == [[i, 8] for i in range(19)]
    assert torch.equal(_may_jump(step.T), _may_jump(step).T)
    for still in (3 * x, 9 * (x - 7.3).clamp_min(0).sqrt(), 0.4 * step):
        assert not _may_jump(still).any()
    assert _tiles(_may_jump(step), 8, 8) == [(i, j) for i in (0, 8, 11) for j in (8,)]
