"""Wave optics against closed forms: exit wave, free space, detector and the forward model.

Signs and units are those of docs/conventions.md. Rasters are rectangular, mostly odd. Distances are given by
`at(lambda_z)`, the distance [m] at which λz has that many squared pitches.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.special import fresnel
from torch import Tensor

from holosplat.beamline.simulate import SIMULATED_FRINGE_SAMPLES, simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model.instrument import Instrument, measure
from holosplat.optics import (
    bin_pixels,
    blur,
    exit_wave,
    exit_wave_minus_one,
    fresnel_propagate,
    fresnel_reach_px,
    fresnel_transfer,
    poisson,
)
from holosplat.optics.detector import gaussian_transfer
from holosplat.optics.sampling import GUARD_PX, padding, resolving_oversample
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavelength, wavenumber
from holosplat.volume import Object, Volume

ENERGY = 20.0  # keV
LAMBDA, K = wavelength(ENERGY), wavenumber(ENERGY)
PITCH = 0.4e-6  # m
SHAPE = (37, 54)
DOUBLE, COMPLEX = torch.float64, torch.complex128


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Arrays are small here: a second thread would only wait for the first."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def at(lambda_z: float, pitch: float = PITCH) -> float:
    """The distance [m] at which λz is `lambda_z` squared pitches."""
    return lambda_z * pitch**2 / LAMBDA


def transfer(shape: tuple[int, int], lambda_z: float) -> Tensor:
    """The transfer function [1, H, W] in float64 for λz in squared pitches."""
    return fresnel_transfer(shape, PITCH, np.array([at(lambda_z)]), ENERGY, COMPLEX)


def noise_wave(shape: tuple[int, int], seed: int = 0) -> Tensor:
    """A random complex wave [1, H, W]."""
    return torch.randn(1, *shape, dtype=COMPLEX, generator=torch.Generator().manual_seed(seed))


def pixels(views: Views, v: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of pixel centres [m] of view v: x [1, W] and y [H, 1] (docs/conventions.md)."""
    (h, w), p, (sx, sy) = views.shape, views.pixel_size, views.shifts[v]
    return ((np.arange(w) + 0.5 - w / 2) * p + sx)[None], ((np.arange(h) + 0.5 - h / 2) * p + sy)[:, None]


@dataclass(frozen=True)
class Bump:
    """An object of Gaussian thickness across the beam, at `centre + velocity · time`, from every side [m]."""

    beta: float
    delta: float
    thickness: float = 2e-6
    centre: tuple[float, float] = (0.0, 0.0)
    sigma: tuple[float, float] = (2 * PITCH, 3 * PITCH)
    velocity: tuple[float, float] = (0.0, 0.0)

    def at(self, time: float) -> Bump:
        moved = (self.centre[0] + self.velocity[0] * time, self.centre[1] + self.velocity[1] * time)
        return replace(self, centre=moved, velocity=(0.0, 0.0))

    def depth(self, views: Views) -> Tensor:
        """The thickness [V, H, W] in metres."""
        assert self.velocity == (0.0, 0.0), "a moving object is asked where it is first"
        images = []
        for v in range(len(views)):
            x, y = pixels(views, v)
            u = ((x - self.centre[0]) / self.sigma[0]) ** 2 + ((y - self.centre[1]) / self.sigma[1]) ** 2
            images.append(self.thickness * np.exp(-0.5 * u))
        return torch.from_numpy(np.stack(images))

    def project(self, views: Views) -> tuple[Tensor, Tensor]:
        return self.beta * self.depth(views), self.delta * self.depth(views)

    def voxelise(self, grid: Grid) -> Volume:
        raise NotImplementedError


def exposures(shape: tuple[int, int] = SHAPE, distance=0.02, psf: float = 0.0, count: int = 1) -> Exposures:
    """Exposures from one side, with one or more distances [m]."""
    views = Views.from_angles([0.0] * count, shape, PITCH)
    return replace(Exposures.of(views, ENERGY, 1.0, psf), distance=np.broadcast_to(distance, count))


def test_the_bump_is_an_object():
    assert isinstance(Bump(0.0, 1e-6), Object)


# --- exit wave ----------------------------------------------------------------------------------------------


def test_exit_wave_of_a_slab():
    """Phase -kδt and contact intensity exp(-2kβt), that is μ = 2kβ."""
    delta, beta, t = 1e-6, 3e-9, torch.linspace(0, 3e-5, 35, dtype=DOUBLE).reshape(5, 7)
    wave = exit_wave(beta * t, delta * t, ENERGY)
    assert torch.allclose(wave.abs() ** 2, torch.exp(-2 * K * beta * t), rtol=1e-13)
    assert float(torch.angle(wave * torch.exp(1j * K * delta * t)).abs().max()) < 1e-12
    assert K * delta * float(t.max()) > 2  # the phase went far beyond what is weak
    assert float(torch.angle(wave)[0, 1]) < 0  # matter with δ > 0 advances the phase: negative here


def test_exit_wave_minus_one_keeps_float32_digits_of_weak_objects():
    """Real and imaginary part each to a few float32 roundings, where forming U first would leave none."""
    phase = torch.logspace(-7, 0, 15, dtype=DOUBLE)
    B, D = phase**2 / K, phase / K
    truth = torch.expm1(-K * B - 1j * K * D)
    wave = exit_wave_minus_one(B.float(), D.float(), ENERGY)
    for part, true in ((wave.real, truth.real), (wave.imag, truth.imag)):
        assert float(((part - true) / true).abs().max()) < 1e-6


# --- free space ---------------------------------------------------------------------------------------------


def slit(x: np.ndarray, half: float, lambda_z: float) -> np.ndarray:
    """Wave at x behind a slit |x| < half: `(1 - i)/2 [C + iS]`, Goodman (2005), section 4.5; in one unit."""
    scale = math.sqrt(2 / lambda_z)
    (s1, c1), (s2, c2) = (fresnel(scale * (edge - x)) for edge in (-half, half))
    return (0.5 - 0.5j) * ((c2 - c1) + 1j * (s2 - s1))


def edge_error(samples: int, kind: str) -> float:
    """Worst error of the mean intensity per pixel behind a rectangle of matter, `samples²` to the pixel."""
    halves, lambda_z = (12.5, 19.5), 40.0  # pixels; the raster leaves room for the finest fringes
    shape = tuple(int(2 * half + lambda_z * samples) for half in halves)
    B, D = {"opaque": (60 / K, 0.0), "phase": (0.0, 0.7 / K), "both": (0.1 / K, -1.3 / K)}[kind]
    fine = tuple(n * samples for n in shape)
    y, x = ((np.arange(n) + 0.5 - n / 2) / samples for n in fine)
    inside = torch.from_numpy((np.abs(y) < halves[0])[:, None] & (np.abs(x) < halves[1])).to(DOUBLE)[None]
    h = fresnel_transfer(fine, PITCH / samples, np.array([at(lambda_z)]), ENERGY, COMPLEX)
    wave = 1 + fresnel_propagate(exit_wave_minus_one(B * inside, D * inside, ENERGY), h)
    rows, columns = slit(y, halves[0], lambda_z), slit(x, halves[1], lambda_z)
    exact = 1 + (np.exp(-K * (B + 1j * D)) - 1) * rows[:, None] * columns[None]
    got, true = (bin_pixels(torch.as_tensor(u).abs().reshape(1, *fine) ** 2, samples)[0] for u in (wave, exact))
    assert float((true - 1).abs().max()) > 0.3  # there are fringes to get right
    (top, left) = (n // 2 - m for n, m in zip(shape, (20, 27)))
    return float((got - true)[top : top + 41, left : left + 55].abs().max())


@pytest.mark.parametrize("kind", ["opaque", "phase", "both"])
def test_fresnel_fringes_of_edges(kind):
    """A rectangle of matter has edges along both axes; its wave is a product of Fresnel integrals."""
    coarse, fine = edge_error(2, kind), edge_error(4, kind)
    assert fine < 0.01
    assert math.log2(coarse / fine) > 1.8  # edges between samples: second order


@pytest.mark.parametrize("turned", [False, True])
def test_a_grating_images_itself(turned):
    """Talbot: any periodic wave returns after 2a²/λ, and after a²/λ shifted by half a period."""
    period = 6
    line = noise_wave((1, period))[0].repeat(7, 13)  # [7, 78]
    wave = line.T[None] if turned else line[None]
    back = fresnel_propagate(wave, transfer(wave.shape[1:], 2 * period**2))
    half = fresnel_propagate(wave, transfer(wave.shape[1:], period**2))
    assert torch.allclose(back, wave, atol=1e-11)
    assert torch.allclose(half, wave.roll(period // 2, 1 if turned else 2), atol=1e-11)
    assert not torch.allclose(half, wave, atol=0.1)


def test_free_space_conserves_energy_and_turns_back():
    wave = noise_wave(SHAPE)
    there = fresnel_propagate(wave, transfer(SHAPE, 30.0))
    assert float(there.abs().square().sum()) == pytest.approx(float(wave.abs().square().sum()), rel=1e-13)
    assert torch.allclose(transfer(SHAPE, -30.0), transfer(SHAPE, 30.0).conj(), atol=1e-14)
    assert torch.allclose(fresnel_propagate(there, transfer(SHAPE, -30.0)), wave, atol=1e-12)
    assert float((there - wave).abs().max()) > 1


def test_two_steps_are_one():
    wave = noise_wave(SHAPE)
    steps = fresnel_propagate(fresnel_propagate(wave, transfer(SHAPE, 9.5)), transfer(SHAPE, 20.5))
    assert torch.allclose(steps, fresnel_propagate(wave, transfer(SHAPE, 30.0)), atol=1e-12)


@pytest.mark.parametrize("axis", [1, 2])
def test_a_tilted_wave_walks_sideways(axis):
    """A phase ramp of frequency f moves the pattern by λzf and changes nothing else."""
    n, cycles, step = SHAPE[axis - 1], 3, 2
    lambda_z = step * n / cycles  # so that λ z f is `step` samples
    bump = Bump(0.0, 1.0, 1.0, (1.3 * PITCH, -2.1 * PITCH)).depth(exposures().views).to(COMPLEX)
    ramp = torch.exp(2j * torch.pi * cycles / n * torch.arange(n, dtype=DOUBLE))
    ramp = ramp[:, None] if axis == 1 else ramp[None]
    straight, tilted = (fresnel_propagate(u, transfer(SHAPE, lambda_z)).abs() for u in (bump, bump * ramp))
    assert torch.allclose(tilted, straight.roll(step, axis), atol=1e-7)


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (3, 0), (7, 11)])
@pytest.mark.parametrize("lambda_z", [2.0, 11.0, 29.0])
def test_contrast_of_weak_objects(rows, columns, lambda_z):
    """I - 1 = 2φ sin χ - 2kB cos χ with χ = πλz f² (Cloetens et al. 1999, eq. 3) and φ = -kD."""
    h, w = SHAPE
    pattern = np.cos(2 * np.pi * (rows * np.arange(h)[:, None] / h + columns * np.arange(w)[None] / w))
    chi = np.pi * lambda_z * ((rows / h) ** 2 + (columns / w) ** 2)
    B, D = (torch.from_numpy(a * pattern / K)[None] for a in (3e-7, 2e-7))
    wave = 1 + fresnel_propagate(exit_wave_minus_one(B, D, ENERGY), transfer(SHAPE, lambda_z))
    contrast = -2 * (2e-7 * np.sin(chi) + 3e-7 * np.cos(chi)) * pattern
    assert np.allclose((wave.abs() ** 2 - 1)[0].numpy(), contrast, atol=1e-12)


def test_frequencies_that_leave_the_raster_are_cut():
    """|λzf| > Np/2 is cut; a raster padded by the reach of the finest fringe loses nothing."""
    far = transfer(SHAPE, 100.0)[0].abs()
    fy, fx = np.fft.fftfreq(SHAPE[0])[:, None], np.fft.fftfreq(SHAPE[1])[None]
    kept = (np.abs(100 * fy) <= SHAPE[0] / 2) & (np.abs(100 * fx) <= SHAPE[1] / 2)
    assert np.array_equal(far.numpy() > 0.5, kept)
    assert not kept.all()
    reach = fresnel_reach_px(PITCH, at(100.0), ENERGY)
    assert reach == 50
    padded = transfer((SHAPE[0] + 2 * reach, SHAPE[1] + 2 * reach), 100.0)
    assert torch.allclose(padded.abs(), torch.ones_like(padded.real))


def test_the_phase_of_the_transfer_is_exact_in_float32():
    """Thousands of turns of phase are built in float64, whatever type is asked for."""
    shape, distance = (2187, 3), np.array([at(2000.0)])
    single = fresnel_transfer(shape, PITCH, distance, ENERGY, torch.complex64)
    double = fresnel_transfer(shape, PITCH, distance, ENERGY, COMPLEX)
    assert single.dtype == torch.complex64
    assert float((single - double).abs().max()) < 1e-7


# --- detector -----------------------------------------------------------------------------------------------


def test_a_pixel_is_the_mean_of_its_samples():
    fine = torch.rand(2, 15, 21, dtype=DOUBLE)
    want = fine.reshape(2, 5, 3, 7, 3).mean((2, 4))
    assert torch.allclose(bin_pixels(fine, 3), want, atol=1e-15)
    assert bin_pixels(fine, 1) is fine


def test_point_spread_function_adds_variances():
    """Gaussian * Gaussian is a Gaussian of the summed variances and the same mass; each view has its own."""
    views, sigmas = exposures(count=3).views, np.array([0.0, 1.5, 3.2])
    sharp = Bump(0.0, 1.0, 1.0, (0.7 * PITCH, -1.9 * PITCH)).depth(views)
    blurred = blur(sharp, gaussian_transfer(SHAPE, sigmas, DOUBLE))
    for image, sigma, before in zip(blurred, sigmas, sharp):
        wide = (PITCH * math.hypot(2, sigma), PITCH * math.hypot(3, sigma))
        peak = 6 * PITCH**2 / (wide[0] * wide[1])
        closed = Bump(0.0, 1.0, peak, (0.7 * PITCH, -1.9 * PITCH), wide).depth(views.padded(SHAPE))[0]
        periodic = closed.reshape(3, SHAPE[0], 3, SHAPE[1]).sum((0, 2))
        assert torch.allclose(image, periodic, atol=2e-5)
        assert float(image.sum()) == pytest.approx(float(before.sum()), rel=1e-13)


def test_photon_noise():
    """Counts are Poisson: mean I and variance I/photons (1e5 samples, bounds of five standard errors)."""
    level, photons, n = 1.7, 40.0, 100_035
    noisy = poisson(np.full((3, 5, n // 15), level), photons, seed=7)
    variance = level / photons
    assert noisy.dtype == np.float32
    assert noisy.mean() == pytest.approx(level, abs=5 * math.sqrt(variance / n))
    assert noisy.var() == pytest.approx(variance, rel=5 * math.sqrt((2 + 1 / (level * photons)) / n))
    assert np.allclose(noisy * photons, np.round(noisy * photons), atol=1e-4)  # whole photons
    assert np.array_equal(noisy, poisson(np.full((3, 5, n // 15), level), photons, seed=7))
    assert not np.array_equal(noisy, poisson(np.full((3, 5, n // 15), level), photons, seed=8))


# --- forward model ------------------------------------------------------------------------------------------

MATTER = Bump(beta=1e-7, delta=3e-6, centre=(2.3 * PITCH, -1.4 * PITCH))


def test_contact_image_of_a_bump():
    """At (nearly) no distance a frame is exp(-2kB), averaged over the pixel."""
    taken = exposures(distance=1e-9)
    frame = measure(MATTER, taken, 5, DOUBLE)
    B, _ = MATTER.project(taken.views.refined(5))
    assert torch.allclose(frame, bin_pixels(torch.exp(-2 * K * B), 5), atol=1e-6)


@pytest.mark.parametrize("psf", [0.0, 1.2])
def test_order_of_convergence_in_the_oversampling(psf):
    """The pixel's mean is taken by midpoints: the error falls with the square of the samples per pixel."""
    taken = exposures(distance=at(4.0), psf=psf)
    finest = measure(MATTER, taken, 15, DOUBLE)
    assert float((finest - 1).abs().max()) > 0.05
    errors = [float((measure(MATTER, taken, s, DOUBLE) - finest).abs().max()) for s in (1, 2, 4)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all((orders > 1.85) & (orders < 2.35)), orders


def test_point_spread_function_is_in_detector_pixels():
    """A weak absorber's contact image has the variance of object, point-spread function and pixel."""
    taken = exposures((41, 57), distance=1e-9, psf=2.5)
    for oversample in (1, 3):
        contrast = 1 - measure(replace(MATTER, delta=0.0, beta=1e-12), taken, oversample, DOUBLE)[0].numpy()
        x, y = (axis / PITCH for axis in pixels(taken.views))
        mass = contrast.sum()
        mean_x, mean_y = (contrast * x).sum() / mass, (contrast * y).sum() / mass
        pixel = (1 - 1 / oversample**2) / 12  # variance of the samples within a pixel
        assert (mean_x, mean_y) == pytest.approx((2.3, -1.4), abs=1e-3)
        assert (contrast * (x - mean_x) ** 2).sum() / mass == pytest.approx(4 + 2.5**2 + pixel, rel=1e-3)
        assert (contrast * (y - mean_y) ** 2).sum() / mass == pytest.approx(9 + 2.5**2 + pixel, rel=1e-3)


@pytest.mark.parametrize(("oversample", "psf"), [(1, 0.0), (2, 1.5)])
def test_a_wider_raster_changes_nothing(oversample, psf):
    """The padding holds all that travels: a field of view twice as large shows the same, at the edge too."""
    taken = exposures(distance=at(6.0), psf=psf)
    wider = replace(taken, views=taken.views.padded((19, 27)))
    obj = replace(MATTER, centre=(25 * PITCH, -16 * PITCH))  # its fringes cross the border
    small, large = (measure(obj, e, oversample, DOUBLE) for e in (taken, wider))
    assert float((small - 1)[:, 0].abs().max()) > 0.02
    assert torch.allclose(small, large[:, 19:-19, 27:-27], atol=2e-6)


def test_padded_lengths_are_fast_and_bounded():
    for distance in (1e-6, at(6.0), at(1e5)):
        taken = exposures(distance=distance)
        for n, m in zip(SHAPE, padding(taken, 1)):
            length = n + 2 * m
            for p in (2, 3, 5):
                while length % p == 0:
                    length //= p
            assert length == 1
            assert m >= min(GUARD_PX + math.ceil(distance * LAMBDA / (2 * PITCH**2)), n)
            assert n + 2 * m < 4 * n + 20


def test_frames_of_one_scan_are_those_taken_one_by_one():
    """Distances, point-spread functions, shifts and times of their own; any subset in any order."""
    taken = exposures(count=4)
    moved = replace(taken.views, shifts=PITCH * np.array([[0, 0], [2.5, 1], [-3, 0.2], [0, -4]]))
    taken = replace(
        taken,
        views=moved,
        distance=np.array([at(3.0), at(5.0), at(3.0), at(4.0)]),
        psf_sigma_px=np.array([0.0, 1.0, 2.0, 0.5]),
        time=np.array([0.0, 2.0, 1.0, 2.0]),
    )
    obj = replace(MATTER, velocity=(1.5 * PITCH, -0.5 * PITCH))
    alone = torch.cat([measure(obj, taken[[i]], 1, DOUBLE) for i in range(4)])
    assert torch.allclose(measure(obj, taken, 1, DOUBLE), alone, atol=2e-6)
    some = Instrument(taken, 1, DOUBLE).measure(obj, np.array([3, 0, 1]))
    assert torch.allclose(some, alone[[3, 0, 1]], atol=2e-6)


def test_a_moving_object_is_seen_where_it_is():
    """Moving by two pixels in x and minus one in y moves the frame by as much, like a shifted detector."""
    taken = replace(exposures(count=2, distance=at(3.0)), time=np.array([0.0, 2.0]))
    first, second = measure(replace(MATTER, velocity=(PITCH, -0.5 * PITCH)), taken, 1, DOUBLE)
    assert torch.allclose(second[:-1, 2:], first[1:, :-2], atol=1e-6)
    shifted = replace(taken, views=replace(taken.views, shifts=PITCH * np.array([[0, 0], [-2, 1.0]])))
    assert torch.allclose(measure(MATTER, shifted, 1, DOUBLE)[1], second, atol=1e-12)


def test_gradient_of_the_frames():
    """Against finite differences in float64: two distances, two point-spread functions, oversampled."""
    taken = replace(exposures((5, 7), np.array([at(1.0), at(2.0)]), count=2), psf_sigma_px=np.array([0.4, 0.0]))
    instrument = Instrument(taken, 1, DOUBLE)
    generator = torch.Generator().manual_seed(3)
    scale = 0.3 / K
    b, d = (torch.randn(2, *instrument.views.shape, dtype=DOUBLE, generator=generator) for _ in range(2))
    assert torch.autograd.gradcheck(
        lambda b, d: instrument.image(scale * b.abs(), scale * d), (b.requires_grad_(), d.requires_grad_())
    )


def test_float32_frames_agree_with_float64():
    taken = exposures(distance=at(20.0), psf=0.7)
    B, D = MATTER.project(Instrument(taken).views)
    single = Instrument(taken).image(B.float(), D.float())
    assert single.dtype == torch.float32
    assert float((single - Instrument(taken, dtype=DOUBLE).image(B, D)).abs().max()) < 2e-6


def test_oversample_from_the_fringe_width():
    """The first fringe is √(λz) wide; the shortest distance decides, up to a bound."""
    taken = exposures(distance=np.array([at(4.1), at(1 / 8.9)]), count=2)  # fringes of 2.02 and 0.335 pixels
    assert resolving_oversample(taken, 2.6, 1) == 8
    assert resolving_oversample(taken, 2.0, 1) == 6
    assert resolving_oversample(taken, 4.0, 1) == 8  # not 12
    assert resolving_oversample(taken, 5.0, 1) == 10  # not 15
    assert resolving_oversample(taken[[0]], 4.0, 1) == 2
    assert resolving_oversample(taken[[0]], 4.0, 5) == 5


def test_simulate():
    """Every fourth frame is held out, the scan says what made it, and the seed alone decides the noise."""
    taken, done = exposures((13, 17), distance=at(3.0), count=5), []
    clean = simulate(MATTER, taken, on_progress=done.append)
    fine = resolving_oversample(taken, SIMULATED_FRINGE_SAMPLES, at_least=4)
    assert done == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert clean.is_test.tolist() == [False, False, False, True, False]
    made_by = {"simulated_with_oversample": str(fine), "photons_per_pixel": "none", "seed": "0"}
    assert clean.provenance == made_by
    assert np.allclose(clean.frames, measure(MATTER, taken, fine, DOUBLE).numpy(), atol=1e-6)

    mask = np.array([True, False, True, False, False])
    noisy, again, other = (
        simulate(MATTER, taken, photons_per_pixel=900.0, seed=s, is_test=mask, oversample=2) for s in (1, 1, 2)
    )
    assert noisy.is_test.tolist() == mask.tolist()
    assert noisy.provenance == {"simulated_with_oversample": "2", "photons_per_pixel": "900.0", "seed": "1"}
    assert np.array_equal(noisy.frames, again.frames)
    assert not np.array_equal(noisy.frames, other.frames)
    assert not np.array_equal(noisy.frames[0], noisy.frames[1])  # frames of one scene, noise of their own
    residual = (noisy.frames - clean.frames) / np.sqrt(clean.frames / 900)
    assert residual.std() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("lambda_z", [2.0, 8.0])
def test_simulated_frames_of_a_ball_are_right_to_half_a_percent(lambda_z):
    """Of the contrast, in the root mean square, with the default oversample (`SIMULATED_FRINGE_SAMPLES`)."""
    taken = exposures((19, 25), distance=at(lambda_z))
    vertices, faces = icosphere(3)
    ball = MeshScene.of_one_material([TriangleMesh(6 * PITCH * vertices, faces)], DeltaBeta(1e-6, 1e-9))
    frame, truth = (simulate(ball, taken, oversample=s).frames for s in (None, 24))
    assert np.linalg.norm(frame - truth) < 0.006 * np.linalg.norm(truth - 1)


# --- bad input ----------------------------------------------------------------------------------------------


def test_bad_input_is_named():
    with pytest.raises(InputError, match="oversample must be at least 1"):
        Instrument(exposures(), 0)
    with pytest.raises(InputError, match="photons_per_pixel"):
        poisson(np.ones((1, 3, 5)), 0.0, 0)
    with pytest.raises(InputError, match="energy_kev"):
        exit_wave(torch.zeros(1), torch.zeros(1), -20.0)
