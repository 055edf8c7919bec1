"""The forward model against closed forms: frames of a bump and of a ball."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.waves import DOUBLE, LAMBDA, PITCH, SHAPE, Bump, K, at, exposures, pixels
from holosplat.beamline.simulate import SIMULATED_FRINGE_SAMPLES, simulate
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model import Instrument, Model, measure
from holosplat.optics import (
    bin_pixels,
)
from holosplat.optics.sampling import GUARD_PX, fringe_sampling, padding, resolving_oversample
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene
from holosplat.volume import Object


def test_the_bump_is_an_object():
    assert isinstance(Bump(0.0, 1e-6), Object)


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
    some = Model(obj, Instrument(taken, 1, DOUBLE)).frames(torch.tensor([3, 0, 1]))
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
    assert (fringe_sampling(taken), fringe_sampling(taken[[0]]), fringe_sampling(taken, extra=1)) == (5, 1, 6)
    assert [fringe_sampling(taken, voxels=n) for n in (0.5, 1, 2, 2.5, 7)] == [2, 2, 2, 3, 5]
    assert fringe_sampling(taken, extra=1, voxels=1) == 3


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
