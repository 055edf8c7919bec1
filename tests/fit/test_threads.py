"""What the number of threads changes, as docs/backends.md says: nothing in kernels and steps, last digits in starts."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.fit_balls import a_cloud, a_scan, fit_of, run
from helpers.splats import DETECTOR, VOLUME, cloud, poses
from holosplat.fit.terms import Objective
from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import Matter
from holosplat.optics.retrieval import tikhonov
from holosplat.projectors.splat import splat, voxelise
from holosplat.representations import SurfaceMesh
from holosplat.specimens.red_cells import icosphere

THREADS = (1, 2, 3)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """So many threads, for torch and for the kernels."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def digest(tensors: Mapping[str, Tensor]) -> str:
    """Equal for equal bits."""
    found = hashlib.sha256()
    for name in sorted(tensors):
        found.update(tensors[name].detach().numpy().tobytes())
    return found.hexdigest()


def with_gradients(make: Callable[..., Tensor], arrays: list[Tensor]) -> dict[str, Tensor]:
    """A value of `arrays`, and its gradients by them."""
    leaves = [a.clone().requires_grad_() for a in arrays]
    value = make(*leaves)
    value.square().sum().backward()
    gradients = {f"gradient {n}": leaf.grad for n, leaf in enumerate(leaves) if leaf.grad is not None}
    return {"value": value, **gradients}


def gaussians_seen() -> dict[str, Tensor]:
    """Line integrals of many Gaussians: more than a thread takes at once."""
    rotations, shifts = poses(3)
    return with_gradients(lambda *c: splat(*c, rotations, shifts, DETECTOR), cloud("ordinary", 2, 3000))


def gaussians_voxelised() -> dict[str, Tensor]:
    """The volume that they add up to."""
    return with_gradients(lambda *c: voxelise(*c, VOLUME), cloud("ordinary", 1, 3000))


def surfaces_seen() -> dict[str, Tensor]:
    """Line integrals of a surface."""
    points, faces = icosphere(5)
    views = Views.evenly_spaced(3, (31, 40), 1e-6)
    matter = Matter((HAEMOGLOBIN.delta_beta(20.0),))

    def seen(vertices: Tensor) -> Tensor:
        return SurfaceMesh(vertices, torch.from_numpy(faces.copy()), 1e-6, matter).project(views).channels

    return with_gradients(seen, [torch.from_numpy(11.0 * points)])


@pytest.mark.parametrize("kernel", [gaussians_seen, gaussians_voxelised, surfaces_seen])
def test_kernels_give_the_same_bits_for_any_number_of_threads(kernel):
    found = set()
    for count in THREADS:
        with threads(count):
            found.add(digest(kernel()))
    assert len(found) == 1


@pytest.mark.parametrize(
    "objective",
    [
        Objective(l1=0.75, ssim=0.2, tv_image=0.05, frc=0.05, anisotropy=0.1),
        Objective(l1=1.0, noise_width=1.0, coarse=1.0, tv_volume=0.25, overfull=10.0, two_levels=1.25),
    ],
)
def test_steps_give_the_same_bits_for_any_number_of_threads(objective):
    """From one start, of frames with fewer pixels than torch shares out between threads (32 768)."""
    scan, found = a_scan(), set()
    for count in THREADS:
        with threads(count):
            fit = fit_of(scan, cloud=a_cloud(), steps=4, objective=objective)
            run(fit)
            found.add(digest(fit.trainable.leaves))
    assert len(found) == 1


def test_a_retrieval_differs_in_the_last_digits_at_most():
    """Its Fourier transforms and sums are torch's; the same number of threads gives the same bits."""
    scan, found = a_scan(), []
    frames, material = torch.from_numpy(scan.frames), HAEMOGLOBIN.delta_beta(20.0)
    for count in (*THREADS, *THREADS):
        with threads(count):
            found.append(tikhonov(frames, scan.exposures, *material).numpy())
    scale = np.abs(found[0]).max()
    for first, again in zip(found[:3], found[3:]):
        np.testing.assert_array_equal(first, again)
        np.testing.assert_allclose(first, found[0], atol=1e-5 * scale)
