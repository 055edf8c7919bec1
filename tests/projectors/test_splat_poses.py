"""Gradients of each view's rotation and shift: every backend against the float64 reference, that by differences."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from helpers.kernels import few_programs
from helpers.splats import cloud, error, poses
from helpers.watch import Watch
from holosplat import native
from holosplat.checks import InputError
from holosplat.projectors.splat import splat

SHAPE = (23, 34)
TOLERANCE = 2e-5
"""Of a gradient, over its largest number."""
KINDS = ("ordinary", "tiny", "elongated", "thin", "large", "outside")
NEEDED = [(True, True), (True, False), (False, True)]
"""Which of rotations and shifts require gradients."""


def of_kind(kind: str, channels: int = 1, count: int = 120) -> list[Tensor]:
    """Float32 clouds; beside those of `cloud`, far below a pixel, and needles 40 times as long as thick."""
    if kind not in ("tiny", "elongated"):
        return cloud(kind, channels, count)
    arrays = cloud("ordinary", channels, count)
    shares = torch.rand(count, 3, generator=torch.Generator().manual_seed(7))
    arrays[1] = 0.02 + 0.2 * shares if kind == "tiny" else torch.tensor([0.2, 0.3, 8.0]) * (0.5 + shares)
    return arrays


class Drawn:
    """Gradients of a fixed random sum over a cloud's image: of its four arrays, of rotations and of shifts."""

    def __init__(self, arrays, views, backend, device="cpu", shape=SHAPE, needed=(True, True), **options):
        dtype = torch.float64 if backend == "reference" else torch.float32
        leaves = [a.detach().to(device, dtype, copy=True).requires_grad_() for a in arrays]
        moved = [a.detach().to(device, torch.float64, copy=True).requires_grad_(n) for a, n in zip(views, needed)]
        image = splat(*leaves, *moved, shape, backend=backend, **options)
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        (image * weights.to(image)).sum().backward()
        self.arrays, self.views = ([a.detach().double().cpu() for a in group] for group in (leaves, moved))
        self.of_cloud = [leaf.grad.cpu() for leaf in leaves]
        self.of_rotations, self.of_shifts = (None if a.grad is None else a.grad.cpu() for a in moved)

    def error(self, truth: Drawn) -> float:
        """The worst of rotations and shifts."""
        return max(error(self.of_rotations, truth.of_rotations), error(self.of_shifts, truth.of_shifts))


# --- against the specification ------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_as_the_reference(kind, channels, fast):
    arrays = of_kind(kind, channels, 12 if kind == "large" else 120)
    found, true = Drawn(arrays, poses(3), *fast), Drawn(arrays, poses(3), "reference")
    assert found.of_rotations.dtype == found.of_shifts.dtype == torch.float64
    assert found.error(true) < TOLERANCE
    assert not found.of_rotations[:, 2].any()


@pytest.mark.parametrize("isa", native.available_isas())
@pytest.mark.parametrize("kind", ["ordinary", "thin"])
def test_every_build_is_the_same_as_the_reference(isa, kind, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    arrays = of_kind(kind, 2)
    assert Drawn(arrays, poses(3), "cpu").error(Drawn(arrays, poses(3), "reference")) < TOLERANCE


@pytest.mark.parametrize("shape", [(1, 57), (64, 3), (17, 40)])
def test_odd_detectors(shape, fast):
    arrays = of_kind("ordinary", 2, 60)
    found, true = Drawn(arrays, poses(2), *fast, shape=shape), Drawn(arrays, poses(2), "reference", shape=shape)
    assert found.error(true) < TOLERANCE


@pytest.mark.parametrize(("cutoff", "variance"), [(2.5, 1 / 12), (6.0, 0.5), (4.0, 0.0)])
def test_cutoff_and_variance_mean_the_same(cutoff, variance, fast):
    arrays, options = of_kind("ordinary", 2, 60), {"cutoff": cutoff, "pixel_variance": variance}
    found, true = Drawn(arrays, poses(2), *fast, **options), Drawn(arrays, poses(2), "reference", **options)
    assert found.error(true) < TOLERANCE


@pytest.mark.parametrize("channels", [1, 2])
def test_the_reference_by_finite_differences(channels):
    """Of the nine numbers of a rotation one by one: they are free."""
    arrays = [a.double() for a in of_kind("ordinary", channels, 12)]

    def image(rotations: Tensor, shifts: Tensor) -> Tensor:
        return splat(*arrays, rotations, shifts, (7, 10), backend="reference", cutoff=6.0, trusted=True)

    views = [a.clone().requires_grad_() for a in poses(2)]
    assert torch.autograd.gradcheck(image, views, eps=1e-6, atol=1e-6, rtol=1e-4)


# --- the tolerance would see a mistake ----------------------------------------------------------------------

MISTAKES = {
    "shift of the wrong sign": lambda d: (d.of_rotations, -d.of_shifts),
    "columns and rows exchanged": lambda d: (d.of_rotations, d.of_shifts.flip(1)),
    "rotation transposed": lambda d: (d.of_rotations.mT, d.of_shifts),
    "rotation of the wrong sign": lambda d: (-d.of_rotations, d.of_shifts),
    "rows of the rotation exchanged": lambda d: (d.of_rotations[:, [1, 0, 2]], d.of_shifts),
    "covariance taken as constant": lambda d: (of_means(d), d.of_shifts),
    "a view's gradient given to another": lambda d: (d.of_rotations.roll(1, 0), d.of_shifts),
    "a biased factor": lambda d: (d.of_rotations * 1.0001, d.of_shifts),
}


def of_means(drawn: Drawn) -> Tensor:
    """The rotations' gradients less the part by way of covariances, from the same drawing of points' means."""
    parts = []
    for v in range(len(drawn.views[0])):
        one = Drawn(drawn.arrays, [a[v : v + 1] for a in drawn.views], "reference")
        part = torch.zeros(3, 3, dtype=torch.float64)
        part[:2] = drawn.views[0][v, :2] @ one.of_cloud[0].T @ drawn.arrays[0]
        parts.append(part)
    return torch.stack(parts)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_tolerance_sees_a_mistake(mistake):
    true = Drawn(of_kind("ordinary", 2, 60), poses(3), "reference")
    wrong_rotations, wrong_shifts = MISTAKES[mistake](true)
    assert max(error(wrong_rotations, true.of_rotations), error(wrong_shifts, true.of_shifts)) > 3 * TOLERANCE


# --- what holds of any projector ----------------------------------------------------------------------------


def test_moving_the_detectors_is_moving_the_object(fast):
    """A step t of the object moves a mean by A t, A the first two rows of R; a step of the detector takes it back."""
    drawn = Drawn(of_kind("ordinary", 2), poses(3), *fast)
    moved = -torch.einsum("vij,vi->j", drawn.views[0][:, :2], drawn.of_shifts)
    assert error(drawn.of_cloud[0].double().sum(0), moved) < TOLERANCE


def test_turning_the_views_is_turning_the_object(fast):
    """A small turn ω of the object moves centres by ω × c and quaternions by ½ (0, ω) q; the views turn by R [ω]×."""
    drawn = Drawn(of_kind("ordinary", 2), poses(3), *fast)
    centres, _, quaternions, _ = drawn.arrays
    of_centres, _, of_quaternions, _ = (g.double() for g in drawn.of_cloud)
    w, vector = quaternions[:, :1], quaternions[:, 1:]
    for axis in torch.eye(3, dtype=torch.float64):
        turned = torch.cat([-(vector @ axis)[:, None], w * axis + axis.expand_as(vector).cross(vector, dim=1)], 1) / 2
        of_object = (of_centres * axis.expand_as(centres).cross(centres, dim=1)).sum() + (of_quaternions * turned).sum()
        cross = torch.stack([axis.cross(e, dim=0) for e in torch.eye(3).to(axis)], 1)
        of_views = (drawn.of_rotations * (drawn.views[0] @ cross)).sum()
        assert float(of_object - of_views) == pytest.approx(0, abs=1e-4 * float(drawn.of_rotations.abs().max()))


# --- only what is asked for ---------------------------------------------------------------------------------


@pytest.mark.parametrize("needed", NEEDED)
def test_the_clouds_gradients_are_bitwise_the_same(needed, fast):
    """With gradients of the views, or some of them, as without."""
    count = 400 if fast[0] == "cpu" else 140  # more than a program takes, here and in the interpreter
    arrays, views = of_kind("ordinary", 2, count), poses(3)
    plain, found = (Drawn(arrays, views, *fast, needed=n) for n in ((False, False), needed))
    assert all(torch.equal(a, b) for a, b in zip(plain.of_cloud, found.of_cloud))
    assert plain.of_rotations is None
    assert plain.of_shifts is None
    assert [found.of_rotations is not None, found.of_shifts is not None] == list(needed)
    both = Drawn(arrays, views, *fast)
    for one, other in ((found.of_rotations, both.of_rotations), (found.of_shifts, both.of_shifts)):
        assert one is None or torch.equal(one, other)


def test_the_kernels_are_asked_for_no_gradients_of_views_in_vain(monkeypatch):
    handed, usual = [], native.call

    def noted(function, *arguments):
        if function == "holosplat_splat_backward":
            handed.append(arguments[-1])
        return usual(function, *arguments)

    monkeypatch.setattr(native, "call", noted)
    Drawn(of_kind("ordinary"), poses(2), "cpu", needed=(False, False))
    Drawn(of_kind("ordinary"), poses(2), "cpu", needed=(False, True))
    assert handed[0] is None
    assert handed[1].rotations
    assert handed[1].shifts


def test_views_alone_may_require_gradients(fast):
    backend, device = fast
    arrays, (rotations, shifts) = of_kind("ordinary", 2, 60), poses(2)
    shifts = shifts.to(device).requires_grad_()
    splat(*(a.to(device) for a in arrays), rotations, shifts, SHAPE, backend=backend).sum().backward()
    exact = poses(2)[1].requires_grad_()
    splat(*(a.double() for a in arrays), rotations, exact, SHAPE, backend="reference").sum().backward()
    assert error(shifts.grad, exact.grad.to(device)) < 1e-3  # a sum over all pixels nearly keeps its value


def test_views_in_single_precision_get_gradients_in_theirs(fast):
    backend, device = fast
    arrays = [a.to(device) for a in of_kind("ordinary", 1, 60)]
    rotations, shifts = (a.float().to(device).requires_grad_() for a in poses(2))
    splat(*arrays, rotations.mT.contiguous().mT, shifts, SHAPE, backend=backend).square().sum().backward()
    assert rotations.grad.dtype == shifts.grad.dtype == torch.float32
    assert bool(rotations.grad.any())


def test_views_that_require_gradients_are_checked_too():
    rotations = (2 * torch.eye(3)[None]).requires_grad_()
    with pytest.raises(InputError, match="rotations must hold proper"):
        splat(*of_kind("ordinary"), rotations, torch.zeros(1, 2), SHAPE)


# --- many threads, none at all, and no numbers --------------------------------------------------------------


@pytest.mark.parametrize("count", [30, 5000])
def test_bitwise_the_same_for_every_number_of_threads(count):
    arrays, views = of_kind("ordinary", 2, count), poses(3)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 2, 3, 7):
            torch.set_num_threads(threads)
            found.append(Drawn(arrays, views, "cpu"))
    finally:
        torch.set_num_threads(before)
    for one, other in pairwise(found):
        assert torch.equal(one.of_rotations, other.of_rotations)
        assert torch.equal(one.of_shifts, other.of_shifts)


def test_bitwise_the_same_in_every_run(fast):
    first, second = (Drawn(of_kind("ordinary", 2), poses(3), *fast) for _ in range(2))
    assert torch.equal(first.of_rotations, second.of_rotations)
    assert torch.equal(first.of_shifts, second.of_shifts)


def test_nothing_to_draw_moves_nothing(fast):
    found = Drawn(of_kind("ordinary", 2, 0), poses(2), *fast)
    assert found.of_rotations.shape == (2, 3, 3)
    assert found.of_shifts.shape == (2, 2)
    assert not found.of_rotations.any()
    assert not found.of_shifts.any()
    none = Drawn(of_kind("ordinary"), (torch.zeros(0, 3, 3), torch.zeros(0, 2)), *fast)
    assert none.of_rotations.shape == (0, 3, 3)


@pytest.mark.filterwarnings("ignore:invalid value encountered")  # numpy's, in the interpreter
@pytest.mark.parametrize("array", range(4))
def test_what_is_no_number_spoils_no_view(array, fast):
    arrays = of_kind("ordinary", 2, 40)
    spoiled = [a.clone() for a in arrays]
    spoiled[array][3, 0], spoiled[array][5, 1], spoiled[array][-1] = math.nan, math.inf, math.nan
    for a in arrays:
        a[[3, 5, -1]] = 500.0  # out of sight
    arrays[1][[3, 5, -1]] = 1.0
    found = Drawn(spoiled, poses(3), *fast, trusted=True)
    assert found.error(Drawn(arrays, poses(3), "reference")) < TOLERANCE


def test_a_gradient_that_is_no_number_is_not_hidden(fast):
    backend, device = fast
    arrays, (rotations, shifts) = [a.to(device) for a in of_kind("ordinary")], (a.to(device) for a in poses(2))
    shifts.requires_grad_()
    image = splat(*arrays, rotations, shifts, SHAPE, backend=backend)
    given = torch.zeros_like(image)
    given[0, 0, 10, 10] = math.nan
    image.backward(given)
    assert bool(shifts.grad[0].isnan().all())
    assert not shifts.grad[1].any()


def test_nothing_waits_for_the_device(gpu, monkeypatch):
    few_programs(monkeypatch, gpu, 16)
    leaves = [a.to(gpu).requires_grad_() for a in of_kind("ordinary", 2, 10)]
    views = [a.to(gpu).requires_grad_() for a in poses(3)]
    with Watch():
        splat(*leaves, *views, SHAPE, backend="cuda", trusted=True).sum().backward()
    assert bool(views[0].grad.any())
