"""Gaussians in cones of rays: against integrals along the rays, every backend against the float64 reference."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from helpers.splats import cloud, error, poses
from holosplat import native
from holosplat.checks import InputError
from holosplat.geometry import Poses, Views
from holosplat.matter import Matter
from holosplat.projectors.splat import splat
from holosplat.projectors.splat.reference import rotation_matrices
from holosplat.representations.gaussians import GaussianCloud

SHAPE = (23, 34)
SOURCES = torch.tensor([80.0, 120.0, 200.0], dtype=torch.float64)
PIXELS = torch.tensor([1.0, 1.3, 0.8], dtype=torch.float64)


def drawn(arrays: list[Tensor], backend: str, device: torch.device | str = "cpu", views: bool = True) -> list[Tensor]:
    """The image, and gradients of a fixed random sum over it: of the cloud, and of four arrays of the views."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [a.to(device, dtype, copy=True).requires_grad_() for a in arrays]
    moved = [a.to(device, torch.float64, copy=True).requires_grad_(views) for a in (*poses(3), PIXELS, SOURCES)]
    image = splat(*leaves, *moved[:2], SHAPE, pixels=moved[2], sources=moved[3], backend=backend)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (image * weights.to(image)).sum().backward()
    grads = [a.grad for a in (*leaves, *(moved if views else []))]
    return [image.detach(), *(g for g in grads if g is not None)]


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("kind", ["ordinary", "thin", "outside"])
def test_images_and_gradients_are_those_of_the_reference(kind, channels, fast):
    arrays = cloud(kind, channels, 60)
    found, true = drawn(arrays, *fast), drawn(arrays, "reference")
    assert len(found) == len(true) == 9
    for one, other in zip(found, true):
        assert error(one.cpu(), other) < 2e-5
    of_cloud = drawn(arrays, *fast, views=False)
    assert [error(one.cpu(), other) < 2e-5 for one, other in zip(of_cloud, true)] == [True] * 5


@pytest.mark.parametrize("isa", native.available_isas())
def test_every_build_is_the_same_as_the_reference(isa, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    arrays = cloud("ordinary", 2, 60)
    assert max(error(*pair) for pair in zip(drawn(arrays, "cpu"), drawn(arrays, "reference"))) < 2e-5


def test_gradients_of_the_reference_are_those_of_differences():
    arrays = [a.double() for a in cloud("ordinary", 2, 8)]

    def image(centres: Tensor, rotations: Tensor, shifts: Tensor, pixels: Tensor, sources: Tensor) -> Tensor:
        return splat(
            centres, *arrays[1:], rotations, shifts, (7, 10), pixels=pixels, sources=sources, backend="reference",
            cutoff=6.0, trusted=True,
        )  # fmt: skip

    given = (arrays[0], *poses(2), PIXELS[:2], SOURCES[:2])
    leaves = [a.clone().requires_grad_() for a in given]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-6, rtol=1e-4)


def along_rays(arrays: list[Tensor], rotation: Tensor, shift: Tensor, source: float) -> Tensor:
    """Integrals [H, W] of Gaussians of one channel along the rays from the source to the middles of pixels."""
    centres, scales, quaternions, amplitudes = (a.double() for a in arrays)
    axes = rotation @ rotation_matrices(quaternions)
    inverse = axes @ torch.diag_embed(scales**-2) @ axes.mT
    y, x = (torch.arange(n, dtype=torch.float64) + 0.5 - n / 2 + s for n, s in zip(SHAPE, shift.flip(0)))
    start = torch.tensor([0.0, 0.0, -source], dtype=torch.float64)
    ends = torch.stack([x.expand(SHAPE), y[:, None].expand(SHAPE), torch.zeros(SHAPE, dtype=torch.float64)], -1)
    way = torch.nn.functional.normalize(ends - start, dim=-1)
    offset = start - centres @ rotation.T
    dd = torch.einsum("hwi,nij,hwj->hwn", way, inverse, way)
    dw = torch.einsum("hwi,nij,nj->hwn", way, inverse, offset)
    ww = torch.einsum("ni,nij,nj->n", offset, inverse, offset)
    lines = torch.sqrt(2 * math.pi / dd) * torch.exp(-0.5 * (ww - dw**2 / dd))
    return lines @ amplitudes[:, 0]


def test_lines_converge_to_integrals_along_rays_as_the_source_moves_away():
    """Of a cloud that keeps its place on the detector: the perspective about a centre is wrong by σ / R."""
    arrays = [a.double() for a in cloud("ordinary", 1, 40)]
    (rotation,), (shift,) = (a[:1] for a in poses(1))
    errors = []
    for source in (100.0, 200.0, 400.0, 800.0):
        sources = torch.tensor([source], dtype=torch.float64)
        image = splat(
            *arrays, rotation[None], shift[None], SHAPE, sources=sources, backend="reference", cutoff=8.0,
            pixel_variance=0.0,
        )  # fmt: skip
        errors.append(error(image[0, 0], along_rays(arrays, rotation, shift, source)))
    assert errors[0] < 0.05
    for coarse, fine in pairwise(errors):
        assert 1.7 < coarse / fine < 2.4, errors


def test_a_round_gaussian_on_the_axis_has_the_chords_of_the_cone():
    """Second order there, by symmetry: with lines taken along depth, or without `m²`, errors would stay."""
    arrays = [
        torch.tensor(a, dtype=torch.float64) for a in ([[0.0, 0.0, 30.0]], [[2.0] * 3], [[1.0, 0, 0, 0]], [[1.0]])
    ]
    rotation, shift = torch.eye(3, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    sources = torch.tensor([60.0], dtype=torch.float64)
    views = (rotation[None], shift[None], SHAPE)
    image = splat(*arrays, *views, sources=sources, backend="reference", cutoff=8.0, pixel_variance=0.0)
    assert error(image[0, 0], along_rays(arrays, rotation, shift, 60.0)) < 2e-3


def test_a_source_far_away_gives_the_image_of_parallel_beams(fast):
    backend, device = fast
    arrays = [a.to(device) for a in cloud("ordinary", 1, 30)]
    parallel = splat(*arrays, *poses(2), SHAPE, backend=backend)
    far = splat(
        *arrays, *poses(2), SHAPE, sources=torch.full((2,), 1e9, dtype=torch.float64).to(device), backend=backend
    )
    assert error(far.cpu(), parallel.cpu()) < 1e-5


@pytest.mark.parametrize("reference", [False, True])
def test_what_lies_behind_the_source_is_not_seen(fast, reference):
    backend, device = ("reference", torch.device("cpu")) if reference else fast
    arrays = [a.to(device, torch.float64 if reference else torch.float32) for a in cloud("ordinary", 1, 2)]
    arrays[0] = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, -90.0]]).to(arrays[0])
    leaves = [a.requires_grad_() for a in arrays]
    rotation, shift = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 2, dtype=torch.float64)
    image = splat(*leaves, rotation, shift, SHAPE, sources=SOURCES[:1].to(device), backend=backend)
    alone = splat(*(a[:1] for a in leaves), rotation, shift, SHAPE, sources=SOURCES[:1].to(device), backend=backend)
    assert torch.equal(image, alone)
    image.square().sum().backward()
    for leaf in leaves:
        assert leaf.grad is not None
        assert leaf.grad[0].any()
        assert not leaf.grad[1].any()


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        (SOURCES[:2], r"sources must be float64, one for each of the 3 views, but they are \(torch.float64, \(2,\)\)"),
        (SOURCES.float(), "sources must be float64, one for each of the 3 views"),
        (-SOURCES, "sources must be distances of sources above zero, but one is not; correct it"),
        (SOURCES * torch.nan, "sources must be distances of sources above zero"),
    ],
)
def test_distances_that_are_none_are_refused(sources, message):
    with pytest.raises(InputError, match=message):
        splat(*cloud("ordinary", 1, 3), *poses(3), SHAPE, sources=sources)


def test_a_cloud_sees_views_of_cones_in_its_own_unit():
    """Through the representation: sources in metres, pixels of several sizes, and a unit of two pixels."""
    unit = 0.5e-6
    rotations, shifts = poses(3)
    views = Views(rotations.numpy(), (unit * shifts).numpy(), SHAPE, unit, PIXELS.numpy(), (unit * SOURCES).numpy())
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, 20)
    raw = (centres, scales.log(), quaternions, amplitudes)
    held = GaussianCloud(raw, 2 * unit, Matter.one(1e-7, 1e-10))
    arrays = (2 * centres, 2 * scales, quaternions, torch.nn.functional.softplus(amplitudes))
    wanted = splat(*arrays, rotations, shifts, SHAPE, pixels=PIXELS, sources=SOURCES)
    for given in (views, Poses.of(views)):
        assert error(2 * held.thickness(given), wanted) < 1e-5
