"""Gaussian splat and voxeliser: C++ against the float64 reference, that against quadrature, symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.splats import DETECTOR, DRAWS, KINDS, NAMES, VOLUME, cloud, draw_views, error, poses, value_and_gradients
from holosplat import native
from holosplat.geometry import rotation_y
from holosplat.projectors.splat import splat, voxelise

FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-5
BACKENDS = ("cpu", "reference")
"""Those of the CPU; the GPU's are tested in test_triton_splat.py."""


def both_backends(kind: str, channels: int, draw) -> tuple[tuple, tuple]:
    """(value, gradients) of the cpu backend in float32 and of the reference in float64, on the same cloud."""
    arrays = cloud(kind, channels)
    fast = value_and_gradients(lambda *a: draw(*a, "cpu"), arrays, torch.float32)
    return fast, value_and_gradients(lambda *a: draw(*a, "reference"), arrays, torch.float64)


# --- the fast twin against the specification -------------------------------


@DRAWS
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_cpu_equals_reference(kind, channels, draw):
    (value, gradients), (truth, true_gradients) = both_backends(kind, channels, draw)
    assert error(value, truth) < FORWARD_TOLERANCE
    for name, gradient, true in zip(NAMES, gradients, true_gradients):
        assert error(gradient, true) < GRADIENT_TOLERANCE, name


@DRAWS
@pytest.mark.parametrize("isa", native.available_isas())
@pytest.mark.parametrize("kind", ["small", "thin", "ordinary"])
def test_every_build_equals_reference(isa, kind, draw, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    (value, gradients), (truth, true_gradients) = both_backends(kind, 2, draw)
    assert error(value, truth) < FORWARD_TOLERANCE
    assert all(error(g, t) < GRADIENT_TOLERANCE for g, t in zip(gradients, true_gradients))


@DRAWS
def test_the_gradient_check_would_catch_a_broken_kernel(draw):
    arrays = [a.double() for a in cloud("ordinary")]
    _, (centres, scales, quaternions, amplitudes) = value_and_gradients(
        lambda *a: draw(*a, "reference"), arrays, torch.float64
    )
    mass_term = (arrays[3] * amplitudes).sum(1, keepdim=True) / arrays[1]
    along = arrays[2] / arrays[2].square().sum(1, keepdim=True)
    assert error(scales - mass_term, scales) > 100 * GRADIENT_TOLERANCE  # mass taken as constant
    assert error(quaternions + 0.01 * along, quaternions) > GRADIENT_TOLERANCE  # normalisation forgotten
    assert error(amplitudes * 1.001, amplitudes) > GRADIENT_TOLERANCE  # a biased factor
    fainter = centres.clone()
    fainter[centres.abs().max(1).values.argmax()] *= 0.99  # a little of one Gaussian's box left out
    assert error(fainter, centres) > GRADIENT_TOLERANCE


@pytest.mark.parametrize(("cutoff", "variance"), [(3.0, 1 / 12), (6.0, 0.5), (4.0, 0.0)])
def test_cutoff_and_variance_mean_the_same_in_both_backends(cutoff, variance):
    arrays = cloud("ordinary", 2)
    for draw in (
        lambda *a, **k: splat(*a, *poses(2), DETECTOR, pixel_variance=variance, **k),
        lambda *a, **k: voxelise(*a, VOLUME, voxel_variance=variance, **k),
    ):
        truth = draw(*(a.double() for a in arrays), backend="reference", cutoff=cutoff)
        assert error(draw(*arrays, cutoff=cutoff), truth) < FORWARD_TOLERANCE


@pytest.mark.parametrize("shape", [(1, 1), (1, 57), (64, 3), (17, 240)])
def test_odd_detectors(shape):
    arrays, views = cloud("ordinary", 2), poses(2)
    truth = splat(*(a.double() for a in arrays), *views, shape, backend="reference")
    assert error(splat(*arrays, *views, shape), truth) < FORWARD_TOLERANCE


def test_arrays_need_not_be_contiguous():
    centres, scales, quaternions, amplitudes = cloud("ordinary", 2)
    views = (poses(2)[0].mT.contiguous().mT, poses(2)[1])
    image = splat(centres.T.contiguous().T, scales, quaternions, amplitudes[:, 1:], *views, DETECTOR)
    assert torch.equal(image, splat(centres, scales, quaternions, amplitudes[:, 1:].clone(), *poses(2), DETECTOR))


@DRAWS
@pytest.mark.parametrize("backend", BACKENDS)
def test_no_gaussians_draw_nothing(backend, draw):
    value, gradients = value_and_gradients(lambda *a: draw(*a, backend), cloud("small", 2, 0), torch.float32)
    assert value.shape[-2:] == (31, 40)
    assert not value.any()
    assert [tuple(g.shape) for g in gradients] == [(0, 3), (0, 3), (0, 4), (0, 2)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_views(backend):
    image = splat(*cloud("small"), torch.zeros(0, 3, 3), torch.zeros(0, 2), DETECTOR, backend=backend)
    assert image.shape == (0, 1, *DETECTOR)


@DRAWS
def test_gaussians_out_of_sight_have_no_gradient(draw):
    arrays = cloud("small")
    arrays[0] += 500.0
    value, gradients = value_and_gradients(lambda *a: draw(*a, "cpu"), arrays, torch.float32)
    assert not value.any()
    assert not any(g.any() for g in gradients)


# --- one result, whatever the threads --------------------------------------


@pytest.mark.parametrize("views", [1, 5])
def test_bitwise_the_same_for_every_number_of_threads(views):
    arrays = [torch.cat(pair) for pair in zip(cloud("ordinary", 2, 3000), cloud("thin", 2, 300))]

    def everything(threads: int) -> list[Tensor]:
        torch.set_num_threads(threads)
        image, gradients = value_and_gradients(lambda *a: splat(*a, *poses(views), (61, 50)), arrays, torch.float32)
        volume, more = value_and_gradients(lambda *a: voxelise(*a, VOLUME), arrays, torch.float32)
        return [image, *gradients, volume, *more]

    before = torch.get_num_threads()
    try:
        first = everything(1)
        for threads in (1, 2, 2, 3, 7):
            assert all(torch.equal(a, b) for a, b in zip(first, everything(threads))), threads
    finally:
        torch.set_num_threads(before)


# --- the specification against independent numerics ------------------------


def gaussian_at(points: np.ndarray, arrays: list[Tensor]) -> np.ndarray:
    """The cloud's value at points [..., 3] of the object frame, from the definition alone."""
    total = np.zeros(points.shape[:-1])
    for centre, scale, quaternion, amplitude in zip(*(a.double().numpy() for a in arrays)):
        turn = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()  # scipy's has the scalar last
        whitened = (points - centre) @ turn / scale
        total += amplitude[0] * np.exp(-0.5 * (whitened**2).sum(-1))
    return total


def few(smallest: float, seed: int = 3) -> list[Tensor]:
    """Four Gaussians with scales from `smallest` to three times that, near the centre."""
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, 4, seed)
    return [centres * 0.15, smallest * (1 + 2 * (scales - 0.3) / 3), quaternions, amplitudes]


def pixel_nodes(count: int, order: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes [count, order] in `count` pixels about zero, and weights [order] that sum to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return (np.arange(count) + 0.5 - count / 2)[:, None] + nodes / 2, weights / 2


@pytest.mark.parametrize(("smallest", "tolerance"), [(1.0, 3e-3), (2.0, 4e-4)])
def test_line_integrals_by_quadrature(smallest, tolerance):
    arrays, shape, (rotations, shifts) = few(smallest), (17, 22), poses(2, seed=5)
    x, wx = pixel_nodes(shape[1])
    y, wy = pixel_nodes(shape[0])
    z = np.arange(-30, 30, 0.25)
    expected = []
    for rotation, shift in zip(rotations.numpy(), shifts.numpy()):
        lab = np.stack(
            np.broadcast_arrays(x[None, :, None, :, None] + shift[0], y[:, None, :, None, None] + shift[1], z),
            -1,
        )  # [H, W, node, node, z, 3]
        values = gaussian_at(lab @ rotation, arrays).sum(-1) * 0.25
        expected.append(np.einsum("hwab,a,b->hw", values, wy, wx))
    image = splat(*(a.double() for a in arrays), rotations, shifts, shape, backend="reference", cutoff=6.0)
    assert error(image[:, 0], torch.from_numpy(np.stack(expected))) < tolerance


def test_voxel_means_by_quadrature():
    arrays, shape = few(1.0), (13, 14, 17)
    (z, wz), (y, wy), (x, wx) = (pixel_nodes(n) for n in shape)
    points = np.stack(
        np.broadcast_arrays(
            x[None, None, :, None, None, :], y[None, :, None, None, :, None], z[:, None, None, :, None, None]
        ),
        -1,
    )
    expected = np.einsum("zyxabc,a,b,c->zyx", gaussian_at(points, arrays), wz, wy, wx)
    volume = voxelise(*(a.double() for a in arrays), shape, backend="reference", cutoff=6.0)
    assert error(volume[0], torch.from_numpy(expected)) < 3e-3


@pytest.mark.parametrize("draw", ["splat", "voxelise"])
def test_reference_gradients_by_finite_differences(draw):
    arrays = [a.double().requires_grad_() for a in few(0.7)[:3]] + [cloud("small", 2, 4)[3].double().requires_grad_()]

    def function(*a: Tensor) -> Tensor:
        if draw == "splat":
            return splat(*a, *poses(2), (7, 8), backend="reference")
        return voxelise(*a, (3, 5, 6), backend="reference")

    assert torch.autograd.gradcheck(function, arrays, eps=1e-6, atol=1e-6, rtol=1e-4)


# --- physics and symmetries, on the fast twin ------------------------------


@pytest.mark.parametrize("smallest", [0.001, 0.3, 2.0])
def test_mass_is_conserved(smallest):
    """An image sums to the 3D mass; of Gaussians below half a pixel, only on average over positions."""
    count = 4000 if smallest < 0.5 else 20
    r = torch.Generator().manual_seed(0)
    scales = smallest * (1 + torch.rand(1, 3, generator=r)).expand(count, 3)
    centres = (torch.rand(count, 3, generator=r) - 0.5) * 20
    quaternions = torch.randn(1, 4, generator=r).expand(count, 4)
    arrays = [centres, scales, quaternions, torch.full((count, 1), 3.0)]
    mass = count * 3.0 * (2 * math.pi) ** 1.5 * float(scales[0].prod())
    image = splat(*arrays, *poses(2), (60, 70), cutoff=6.0)
    assert torch.allclose(image.sum((1, 2, 3)), torch.tensor(mass), rtol=5e-3)
    assert torch.allclose(voxelise(*arrays, (60, 60, 60), cutoff=6.0).sum(), torch.tensor(mass), rtol=1e-2)


@DRAWS
def test_linear_in_the_amplitudes(draw):
    *shape, a = cloud("ordinary", 2)
    b = torch.flip(a, (0,))
    together = draw(*shape, 2 * a - 3 * b, "cpu")
    assert error(2 * draw(*shape, a, "cpu") - 3 * draw(*shape, b, "cpu"), together.double()) < 1e-5
    swapped = draw(*shape, a.flip(1), "cpu")
    channel = 1 if draw is draw_views else 0
    assert error(swapped.flip(channel), draw(*shape, a, "cpu").double()) < 1e-6


def test_turning_the_object_is_turning_the_views():
    centres, scales, quaternions, amplitudes = (a.double() for a in cloud("ordinary"))
    rotations, shifts = poses(3)
    turn = Rotation.random(rng=9)
    own = Rotation.from_quat(np.roll(quaternions.numpy(), -1, 1))
    turned = torch.from_numpy(np.roll((turn * own).as_quat(), 1, 1))
    matrix = torch.from_numpy(turn.as_matrix())
    object_turned = splat((centres @ matrix.T).float(), scales.float(), turned.float(), amplitudes.float(),
                          rotations, shifts, DETECTOR)  # fmt: skip
    views_turned = splat(*(a.float() for a in (centres, scales, quaternions, amplitudes)),
                         rotations @ matrix, shifts, DETECTOR)  # fmt: skip
    # Rounding the turned cloud to float32 may move a pixel in or out of a box: e^-8 of one Gaussian's peak.
    assert float((object_turned - views_turned).abs().mean() / views_turned.abs().max()) < 1e-6
    assert error(object_turned, views_turned.double()) < 1e-3


def test_the_view_from_behind_is_the_mirror_image():
    arrays = cloud("ordinary", 2)
    front, back = splat(*arrays, rotation_y([33.0, 213.0]), np.zeros((2, 2)), DETECTOR)
    assert error(back.flip(-1), front.double()) < 1e-5


def test_a_detector_shift_of_whole_pixels_shifts_the_image():
    arrays, (rotations, _) = cloud("ordinary"), poses(1)
    still = splat(*arrays, rotations, torch.zeros(1, 2), (50, 60))
    moved = splat(*arrays, rotations, torch.tensor([[3.0, -2.0]]), (50, 60))
    assert error(moved[..., 2:, :-3], still[..., :-2, 3:].double()) < 1e-6


def test_a_gaussian_lies_where_the_conventions_say():
    """x_lab = R x; column from x, row from y; a volume is indexed [z, y, x]."""
    arrays = [
        torch.tensor([[5.0, -3.0, 2.0]]),
        torch.full((1, 3), 1.0),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.ones(1, 1),
    ]
    image = splat(*arrays, rotation_y([0.0, 90.0]), np.zeros((2, 2)), (21, 31))
    assert [divmod(int(i.argmax()), 31) for i in image] == [(10 - 3, 15 + 5), (10 - 3, 15 + 2)]
    assert int(voxelise(*arrays, (9, 11, 13)).argmax()) == ((4 + 2) * 11 + 5 - 3) * 13 + 6 + 5


def test_a_volume_summed_along_the_beam_is_the_image():
    arrays = cloud("ordinary", 2)
    arrays[1] += 0.3
    volume = voxelise(*arrays, (100, *DETECTOR), cutoff=5.0)
    image = splat(*arrays, torch.eye(3)[None], torch.zeros(1, 2), DETECTOR, cutoff=5.0)[0]
    assert error(volume.sum(1), image.double()) < 1e-3


def test_the_reference_works_in_single_precision():
    arrays = cloud("ordinary", 2)
    truth = draw_views(*(a.double() for a in arrays), "reference")
    assert error(draw_views(*arrays, "reference"), truth) < 1e-4
