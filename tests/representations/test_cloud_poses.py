"""Gradients of poses through a cloud in metres, and on through the wave optics to the frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.kernels import few_programs
from holosplat.geometry import Poses, Views, rotation_y
from holosplat.matter import Matter
from holosplat.model import Instrument
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures

PIXEL, SHAPE = 1.5e-6, (9, 14)
DELTA, BETA = 7e-7, 2.5e-10
TOLERANCE = 1e-4


def a_cloud(backend: str, channels: int, unit: float = PIXEL) -> GaussianCloud:
    """Ellipsoids in the middle of the field; in float64 for the reference."""
    r = torch.Generator().manual_seed(0)
    dtype = torch.float64 if backend == "reference" else torch.float32
    centres = (6 * (torch.rand(9, 3, generator=r) - 0.5)) * (PIXEL / unit)
    scales = (0.7 + torch.rand(9, 3, generator=r)) * (PIXEL / unit)
    raw = raw_of(0.2 + torch.rand(9, channels, generator=r))
    parameters = [a.to(dtype) for a in (centres, scales.log(), torch.randn(9, 4, generator=r), raw)]
    matter = Matter.one(DELTA, BETA) if channels == 1 else Matter.free(DELTA, BETA)
    return GaussianCloud(parameters, unit, matter).on(backend)


def exposures() -> Exposures:
    """Two tomographic views and two about no common axis, each with its own shift and distance."""
    rotations = np.concatenate([rotation_y([0, 50]), Rotation.random(2, rng=1).as_matrix()])
    shifts = PIXEL * np.array([[0, 0], [0.7, -0.4], [-1.2, 0.3], [0.1, 0.9]])
    taken = Exposures.of(Views(rotations, shifts, SHAPE, PIXEL), 20.0, 0.05, 0.4)
    return replace(taken, distance=np.array([0.03, 0.05, 0.04, 0.06]))


class Gradients:
    """Of a fixed random sum over frames, or over line integrals: of the poses of views `index`, and of the others."""

    def __init__(self, backend: str, channels: int, index: list[int], frames: bool, unit: float = PIXEL) -> None:
        dtype = torch.float64 if backend == "reference" else torch.float32
        instrument = Instrument(exposures(), dtype=dtype, backend=backend)
        cloud, poses = a_cloud(backend, channels, unit), Poses.of(instrument.views, instrument.device)
        self.poses = replace(poses, rotations=poses.rotations.requires_grad_(), shifts=poses.shifts.requires_grad_())
        picked = torch.tensor(index, device=instrument.device)
        lines = cloud.project(self.poses[picked])
        image = instrument.frames(lines, picked) if frames else lines.channels
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        (image * weights.to(image)).sum().backward()
        self.of_rotations, self.of_shifts = (a.grad.cpu() for a in (self.poses.rotations, self.poses.shifts))

    def error(self, truth: Gradients) -> float:
        """Largest difference over largest true number, of the worse of rotations and shifts."""
        pairs = ((self.of_rotations, truth.of_rotations), (self.of_shifts, truth.of_shifts))
        return max(float((found - true).abs().max() / true.abs().max()) for found, true in pairs)


@pytest.mark.parametrize(
    ("backend", "channels", "unit", "frames"),
    [
        *[("cpu", 1, PIXEL, frames) for frames in (False, True)],
        *[("cpu", 2, 1e-6, frames) for frames in (False, True)],
        ("cuda", 1, 1e-6, False),  # slow in Triton's interpreter: each number of channels once
        ("cuda", 2, PIXEL, True),
    ],
)
def test_the_same_as_the_reference(backend, channels, unit, frames, request, monkeypatch):
    """Views picked by index, one of them twice; what is not picked has no gradient."""
    if backend == "cuda":
        few_programs(monkeypatch, request.getfixturevalue("gpu"), 16)
    found, true = (Gradients(name, channels, [2, 0, 3, 2], frames, unit) for name in (backend, "reference"))
    assert found.error(true) < TOLERANCE
    for gradient in (found.of_rotations, found.of_shifts):
        assert not gradient[1].any()
        assert all(bool(gradient[v].any()) for v in (0, 2, 3))


def test_the_frames_by_finite_differences_in_metres():
    """Central differences of the float64 frames, by every number of a rotation's first rows and of a shift."""
    true = Gradients("reference", 1, [0, 1, 2, 3], frames=True)
    instrument, cloud = Instrument(exposures(), dtype=torch.float64), a_cloud("reference", 1)
    weights = torch.randn(4, *SHAPE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def total(rotations: Tensor, shifts: Tensor) -> float:
        poses = replace(true.poses, rotations=rotations, shifts=shifts)
        with torch.no_grad():
            return float((instrument.frames(cloud.project(poses)) * weights).sum())

    def slope(name: str, place: tuple[int, ...], step: float) -> float:
        values = []
        for sign in (1, -1):
            arrays = {key: getattr(true.poses, key).detach().clone() for key in ("rotations", "shifts")}
            arrays[name][place] += sign * step
            values.append(total(**arrays))
        return (values[0] - values[1]) / (2 * step)

    numbers = [("rotations", (v, *divmod(k, 3)), 1e-5) for v in range(4) for k in range(6)]
    numbers += [("shifts", (v, k), 1e-5 * PIXEL) for v in range(4) for k in range(2)]
    for name, place, step in numbers:
        gradient = getattr(true.poses, name).grad
        assert slope(name, place, step) == pytest.approx(float(gradient[place]), abs=1e-4 * float(gradient.abs().max()))


def test_still_poses_get_no_gradient():
    cloud, views = a_cloud("cpu", 1), exposures().views
    leaves = [p.requires_grad_() for p in cloud.parameters().values()]
    poses = Poses.of(views)
    cloud.project(poses).channels.sum().backward()
    assert poses.rotations.grad is None
    assert all(leaf.grad is not None for leaf in leaves)
