"""Camera and pulses by their moments: photon transfer, read-out, rounding, saturation, defects, low-rank light."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.optics.camera import Camera, Illumination, PulseModel, Sensor, spread

EVEN = {"gain_spread": 0.0, "offset_spread": 0.0, "dead": 0.0, "hot": 0.0}
SHAPE = (151, 200)


def sensor(photons: float = 1000.0, shape: tuple[int, int] = SHAPE, **options: float) -> Sensor:
    return Sensor.drawn(Camera(**options), shape, photons, np.random.default_rng(3))  # type: ignore[arg-type]


def counts(of: Sensor, photons: float, seed: int = 0) -> np.ndarray:
    return of.read_out(np.full(of.gain.shape, photons), np.random.default_rng(seed)).astype(np.float64)


# --- the camera


def test_photon_transfer_the_variance_grows_with_the_mean_by_the_gain():
    """Variance against mean is a line of slope gain, from read noise² + 1/12 on (Janesick 2007, eq. 4.18)."""
    of = sensor(bits=16, gain=2.5, offset=300.0, read_noise=4.0, **EVEN)
    levels = np.array([0.0, 50.0, 200.0, 1000.0, 5000.0])
    frames = [counts(of, level, seed) for seed, level in enumerate(levels)]
    means, variances = np.array([f.mean() for f in frames]), np.array([f.var() for f in frames])
    assert means == pytest.approx(300 + 2.5 * levels, rel=2e-3)
    slope, start = np.polyfit(means - 300, variances, 1, w=1 / variances)
    assert slope == pytest.approx(2.5, rel=0.02)
    assert start == pytest.approx(16 + 1 / 12, rel=0.05)


def test_rounding_errs_evenly():
    """With no other noise, the error of rounding has the variance 1/12 (Bennett 1948)."""
    quiet = Camera(bits=10, gain=0.2, offset=100.0, read_noise=0.0, **EVEN)  # type: ignore[arg-type]
    exact = Sensor.drawn(quiet, SHAPE, 1000.0, np.random.default_rng(0))
    rng, again = np.random.default_rng(1), np.random.default_rng(1)
    light = np.linspace(500, 4000, exact.gain.size).reshape(SHAPE)
    error = exact.read_out(light, rng) - (0.2 * again.poisson(light) + 100)
    assert np.abs(error).max() <= 0.5
    fine = Camera(bits=10, gain=0.0137, offset=100.0, read_noise=0.0, **EVEN)  # type: ignore[arg-type]
    exact = Sensor.drawn(fine, SHAPE, 1000.0, np.random.default_rng(0))
    rng, again = np.random.default_rng(1), np.random.default_rng(1)
    error = exact.read_out(10 * light, rng) - (0.0137 * again.poisson(10 * light) + 100)
    assert error.var() == pytest.approx(1 / 12, rel=0.02)
    assert error.mean() == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_light_beyond_the_range_saturates(bits):
    of = sensor(bits=bits, gain=1.0, offset=20.0, **EVEN)
    assert counts(of, 2.0**bits * 3).min() == 2**bits - 1
    assert of.read_out(np.zeros(SHAPE), np.random.default_rng(0)).dtype == np.uint16
    assert counts(sensor(bits=bits, offset=0.0, read_noise=50.0, **EVEN), 0.0).min() == 0


def test_without_a_gain_flats_fill_forty_per_cent():
    of = sensor(photons=777.0, bits=14, **EVEN)
    assert counts(of, 777.0).mean() == pytest.approx(0.4 * (2**14 - 1), rel=2e-3)


def test_gains_offsets_and_defects_are_spread_as_asked():
    of = sensor(gain=2.0, gain_spread=0.03, offset_spread=5.0, dead=0.01, hot=0.02)
    good = ~of.defects
    assert of.gain[good].std() == pytest.approx(0.06, rel=0.03)
    assert of.offset[good].std() == pytest.approx(5.0, rel=0.03)
    assert (of.dead.mean(), of.hot.mean()) == pytest.approx((0.01, 0.02), rel=0.2)
    assert not (of.dead & of.hot).any()
    frame = counts(of, 500.0)
    assert frame[of.dead].mean() == pytest.approx(100, abs=2)
    assert (counts(of, 0.0)[of.hot] > 0.45 * 4095).all()


@pytest.mark.parametrize("sigma", [0.4, 1.1])
def test_a_scintillator_spreads_light_and_noise(sigma):
    """Each photon's light is spread, so the noise is too: its variance falls to Σ h² (and its sum stays)."""
    of = sensor(bits=16, gain=1.0, read_noise=0.0, scintillator_px=sigma, **EVEN)
    frames = np.stack([counts(of, 4000.0, seed) for seed in range(4)])[:, 8:-8, 8:-8] - 100  # mirrors double at the rim
    point = np.zeros(SHAPE)
    point[75, 100] = 1.0
    spot = spread(point, sigma)
    assert spot.sum() == pytest.approx(1)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    assert (spot * (x - 100) ** 2).sum() == pytest.approx(sigma**2, rel=1e-2)
    assert (spot * (y - 75) ** 2).sum() == pytest.approx(sigma**2, rel=1e-2)
    assert frames.mean() == pytest.approx(4000, rel=1e-3)
    assert frames.var() == pytest.approx(4000 * (spot**2).sum() + 1 / 12, rel=0.03)


def test_even_light_stays_even_at_the_border():
    assert spread(np.full((7, 11), 3.0), 2.0) == pytest.approx(np.full((7, 11), 3.0))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"bits": 8}, "bits must be at least 10"),
        ({"bits": 17}, "bits must be at most 16"),
        ({"gain": -1.0}, "gain must be at least 1e-06"),
        ({"read_noise": -1.0}, "read_noise must not be negative"),
        ({"offset": 5000.0}, "offset must be below the range of 4095"),
        ({"dead": 0.2, "hot": 0.1}, "at most a fifth"),
        ({"gain_spread": 0.5}, "gain_spread must be at most"),
    ],
)
def test_impossible_cameras_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        Camera(**options)


def test_an_offset_that_leaves_no_gain_is_refused():
    with pytest.raises(InputError, match="offset must be below 40%"):
        sensor(offset=3000.0)


# --- the light


def light(**options: float) -> PulseModel:
    return PulseModel.drawn(Illumination(**options), (17, 22), np.random.default_rng(5))  # type: ignore[arg-type]


def test_components_are_orthonormal_and_the_mean_is_one():
    model = light()
    flat = model.components.reshape(len(model.components), -1)
    assert flat @ flat.T / flat.shape[1] == pytest.approx(np.eye(len(flat)), abs=1e-7)
    assert model.mean.mean() == pytest.approx(1)
    assert (np.diff(model.deviations) <= 0).all()
    assert len(model.components) == 10


def test_drawn_pulses_have_the_models_covariance():
    """Σ d_k² c_k c_kᵀ, and no more rank than components."""
    model = light(energy_jitter=0.0, structure=0.1, variation=0.05)
    rng = np.random.default_rng(1)
    pulses = model.pulses(3000, rng)
    drawn = np.stack([model.light(pulses, n).reshape(-1) for n in range(len(pulses))])
    flat = model.components.reshape(len(model.components), -1) * model.deviations[:, None]
    wanted, found = flat.T @ flat, np.cov(drawn.T)
    assert np.linalg.norm(found - wanted) < 0.06 * np.linalg.norm(wanted)
    assert drawn.mean(0) == pytest.approx(model.mean.reshape(-1), abs=0.01)
    assert np.linalg.matrix_rank(drawn[:200] - drawn[:200].mean(0), tol=1e-6) == len(model.components)


def test_pulse_energies_are_gamma_distributed():
    """Mean 1, variance σ², third central moment 2σ⁴ (a gamma distribution of 1/σ² modes)."""
    energy = light(energy_jitter=0.3).pulses(200_000, np.random.default_rng(0)).energy
    assert energy.mean() == pytest.approx(1, rel=5e-3)
    assert energy.var() == pytest.approx(0.09, rel=0.02)
    assert ((energy - 1) ** 3).mean() == pytest.approx(2 * 0.3**4, rel=0.1)
    assert energy.min() > 0


def test_pointing_moves_the_beam():
    """With pointing only, the centre of mass moves as a shifted Gaussian's does, to first order."""
    model = PulseModel.drawn(
        Illumination(structure=0.0, variation=0.0, components=0, beam_width=0.12, pointing=0.1, energy_jitter=0.0),
        (61, 81),
        np.random.default_rng(0),
    )
    assert len(model.components) == 2
    pulses = model.pulses(3000, np.random.default_rng(2))
    x = np.arange(81) - 40.0
    centres = np.array([(model.light(pulses, n) * x).sum() / model.light(pulses, n).sum() for n in range(0, 3000, 3)])
    assert centres.std() == pytest.approx(0.1 * 0.12 * 81, rel=0.1)


def test_steady_light_is_steady():
    model = light(energy_jitter=0.0, pointing=0.0, variation=0.0)
    pulses = model.pulses(3, np.random.default_rng(0))
    assert len(model.components) == 0
    assert all(np.array_equal(model.light(pulses, n), model.mean) for n in range(3))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"energy_jitter": 1.5}, "energy_jitter must be at most 1"),
        ({"variation": 0.6}, "variation must be at most 0.3"),
        ({"pointing": -0.1}, "pointing must not be negative"),
        ({"beam_width": 0.0}, "beam_width must be a positive"),
        ({"grain_px": 0.0}, "grain_px must be a positive"),
        ({"components": 2000}, "components must be at most 1000"),
    ],
)
def test_impossible_light_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        Illumination(**options)
