"""Gradients of poses of the surface projector: against its twin, the gradient of vertices, and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.poses import asking, gradients, relative
from holosplat.geometry import Poses, Views
from holosplat.matter import Matter
from holosplat.projectors.surface import cpu, surface_thickness
from holosplat.representations import SurfaceMesh
from holosplat.specimens.red_cells import icosphere


def ball(subdivisions: int, radius: float, centre=(0.0, 0.0, 0.0)) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a ball with bumps, so that no turn leaves its image as it is."""
    sphere, faces = icosphere(subdivisions)
    bumps = 1 + 0.15 * np.sin(2 * sphere[:, 0] + 1) * np.cos(2.5 * sphere[:, 1]) + 0.08 * sphere[:, 2] ** 3
    return torch.from_numpy(radius * bumps[:, None] * sphere + np.array(centre)), torch.tensor(faces)


def anyhow(count: int, shape: tuple[int, int], pixel: float = 1.0, seed: int = 0) -> Views:
    """Views from all directions on detectors shifted by a pixel or two."""
    shifts = np.random.default_rng(seed).uniform(-2, 2, (count, 2)) * pixel
    return Views(Rotation.random(count, rng=seed).as_matrix(), shifts, shape, pixel)


def noise(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def of_a_ball(views: Views, image: Tensor, backend: str = "cpu") -> tuple[Tensor, Tensor]:
    """Of rotations and shifts, of Σ image · thickness of a ball that is partly outside."""
    poses = asking(views)
    vertices, faces = ball(2, 12.0, (20.0, -9.0, 40.0))
    found = surface_thickness(vertices, faces, poses.rotations, poses.shifts, views.shape, backend=backend)
    (found * image).sum().backward()
    return gradients(poses)


@pytest.mark.parametrize("shape", [(33, 46), (47, 30), (1, 45), (40, 1)])
def test_the_compiled_gradient_is_the_plain_one(shape):
    views = anyhow(4, shape)
    image = noise(4, *shape)
    for found, wanted in zip(*(of_a_ball(views, image, backend) for backend in ("cpu", "reference"))):
        assert float(wanted.abs().max()) > 1
        assert relative(found, wanted) < 1e-11


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_pose_and_the_vertices_have_one_gradient(backend):
    """`M` in `R M` is `M` in `M v`, all nine numbers of it; a shift moves the vertices against itself."""
    vertices, faces = ball(2, 9.0, (3.0, -2.0, 5.0))
    image = noise(1, 35, 42)
    for seed in range(3):
        views = anyhow(1, (35, 42), seed=seed)
        poses = asking(views)
        moved = vertices.clone().requires_grad_()
        found = surface_thickness(moved, faces, poses.rotations, poses.shifts, views.shape, backend=backend)
        (found * image).sum().backward()
        assert moved.grad is not None
        rotation, (by_rotation, by_shift) = poses.rotations.detach()[0], gradients(poses)
        assert relative(rotation.T @ by_rotation[0], moved.grad.T @ vertices) < 1e-10
        assert relative(by_shift[0], -(rotation @ moved.grad.sum(0))[:2]) < 1e-10


def weights(views: Views) -> Tensor:
    """A smooth image of derivatives, the same function of the detector's own coordinates on every raster."""
    (h, w), p = views.shape, views.pixel_size
    x = ((torch.arange(w, dtype=torch.float64) + 0.5 - w / 2) * p)[None, None]
    y = ((torch.arange(h, dtype=torch.float64) + 0.5 - h / 2) * p)[None, :, None]
    return 1 + 0.7 * torch.sin(0.21 * x + 0.4) * torch.cos(0.17 * y + 0.2)


def turned(views: Views, axis: int, radians: float) -> Views:
    """The views with the sample turned by a small angle about an axis of its own."""
    turn = Rotation.from_rotvec(radians * np.eye(3)[axis]).as_matrix()
    return Views(views.rotations @ turn, views.shifts, views.shape, views.pixel_size)


def shifted(views: Views, axis: int, by: float) -> Views:
    return Views(views.rotations, views.shifts + by * np.eye(2)[axis], views.shape, views.pixel_size)


MOVES = [(turned, 0, 0.01), (turned, 1, 0.01), (turned, 2, 0.01), (shifted, 0, 0.1), (shifted, 1, 0.1)]


@pytest.mark.parametrize(("move", "axis", "step"), MOVES)
def test_the_gradient_predicts_the_image_to_second_order_in_the_pixel(move, axis, step):
    """Of a weighted sum of each view's image, when the sample turns or the detector is shifted."""
    mesh, gaps = SurfaceMesh(*ball(4, 9.0, (2.0, -3.0, 4.0)), 1.0, Matter.one(1.0, 1.0), lines=32), []
    for factor in (1, 2, 4):
        views = anyhow(4, (41, 46)).refined(factor)
        ahead, back = (move(views, axis, sign * step) for sign in (1, -1))
        poses = asking(views)
        summed(mesh, poses).sum().backward()
        wanted = (summed(mesh, ahead) - summed(mesh, back)) / (2 * step)
        ends = ((ahead.rotations, back.rotations), (ahead.shifts, back.shifts))
        parts = [g * torch.from_numpy(a - b) / (2 * step) for g, (a, b) in zip(gradients(poses), ends)]
        gaps.append(relative(parts[0].sum((1, 2)) + parts[1].sum(1), wanted))
    assert gaps[0] < 5e-3
    assert gaps[1] < gaps[0] / 2
    assert gaps[2] < gaps[1] / 3


def summed(mesh: SurfaceMesh, at: Views | Poses) -> Tensor:
    """∫ weights · thickness [V] over each view's image."""
    views = at.views() if isinstance(at, Poses) else at
    return (mesh.project(at).channels[:, 0] * weights(views)).sum((1, 2)) * views.pixel_size**2


def test_any_number_of_threads_gives_the_same_bits():
    views, image = anyhow(5, (33, 46)), noise(5, 33, 46)
    found = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        found.append(of_a_ball(views, image))
    torch.set_num_threads(1)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other))


def test_nothing_is_computed_that_is_not_asked_for(monkeypatch):
    vertices, faces = ball(1, 9.0)
    views = anyhow(2, (33, 46))
    poses, known = asking(views), Poses.of(views)
    plain = surface_thickness(vertices, faces, known.rotations, known.shifts, views.shape)
    asked = surface_thickness(vertices, faces, poses.rotations, poses.shifts, views.shape)
    assert torch.equal(plain, asked)
    assert asked.requires_grad
    assert not plain.requires_grad

    def refuse(*_: Tensor) -> None:
        raise AssertionError("gradients of poses were computed")

    monkeypatch.setattr(cpu, "pose_gradients", refuse)
    leaf = vertices.clone().requires_grad_()
    surface_thickness(leaf, faces, known.rotations, known.shifts, views.shape).sum().backward()
    assert leaf.grad is not None
    with pytest.raises(AssertionError, match="were computed"):
        asked.sum().backward()


def test_gradients_of_a_scan_in_metres_scale():
    """The same thing in pixels and in metres: rotations alike, shifts per metre."""
    vertices, faces = ball(2, 9.0)
    found = []
    for pixel in (1.0, 2.5e-7):
        poses = asking(anyhow(2, (33, 46), pixel))
        lines = SurfaceMesh(vertices, faces, pixel, Matter.one(1.0, 0.5)).project(poses)
        (lines[1] * noise(2, 33, 46)).sum().backward()
        by_rotation, by_shift = gradients(poses)
        found.append((by_rotation / pixel, by_shift))
    for pixels, metres in zip(*found):
        assert relative(metres, pixels) < 1e-9
