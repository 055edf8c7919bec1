"""Light and electrons: told by wavelength and medium, propagated, kept in files, and shown so."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.cli.convert import RatioOptions
from holosplat.cli.options import BeamlineOptions, MaterialOptions
from holosplat.geometry import Views
from holosplat.io.formats import loader_of, read, read_as
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Reading, Told
from holosplat.materials import WATER
from holosplat.model import Instrument
from holosplat.planning.scan_facts import facts_of_scan
from holosplat.scan import Exposures, Scan
from holosplat.units import beam_named, photon_energy, wavelength
from holosplat.volume import LineIntegrals

VACUUM_M, MEDIUM, CELL = 532e-9, 1.334, 1.36
LIGHT = photon_energy(VACUUM_M, MEDIUM)


def exposures(energy: float) -> Exposures:
    return Exposures.of(Views.evenly_spaced(2, shape=(9, 13), pixel_size=2e-6), energy, 4e-4)


def test_the_wave_travels_in_the_medium_and_its_phase_is_that_of_the_difference_of_indices():
    """A cell of the larger index, by its own wavelengths: 2π (n - n₀) T/λ₀ of phase, and λ₀/n₀ on the way."""
    pitch, z, n = 2e-6, 4e-4, 48
    views = Views.evenly_spaced(1, shape=(n, n), pixel_size=pitch)
    instrument = Instrument(Exposures.of(views, LIGHT, z), 1, torch.float64)
    rows, columns = instrument.views.shape
    y, x = (np.arange(m) - 0.5 * (m - 1) for m in (rows, columns))
    thickness = 9e-6 * np.exp(-(y[:, None] ** 2 + x**2) / (2 * 4.0**2))
    delta = MaterialOptions(index=CELL).filling(MEDIUM).of("cell", LIGHT).delta
    found = instrument.frames(LineIntegrals(torch.from_numpy(thickness)[None, None], ((delta, 0.0),)))[0].numpy()
    wave = np.exp(2j * np.pi * (CELL - MEDIUM) * thickness / VACUUM_M)
    f2 = np.fft.fftfreq(rows, pitch)[:, None] ** 2 + np.fft.fftfreq(columns, pitch) ** 2
    way = np.exp(-1j * np.pi * VACUUM_M / MEDIUM * z * f2)
    my, mx = instrument.margin
    wanted = np.abs(np.fft.ifft2(np.fft.fft2(wave) * way))[my : my + n, mx : mx + n] ** 2
    assert np.ptp(wanted) > 1
    assert found[n // 2, n // 2] > 1.5  # it gathers light, as a lens does
    assert np.abs(found - wanted).max() < 2e-3


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (20.0, ("photon energy", "20 keV")),
        (np.array([15.0, 24.0]), ("photon energy", "15 to 24 keV")),
        (LIGHT, ("wavelength in medium", "398.8 nm")),
        (photon_energy(10.6e-6), ("wavelength in medium", "10.6 µm")),
        (photon_energy(1.97e-12), ("wavelength in medium", "1.97 pm")),
    ],
)
def test_a_beam_is_named_in_the_unit_that_suits(said, text):
    assert beam_named(said) == text


@pytest.mark.parametrize("energy", [LIGHT, photon_energy(1.97e-12)])
def test_files_keep_the_wavelength(energy, tmp_path: Path):
    scan = Scan(np.ones((2, 9, 13)), exposures(energy), np.zeros(2))
    write_scan(tmp_path / "s.nxs", scan)
    assert read(tmp_path / "s.nxs").exposures.energy_kev == pytest.approx([energy, energy], rel=1e-12)


def test_what_is_said_of_light_goes_before_the_file(tmp_path: Path):
    write_scan(tmp_path / "s.nxs", Scan(np.ones((2, 9, 13)), exposures(20.0), np.zeros(2)))
    with h5py.File(tmp_path / "s.nxs") as file:
        assert file["entry/instrument/source/probe"].asstr()[()] == "x-ray"
    told = Reading(Told(wavelength=VACUUM_M, medium_index=MEDIUM))
    found = read_as(tmp_path / "s.nxs", told).exposures
    assert wavelength(found.energy_kev) == pytest.approx([VACUUM_M / MEDIUM] * 2, rel=1e-12)
    rows = facts_of_scan(loader_of(tmp_path / "s.nxs"), tmp_path / "s.nxs", told).facts.rows
    assert (rows["wavelength in medium"], "photon energy" in rows) == ("398.8 nm", False)


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"energy_kev": 20.0, "wavelength": 5e-7}, "--energy-kev and --wavelength say the same; give one"),
        ({"medium_index": 1.33}, "--medium-index needs --wavelength"),
        ({"energy_kev": 0.002}, "--energy-kev must lie between 0.1 and 1000 keV, but it is 0.002; .* by --wavelength"),
        ({"wavelength": 5e-2}, "--wavelength must lie between 1.24e-12 and 0.001 metres, but it is 0.05"),
    ],
)
def test_beams_that_contradict_or_cannot_be_are_refused(told, said):
    with pytest.raises(InputError, match=said):
        Told(**told).given()


def test_a_simulation_takes_one_of_energy_and_wavelength():
    said = BeamlineOptions(detector=(9, 13), wavelength=VACUUM_M, medium_index=MEDIUM).told()
    assert said.energy_kev == LIGHT
    with pytest.raises(InputError, match="--energy-kev and --wavelength say the same"):
        BeamlineOptions(detector=(9, 13), energy_kev=10.0, wavelength=VACUUM_M).told()


def test_no_formula_speaks_of_light():
    with pytest.raises(
        InputError, match=r"between 0.1 and 400 keV .* tabulated for X-rays.*398.8 nm.*refractive index"
    ):
        WATER.delta_beta(LIGHT)
    with pytest.raises(InputError, match="leave --material"):
        MaterialOptions(index=1.4, material="water").filling()


def test_cells_in_light_are_retrieved_below_the_medium():
    """Their δ is negative, so that their phase is positive."""
    below, _ = RatioOptions(delta_beta=1e5, contrast="below").at(LIGHT)
    assert below.delta < 0
    assert below.delta / below.beta == pytest.approx(1e5)
    with pytest.raises(InputError, match="--contrast goes with --delta-beta"):
        RatioOptions(material="water", contrast="below").at(20.0)
