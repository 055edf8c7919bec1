"""Views of several pixel sizes: line integrals, frames and gradients are those of each beam by itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.bumpy import DELTA, surfaces
from helpers.voxels import pronounced
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import DeltaBeta, Matter
from holosplat.mesh import TriangleMesh
from holosplat.model import Alignment, Instrument, Model, measure
from holosplat.model.alignment import rotation_matrices
from holosplat.representations import GaussianCloud, VoxelGrid
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, VoxelScene
from holosplat.volume import LineIntegrals, Object, Volume
from holosplat_bench.opponents.fields import Encoding, Network, NeuralField

PIXEL, SHAPE = 1e-6, (23, 29)
CENTRE, RADIUS = np.array([1.0, -0.7, 0.5]) * PIXEL, 6 * PIXEL
BALL = TriangleMesh(RADIUS * icosphere(4)[0] + CENTRE, icosphere(4)[1])
SIZES = PIXEL * np.array([1.0, 1.5, 1.25])
MATTER = Matter.one(7e-7, 2.5e-10)


def beams(sizes: np.ndarray = SIZES) -> Views:
    """Views without a common axis, on shifted detectors."""
    rotations = Rotation.random(3, rng=1).as_matrix()
    shifts = PIXEL * np.array([[0.3, -0.4], [1.7, 0.6], [-1.2, 0.3]])
    return Views.of_pixels(rotations, shifts, SHAPE, sizes)


def alone(views: Views, v: int) -> Views:
    """View `v` as views of one pixel size, which knows nothing of the others."""
    return Views(views.rotations[[v]], views.shifts[[v]], views.shape, float(views.pixel_sizes[v]))


def chords(views: Views) -> np.ndarray:
    """Means [V, H, W] [m] over pixels of the ball's chords, from 5² points."""
    (h, w), found = views.shape, []
    for v, pixel in enumerate(views.pixel_sizes / 5):
        at = views.rotations[v] @ CENTRE
        x = (np.arange(5 * w) + 0.5 - 2.5 * w) * pixel + views.shifts[v, 0] - at[0]
        y = (np.arange(5 * h) + 0.5 - 2.5 * h) * pixel + views.shifts[v, 1] - at[1]
        found.append(2 * np.sqrt(np.clip(RADIUS**2 - y[:, None] ** 2 - x**2, 0, None)))
    return np.stack(found).reshape(len(views), h, 5, w, 5).mean((2, 4))


def a_cloud(backend: str = "cpu") -> GaussianCloud:
    r = torch.Generator().manual_seed(0)
    centres, scales = 9 * (torch.rand(9, 3, generator=r) - 0.5), 0.9 + torch.rand(9, 3, generator=r)
    parameters = [centres, scales.log(), torch.randn(9, 4, generator=r), raw_of(0.2 + torch.rand(9, 1, generator=r))]
    dtype = torch.float64 if backend == "reference" else torch.float32
    return GaussianCloud([p.to(dtype) for p in parameters], PIXEL, MATTER).on(backend)


def ball(grid: Grid) -> VoxelGrid:
    """The ball on voxels."""
    inside = MeshScene.of_one_material([BALL], DeltaBeta(1.0, 0.0)).voxelise(grid).delta
    return VoxelGrid(torch.from_numpy(inside)[None].float(), grid, MATTER)


def soft(grid: Grid) -> VoxelGrid:
    """A Gaussian on voxels, whose projections have no kinks to speak of."""
    x, y, z = (torch.from_numpy(axis / PIXEL).float() for axis in grid.axes())
    square = (z[:, None, None] - 1) ** 2 + (y[:, None] + 0.5) ** 2 + (x - 0.7) ** 2
    return VoxelGrid(torch.exp(-square / 18)[None], grid, MATTER)


def a_field() -> NeuralField:
    grid = Grid.centred((15, 15, 15), PIXEL)
    encoding = Encoding(levels=2, features=2, coarsest=8.0, finest=3.0, log2_size=10)
    everywhere = torch.ones(grid.shape, dtype=torch.bool)
    return pronounced(NeuralField(grid, MATTER, Network(encoding, 8, 1), everywhere, seed=1))


def objects() -> dict[str, Object]:
    grid, own = Grid.centred((16, 15, 17), PIXEL), TriangleMesh(BALL.vertices / PIXEL, BALL.faces)
    volume = ball(grid).values[0].numpy() * MATTER.delta
    return {
        "voxels": ball(grid),
        "surfaces": surfaces(own),
        "meshes": MeshScene.of_one_material([BALL], DeltaBeta(*MATTER.channels[0])),
        "volume": VoxelScene(Volume(volume, volume / 2800, grid)),
        "gaussians": a_cloud(),
        "gaussians, reference": a_cloud("reference"),
        "field": a_field(),
    }


def delta_lines(found: Object, views: Views) -> Tensor:
    _, lines = LineIntegrals.of_any(found.project(views))
    return lines.detach().double()


@pytest.mark.parametrize("name", objects())
def test_line_integrals_are_those_of_each_beam_by_itself(name):
    found, views = objects()[name], beams()
    lines = delta_lines(found, views)
    assert float(lines.max()) > 0
    for v in range(len(views)):
        own = delta_lines(found, alone(views, v))[0]
        near = 0.05 if name == "field" else 1e-5  # rays of a field are denser where another beam's pixels are larger
        assert float((lines[v] - own).norm()) < near * float(own.norm())


@pytest.mark.parametrize(("name", "near"), [("surfaces", 0.01), ("meshes", 0.02), ("volume", 0.05), ("voxels", 0.07)])
def test_line_integrals_of_a_ball_are_its_chords(name, near):
    found, views = objects()[name], beams()
    delta = MATTER.delta if name in ("voxels", "volume", "meshes") else DELTA
    wanted = torch.from_numpy(chords(views)) * delta
    missing = (delta_lines(found, views) - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)
    assert float(missing.max()) < near


def test_line_integrals_of_a_gaussian_are_its_closed_form():
    centre, sigma, views = np.array([2.0, -1.0, 1.5]), 1.7, beams()
    parameters = [
        torch.from_numpy(centre)[None],
        torch.full((1, 3), np.log(sigma)).double(),
        torch.tensor([[1.0, 0, 0, 0]]).double(),
    ]
    cloud = GaussianCloud([*parameters, raw_of(torch.ones(1, 1).double())], PIXEL, MATTER).on("reference")
    lines = delta_lines(cloud, views)
    for v, pixel in enumerate(views.pixel_sizes / PIXEL):
        at, shift = views.rotations[v] @ centre, views.shifts[v] / PIXEL
        shares = []
        for count, c, s in zip(SHAPE[::-1], at, shift):
            edges = ((np.arange(count + 1) - 0.5 * count) * pixel + s - c) / (np.sqrt(2) * sigma)
            shares.append(0.5 * np.diff([math.erf(e) for e in edges]) / pixel)
        wanted = (2 * np.pi) ** 1.5 * sigma**3 * np.outer(shares[1], shares[0]) * PIXEL * MATTER.delta
        assert float((lines[v] - torch.from_numpy(wanted)).abs().max()) < 0.01 * wanted.max()


def test_pixels_of_a_crop_stay_where_they_are():
    found, views = a_cloud("reference"), beams()
    rows, columns = slice(2, 17), slice(5, 28)
    whole, part = delta_lines(found, views), delta_lines(found, views.cropped(rows, columns))
    torch.testing.assert_close(part, whole[:, rows, columns], rtol=1e-9, atol=1e-9 * float(whole.max()))


def exposed(views: Views) -> Exposures:
    taken = Exposures.of(views, 20.0, 0.05, 0.4)
    return replace(
        taken, distance=np.array([0.03, 0.06, 0.05]), energy_kev=np.array([20.0, 17.0, 20.0]), reference_kev=20
    )


def test_frames_are_those_of_each_beam_by_itself():
    exposures, found = exposed(beams()), a_cloud("reference")
    frames = measure(found, exposures, 2, torch.float64)
    assert float(frames.std()) > 0.01
    for v in range(len(exposures)):
        own = measure(found, replace(exposures[[v]], views=alone(exposures.views, v)), 2, torch.float64)
        assert float((frames[v] - own[0]).abs().max()) < 1e-3 * float((own - 1).abs().max())


@pytest.mark.parametrize("name", ["gaussians, reference", "voxels", "surfaces"])
def test_magnification_has_the_gradient_of_differences(name):
    """Of line integrals, with the turns and shifts that go with it; and those of the object are right, too."""
    found, views = objects()[name], beams()
    if name == "voxels":
        found = soft(found.grid)
    x, y = torch.arange(SHAPE[1]).double(), torch.arange(SHAPE[0]).double()[:, None]
    weights = torch.cos(0.35 * x + 0.2 * y + torch.tensor([0.0, 1.0, 2.0]).double()[:, None, None])[:, None]
    key, first = next(iter(found.parameters().items()))
    poses = Poses.of(views)
    asked = [torch.zeros(3, 3).double(), poses.shifts, poses.scales, first.clone()]
    for tensor in asked:
        tensor.requires_grad_()

    def value(turns: Tensor, shifts: Tensor, scales: Tensor, own: Tensor) -> Tensor:
        moved = replace(poses, rotations=rotation_matrices(turns) @ poses.rotations, shifts=shifts, scales=scales)
        return (found.with_parameters({key: own}).project(moved).channels * weights).sum()

    gradients = torch.autograd.grad(value(*asked), asked)
    for k, (tensor, gradient) in enumerate(zip(asked, gradients)):
        size, steepest = (PIXEL if k == 1 else 1.0) * 0.03, gradient / gradient.norm()
        ends = [[t.detach() + (s * steepest if t is tensor else 0) for t in asked] for s in (size, -size)]
        slope = float(value(*ends[0]) - value(*ends[1])) / (2 * size)
        assert slope == pytest.approx(float(gradient.norm()), rel=0.03)


def test_pixel_sizes_that_make_no_sense_are_refused():
    views = beams()
    for sizes, said in (
        (PIXEL * np.array([1.0, -1.0, 1.0]), "pixel size must be a positive"),
        (PIXEL * np.ones(2), "pixel size must have the shape"),
    ):
        with pytest.raises(InputError, match=said):
            Views.of_pixels(views.rotations, views.shifts, SHAPE, sizes)
    with pytest.raises(InputError, match="pixel scales must be above zero"):
        replace(views, scales=np.array([1.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="pixel size must lie between"):
        Exposures.of(replace(views, scales=np.array([1.0, 1.0, 1e6])), 20.0, 0.1)
    same = Views.of_pixels(views.rotations, views.shifts, SHAPE, np.full(3, 1.5 * PIXEL))
    assert same.fingerprint() == Views(views.rotations, views.shifts, SHAPE, 1.5 * PIXEL).fingerprint()
    assert views[[1]].pixel_size == pytest.approx(1.5 * PIXEL)
    assert (views.finest, views.width) == pytest.approx((PIXEL, 29 * PIXEL))


def test_alignment_magnifies():
    """Frames, distances on the raster and exposures agree with views of these pixels."""
    exposures, found = exposed(beams(np.full(3, PIXEL))), a_cloud("reference")
    magnified = torch.tensor([0.05, -0.03, 0.02]).double()
    aligned = Alignment(magnified=magnified, stretches=torch.full((3,), 0.1).double())
    true = aligned.exposures(exposures)
    assert true.views.pixel_sizes == pytest.approx(PIXEL / (1 + magnified.numpy()))
    frames = Model(found, Instrument(exposures, 2, torch.float64), aligned).frames()
    wanted = measure(found, true, 2, torch.float64)
    assert float((frames - wanted).abs().max()) < 1e-3 * float((wanted - 1).abs().max())
