"""A decaying shock: its jump, compression and rarefaction, and line integrals beside quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.specimens import ContinuousScene, ellipsoid
from holosplat_bench.specimens.fluids import Blast

TAILS = [0.05, 0.15, 1.0]


def test_the_density_jumps_and_decays_to_below_that_of_the_medium():
    wave = Blast(0.1)
    s = np.array([1 + 1e-9, 1 - 1e-9, 0.95, 0.9, 0.8, 0.3])
    found = wave.density(s**2)
    assert found[0] == 0
    assert found[1] == pytest.approx(1, abs=1e-6)
    assert found[2] == pytest.approx(0.5 * np.exp(-0.5))
    assert found[3] == pytest.approx(0, abs=1e-12)
    assert found[4] == pytest.approx(-np.exp(-2))
    assert found[5] < 0
    assert wave.density(np.linspace(0, 1.5, 999) ** 2).min() == pytest.approx(-np.exp(-2), rel=1e-3, abs=0)
    assert Blast(0.1, 0.4).density(np.array([0.39, 0.41]) ** 2)[0] == 0


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("core", [0.0, 0.3])
def test_line_integrals_and_mass_are_those_of_quadrature(tail, core):
    wave = Blast(tail, core)
    largest = wave.chord(np.linspace(0, 1, 501) ** 2).max()
    for b in (0.0, 0.2, 0.31, 0.6, 0.97, 1.01):
        ends = (np.sqrt(max(core**2 - b**2, 0)), np.sqrt(max(1 - b**2, 0)))
        straight = 2 * quad(lambda t, b=b: float(wave.density(np.array(b**2 + t**2))), *ends, limit=400)[0]
        assert wave.chord(np.array([b**2]))[0] == pytest.approx(straight, abs=2e-6 * largest)
    mass = quad(lambda s: float(wave.density(np.array(s**2))) * 4 * np.pi * s**2, core, 1, limit=400)[0]
    assert wave.mass == pytest.approx(mass, abs=1e-7)


def test_frames_and_voxels_hold_its_mass():
    """On a rectangular, odd-sized field; the mean of voxels about the front is right to 1 %."""
    matter, pixel = DeltaBeta(5e-8, 1e-11), 1e-6
    scene = ContinuousScene((ellipsoid((1e-6, 0, -2e-6), (17e-6,) * 3, Blast(0.3, 0.2), matter),))
    views = Views.from_angles([0.0, 70.0], (39, 45), pixel)
    sums = scene.project(views)[1].sum(dim=(1, 2)).numpy() * pixel**2
    assert sums == pytest.approx(scene.mass.delta, rel=5e-3, abs=0)
    total = float(scene.voxelise(Grid.of_views(views)).delta.sum(dtype=float)) * pixel**3
    assert total == pytest.approx(scene.mass.delta, rel=1e-2, abs=0)


def test_a_core_within_the_front_is_wanted():
    with pytest.raises(InputError, match="core_radius must be below 1"):
        Blast(0.1, 1.0)
