"""Opaque discs in the holograms of two cameras: simulated by waves through masks on a finer raster, plane by plane; and
measured droplets where they are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from holosplat.checks import InputError
from holosplat.motion.particles import Particle, ParticleOptions, find_particles, link_particles
from holosplat.optics.resampling import InLine, refocused, register
from holosplat.preprocess.pixels import fixed_background

WAVELENGTH, PIXEL = 0.6328e-6, 10e-6
SHAPE, FINER = (97, 131), 2
OPTICS = InLine(WAVELENGTH, PIXEL, (0.060, 0.045))
OPTIONS = ParticleOptions(radius=(20e-6, 50e-6), depth=(-0.012, 0.012), bins=1)
DISCS = np.array([[-210e-6, 120e-6, -4.0e-3, 38e-6], [245e-6, -95e-6, 5.5e-3, 27e-6]])
"""x, y, z, radius [m]."""
DROPLETS = Path(__file__).resolve().parents[3] / "shared/data/real/droplets_two_cameras.npz"


def free_space(wave: np.ndarray, distance: float) -> np.ndarray:
    """A wave on the fine raster after a distance [m]."""
    fy, fx = (np.fft.fftfreq(n, PIXEL / FINER) for n in wave.shape)
    turn = np.exp(-1j * np.pi * WAVELENGTH * distance * (fy[:, None] ** 2 + fx**2))
    return np.fft.ifft2(np.fft.fft2(wave) * turn)


def holograms(discs: np.ndarray, distances=OPTICS.distances, noise: float = 0.02, seed: int = 0) -> np.ndarray:
    """[C, H, W]: light through each disc's plane in turn, from fine samples, on a raster three times as large."""
    rows, columns = (3 * FINER * n for n in SHAPE)
    y, x = (((np.arange(n) + 0.5) / FINER - 0.5 * n / FINER) * PIXEL for n in (rows, columns))
    wave, place = np.ones((rows, columns), dtype=complex), float(discs[:, 2].min())
    for cx, cy, z, radius in discs[np.argsort(discs[:, 2])]:
        wave, place = free_space(wave, z - place), z
        wave = np.where(np.hypot(x - cx, (y - cy)[:, None]) < radius, 0, wave)
    found = []
    for distance in distances:
        light = np.abs(free_space(wave, distance - place)) ** 2
        pixels = light.reshape(rows // FINER, FINER, columns // FINER, FINER).mean(axis=(1, 3))
        found.append(pixels[SHAPE[0] : 2 * SHAPE[0], SHAPE[1] : 2 * SHAPE[1]])
    return np.array(found) + noise * np.random.default_rng(seed).normal(size=(len(distances), *SHAPE))


def test_two_discs_are_found_in_three_dimensions():
    found = sorted(find_particles(holograms(DISCS), OPTICS, OPTIONS), key=lambda one: one.centre[0])
    assert len(found) == 2
    for one, truth in zip(found, DISCS):
        assert one.centre[:2] == pytest.approx(truth[:2], abs=0.1 * PIXEL)
        assert one.centre[2] == pytest.approx(truth[2], abs=0.5e-3)
        assert one.radius == pytest.approx(truth[3], abs=2e-6)
        assert np.all(np.abs([*one.centre, one.radius] - truth)[:2] < 5 * one.errors[:2])


def test_a_disc_beyond_the_frames_is_found_by_its_fringes():
    beyond = np.array([[740e-6, 40e-6, 1.0e-3, 40e-6]])  # 85 µm outside
    one = max(find_particles(holograms(beyond), OPTICS, OPTIONS), key=lambda each: each.radius)
    assert one.centre[:2] == pytest.approx(beyond[0, :2], abs=0.5 * PIXEL)


def test_noise_holds_no_particle():
    assert not find_particles(1 + 0.02 * np.random.default_rng(1).normal(size=(2, *SHAPE)), OPTICS, OPTIONS)


def test_the_mode_is_the_light_without_what_passes():
    random = np.random.default_rng(0)
    light = random.uniform(30, 90, (9, 7))
    counts = random.poisson(light, (31, 9, 7))
    counts[5:11] //= 4  # a shadow at a fifth of the times
    found = fixed_background(counts)
    assert np.abs(found / light - 1).mean() < 0.6 * np.abs(counts.mean(0) / light - 1).mean()


def test_a_plate_registers_two_cameras_to_a_tenth_of_a_pixel():
    """A plate in the light, seen at two distances by cameras that differ in shift, turn and magnification."""
    random, shape = np.random.default_rng(2), (261, 300)
    plate = np.clip(gaussian_filter((random.random(shape) < 0.03).astype(float), 1.5) * 6, 0, 0.4)
    turn, larger, shift = 0.01, 1.002, np.array([-3.4, 1.7])
    matrix = larger * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    optics = InLine(WAVELENGTH, PIXEL, (0.02, 0.03))
    one, other = (np.abs(refocused(1 - plate, optics, -d)) ** 2 for d in optics.distances)
    centre = 0.5 * (np.array(shape) - 1)
    back = np.linalg.inv(matrix)
    places = np.indices(shape) - (centre + shift)[:, None, None]
    moved = map_coordinates(other, np.einsum("ij,jhw->ihw", back, places) + centre[:, None, None], order=5)
    noise = 0.01 * random.normal(size=(2, *shape))
    (found,) = register(np.array([one, moved]) + noise, optics)
    corners = np.array([(a, b) for a in (-75, 75) for b in (-87, 87)]).T
    missed = found.shift[:, None] - shift[:, None] + (found.matrix + np.eye(2) - matrix) @ corners
    assert np.sqrt(np.square(missed).mean()) < 0.1
    assert found.turn == pytest.approx(turn, abs=5e-4)
    assert found.magnification == pytest.approx(larger, abs=1e-3)
    assert found.error_px(shape) < 0.1


def test_paths_lead_on_with_intervals_that_hold():
    """Eight particles on curved paths among false sightings: forecast six times ahead."""
    random, times, step = np.random.default_rng(3), np.arange(30.0), np.array([1e-6, 1e-6, 1e-4])
    starts = np.array([[4e-4 * (k % 3), 5e-4 * (k // 3), 1e-3 * k] for k in range(8)])
    speeds = np.array([[1e-6, 6e-5 + 3e-6 * k, 1e-5] for k in range(8)])
    bend = np.array([0.0, 3e-7, 0.0])
    truth = starts + times[:, None, None] * speeds + times[:, None, None] ** 2 * bend
    found = [[Particle(c + step * random.normal(size=3), 4e-5, np.r_[step, 1e-6]) for c in truth[t]] for t in range(24)]
    for several in found:
        several.append(Particle(random.uniform(-1e-3, 3e-3, 3), 2e-5, np.r_[step, 1e-6]))
    paths = link_particles(found, times[:24])
    assert len(paths) == 8
    inside = []
    for path in paths:
        places, errors = path.at(times[24:])
        which = np.linalg.norm(truth[0] - path.centres[0], axis=1).argmin()
        missed = places - truth[24:, which]
        assert np.abs(missed[:, :2]).max() < PIXEL
        assert path.degrees[1] == 2
        inside += (np.abs(missed) < 2 * errors).ravel().tolist()
    assert np.mean(inside) > 0.9
    assert link_particles([[], []], times[:2]) == []


def test_bad_input_is_one_sentence():
    with pytest.raises(InputError, match="distances must be a positive number of metres, but it is -1"):
        InLine(WAVELENGTH, PIXEL, (-1.0,))
    with pytest.raises(InputError, match="frames must have the shape"):
        find_particles(np.ones((3, 20, 20)), OPTICS, OPTIONS)
    with pytest.raises(InputError, match="the smaller one first"):
        ParticleOptions(depth=(0.01, -0.01))
    with pytest.raises(InputError, match="least radius must lie between"):
        ParticleOptions(radius=(5e-5, 1e-5))


@pytest.mark.skipif(not DROPLETS.is_file(), reason="needs the measured droplets in shared/data/real")
def test_measured_droplets_are_at_one_place_for_both_cameras():
    """The plate registers the cameras to 0.1 pixels; a droplet then falls by 7 pixels a time at one depth."""
    data = np.load(DROPLETS)
    (registration,) = register(data["plate"], InLine(WAVELENGTH, PIXEL, (0.12965, 0.19445)))
    assert registration.error_px((512, 512)) < 0.1
    counts, part = data["frames"], (slice(70, 270), slice(100, 300))
    light = fixed_background(counts[::3])
    optics, options = InLine(WAVELENGTH, PIXEL, (0.19445, 0.12965)), ParticleOptions(bins=4, rounds=1)
    fell = []
    for time in (0, 2):
        frames = counts[time] / light
        frames[1] = registration.applied(frames[1])
        found = find_particles(frames[:, *part], optics, options)
        fell.append(min(found, key=lambda one: float(np.linalg.norm(one.centre[:2]))))
    way = fell[1].centre - fell[0].centre
    assert abs(way[0]) < PIXEL
    assert 12 * PIXEL < way[1] < 16 * PIXEL
    assert abs(way[2]) < 2e-3  # a fifth of its depth of focus
