"""Uneven light: its statistics, where photons come in, and what a scan file says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.energies import frames_by_energy
from helpers.imaging import cells, taken
from holosplat.beamline.light import EVEN_LIGHT, UnevenLight, correlated_field
from holosplat.beamline.simulate import Simulation, polychromatic_frames, simulate, simulated_frames
from holosplat.checks import InputError
from holosplat.optics.coherence import Spectrum

SHAPE = (41, 66)


def near(value, rel=1e-6, abs=0.0):
    return pytest.approx(value, rel=rel, abs=abs)


@pytest.mark.parametrize("length", [0.8, 2.0, 6.0])
def test_fields_have_their_variance_and_correlation(length):
    rng = np.random.default_rng(1)
    fields = np.stack([correlated_field((63, 90), length, rng) for _ in range(120)])
    spread = 4 * np.sqrt(4 * np.pi * length**2 / fields.size) + 0.01  # of means over so many independent patches
    assert np.mean(fields**2) == near(1, abs=2 * spread)
    for lag in (1, 3, 8):
        wanted = np.exp(-(lag**2) / (2 * length**2))
        assert np.mean(fields[:, lag:] * fields[:, :-lag]) == near(wanted, abs=2 * spread)
        assert np.mean(fields[:, :, lag:] * fields[:, :, :-lag]) == near(wanted, abs=2 * spread)


def test_edges_of_fields_are_as_good_as_their_middle():
    """The raster is larger than the field, so that opposite edges have nothing to do with each other."""
    rng = np.random.default_rng(2)
    fields = np.stack([correlated_field(SHAPE, 3.0, rng) for _ in range(300)])
    assert abs(np.mean(fields[:, 0] * fields[:, -1])) < 0.04
    assert np.mean(fields[:, 0] ** 2) == near(1, abs=0.08)


def test_each_part_of_the_light_is_what_it_says():
    """Means over many frames of empty light."""

    def light(**options) -> np.ndarray:
        lamp = UnevenLight(**options).on(200, SHAPE)
        return np.stack([lamp.recorded(np.ones(SHAPE), n) for n in range(200)])

    assert light(light_flux=0.71) == near(0.71)
    offsets = light(light_offset=0.05)
    assert np.ptp(offsets, axis=(1, 2)).max() < 1e-12
    assert offsets[:, 0, 0].std() == near(0.05, rel=0.2)
    slopes = light(light_slope=0.03) - 1
    assert slopes.mean((1, 2)) == near(0, abs=1e-9)
    assert np.abs(np.diff(slopes, 2, axis=1)).max() < 1e-12
    right = slopes[:, SHAPE[0] // 2, -1] / (1 - 1 / SHAPE[1])
    assert right.std() == near(0.03, rel=0.2)
    assert light(light_smooth=0.02, light_smooth_px=5).std() == near(0.02, rel=0.05)
    assert light(light_grain=0.01).std() == near(0.01, rel=0.03)
    assert not np.array_equal(light(light_grain=0.01), light(light_grain=0.01, light_seed=1))


def test_a_pattern_drifts_sideways():
    how = UnevenLight(light_pattern=0.05, light_pattern_px=4.0, light_drift_px=12.0)
    lamp = how.on(4, SHAPE)
    first, second = lamp.arriving(0), lamp.arriving(1)
    assert first == near(lamp.flat)
    assert second[:, 4:] == near(first[:, :-4])  # by 4 pixels a frame, to the right
    assert lamp.recorded(np.ones(SHAPE), 0) == near(1)
    assert lamp.recorded(np.ones(SHAPE), 2).std() > 0.03
    back = replace(how, light_drift_px=-12.0).on(4, SHAPE)
    assert back.arriving(1)[:, :-4] == near(back.arriving(0)[:, 4:])
    half = replace(how, light_drift_px=1.5).on(4, SHAPE)
    between = 0.5 * (half.arriving(0)[:, 1:] + half.arriving(0)[:, :-1])
    assert half.arriving(1)[:, 1:] == near(between)


def test_photons_see_the_light():
    """Counts are whole, and the flat divides afterwards: the variance is that of counts of the mean photons × light."""
    how = UnevenLight(light_flux=0.25, light_pattern=0.15, light_pattern_px=6.0)
    shape = (15, 22)
    lamp, rng, photons = how.on(1, shape), np.random.default_rng(0), 40.0
    frames = np.stack([lamp.recorded(np.ones(shape), 0, photons, rng) for _ in range(400)])
    counts = frames * photons * lamp.flat
    assert counts == near(np.rint(counts), abs=1e-9)
    assert frames.mean(0) == near(0.25, rel=0.08)
    assert np.mean(frames.var(0) * lamp.flat) == near(0.25 / photons, rel=0.02)
    assert np.corrcoef(frames.var(0).ravel(), (1 / lamp.flat).ravel())[0, 1] > 0.6


def test_simulations_take_light_last():
    exposures, how = taken(count=3), UnevenLight(light_offset=0.1, light_grain=0.02, light_seed=4)
    clean, lit = (simulate(cells(), exposures, oversample=2, light=light) for light in (EVEN_LIGHT, how))
    lamp = how.on(3, exposures.views.shape)
    wanted = np.stack([lamp.recorded(frame.astype(float), n) for n, frame in enumerate(clean.frames)])
    assert lit.frames == near(wanted, rel=1e-6)
    assert lit.provenance["light_offset"] == "0.1"
    assert lit.provenance["light_seed"] == "4"
    assert not any(name.startswith("light") for name in clean.provenance)
    options = Simulation(50.0, 1, 2, light=how)
    one_by_one = np.stack(list(simulated_frames(cells(), exposures, options)))
    spectrum = Spectrum(np.array([exposures.energy_kev[0]]), np.ones(1))
    assert np.array_equal(
        one_by_one, np.stack(list(polychromatic_frames(lambda e: cells(), spectrum, exposures, options)))
    )
    assert np.array_equal(one_by_one, np.stack(list(frames_by_energy(lambda e: cells(), exposures, options))))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"light_flux": 0.0}, "light_flux must be at least 0.01"),
        ({"light_smooth": 0.5}, "light_smooth must be at most 0.2"),
        ({"light_grain": -0.1}, "light_grain must not be negative"),
        ({"light_grain_px": 0.1}, "light_grain_px must be at least 0.3"),
        ({"light_drift_px": 3.0}, "light_drift_px moves the pattern, of which there is none"),
        ({"light_pattern": 0.1, "light_drift_px": 1e5}, "light_drift_px must be at most 10000"),
        ({"light_seed": -1}, "light_seed must not be negative"),
    ],
)
def test_light_out_of_range_is_refused(options, match):
    with pytest.raises(InputError, match=match):
        UnevenLight(**options)
