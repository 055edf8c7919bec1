"""Spectra: frames are the incoherent sum of their energies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.imaging import cells, taken
from holosplat.beamline.simulate import Filling, Simulation, polychromatic_frames, read_spectrum, refilled, simulate
from holosplat.checks import InputError
from holosplat.materials import HAEMOGLOBIN
from holosplat.optics.coherence import Spectrum
from holosplat.specimens.scene import MeshScene, MeshSeries


def test_a_spectrum_is_the_incoherent_sum_of_its_energies():
    filling, light = Filling(), Spectrum(np.array([18.0, 22.0]), np.array([1.0, 3.0]))
    exposures = taken(count=2)
    found = np.stack(
        list(polychromatic_frames(lambda e: refilled(cells(), filling, e), light, exposures, Simulation(oversample=3)))
    )
    wanted = 0.0
    for energy, weight in ((18.0, 0.25), (22.0, 0.75)):
        scene = MeshScene.of_one_material(cells().meshes, HAEMOGLOBIN.delta_beta(energy))
        wanted = wanted + weight * simulate(scene, replace(exposures, energy_kev=energy), oversample=3).frames
    assert found == pytest.approx(wanted, abs=1e-6)
    noisy = Simulation(50.0, 1, 3)
    drawn = np.stack(list(polychromatic_frames(lambda e: refilled(cells(), filling, e), light, exposures, noisy)))
    assert np.allclose(drawn * 50, np.rint(drawn * 50), atol=1e-4)
    assert (drawn - found).std() == pytest.approx(np.sqrt(1 / 50), rel=0.05)


def test_a_moving_series_is_refilled_too():
    series = MeshSeries((cells(), cells().moved(np.ones(3) * 1e-6)), np.array([0.0, 1.0]))
    filled = refilled(series, Filling(), 10.0)
    assert isinstance(filled, MeshSeries)
    assert all(m == HAEMOGLOBIN.delta_beta(10.0) for scene in filled.snapshots for m in scene.materials)


def test_spectrum_files(tmp_path):
    path = tmp_path / "spectrum.txt"
    path.write_text("# keV weight\n9.0 1\n9.1 3\n")
    assert read_spectrum(path).weights.tolist() == [0.25, 0.75]
    for text in ("9.0 1 2\n", "nine one\n", "9.0\n"):
        path.write_text(text)
        with pytest.raises(InputError, match="two columns of numbers"):
            read_spectrum(path)
    with pytest.raises(InputError, match="there is no such file"):
        read_spectrum(tmp_path / "none.txt")
