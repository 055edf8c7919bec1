"""Line integrals along the rays of cones: closed forms, orders of convergence, float64 twins, and adjoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.poses import relative
from helpers.voxels import anyhow, around, randoms
from holosplat.baselines.algebraic import Algebraic, sirt
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.projectors.mesh import mesh_line_integrals, voxelise_meshes
from holosplat.projectors.surface import surface_thickness
from holosplat.projectors.voxels import LatticeProjector, RayProjector, projector_for, voxel_line_integrals
from holosplat.representations import VoxelGrid
from holosplat.specimens.red_cells import icosphere

UNEVEN = Grid((11, 7, 9), (1.1, 0.8, 0.9), (-4.0, -2.9, -3.7))
CENTRE, WIDTH = np.array([1.5, -1.0, 2.0]), 2.0
"""Of a Gaussian blob."""


def cones(views: Views, distance: float = 25.0) -> Views:
    """The same views from sources at about `distance`."""
    return replace(views, sources=distance * np.linspace(1, 1.3, len(views)))


AXIS = cones(replace(around(6, (12, 17))[2:], shifts=np.full((4, 2), 1 / 6)))
"""Its rows lie a sixth of a voxel from those of an even number of voxels, however many halves these are cut into."""

CASES = {
    "any": (UNEVEN, cones(anyhow(3, (17, 18)))),
    "narrow": (UNEVEN, cones(anyhow(4, (6, 5), seed=1))),  # partly beyond the detector
    "about one axis": (UNEVEN, cones(around(6, (10, 13), 0.3)[2:])),  # with no ray on a kink between voxels
    "of several sizes": (UNEVEN, replace(cones(anyhow(3, (13, 16))), scales=np.array([1, 1.25, 0.8]))),
    "parallel": (UNEVEN, anyhow(3, (9, 12), seed=2)),
}
cases = pytest.mark.parametrize(("grid", "views"), CASES.values(), ids=CASES)


def asking(views: Views, on: torch.device | str = "cpu") -> Poses:
    """Poses all of whose numbers ask for gradients."""
    poses = Poses.of(views, on)
    held = {name: getattr(poses, name) for name in ("rotations", "shifts", "scales", "sources")}
    return replace(poses, **{name: a.detach().requires_grad_() for name, a in held.items() if a is not None})


def asked(poses: Poses) -> list[Tensor]:
    """The gradients of the poses."""
    given = [getattr(poses, name) for name in ("rotations", "shifts", "scales", "sources")]
    return [a.grad for a in given if a is not None]


def distances(views: Views) -> np.ndarray:
    """The sources' distances, which are there."""
    assert views.sources is not None
    return views.sources


def blob(grid: Grid) -> Tensor:
    """A Gaussian of peak one on the grid, float64."""
    x, y, z = (torch.from_numpy(a - c) for a, c in zip(grid.axes(), CENTRE))
    return torch.exp(-(x**2 + y[:, None] ** 2 + z[:, None, None] ** 2) / (2 * WIDTH**2))


def blob_lines(views: Views) -> np.ndarray:
    """Its line integrals [V, H, W]: √(2π) times its width, times the Gaussian of the ray's distance from its centre."""
    h, w = views.shape
    out = np.empty((len(views), h, w))
    for v in range(len(views)):
        p, (sx, sy) = views.pixel_sizes[v], views.shifts[v]
        x, y = np.meshgrid((np.arange(w) + 0.5 - w / 2) * p + sx, (np.arange(h) + 0.5 - h / 2) * p + sy)
        pixels = np.stack([x, y, np.zeros_like(x)], -1)
        source = np.array([0.0, 0.0, -distances(views)[v]])
        along = (pixels - source) / np.linalg.norm(pixels - source, axis=-1, keepdims=True)
        to = views.rotations[v] @ CENTRE - source
        squared = (to**2).sum() - (along @ to) ** 2
        out[v] = np.sqrt(2 * np.pi) * WIDTH * np.exp(-squared / (2 * WIDTH**2))
    return out


@pytest.mark.parametrize("views", [cones(anyhow(3, (15, 20))), AXIS], ids=["any", "axis"])
def test_lines_of_a_gaussian_converge_to_the_closed_form_with_the_square_of_the_voxel(views):
    wanted, errors, others = blob_lines(views), [], []
    for n in (28, 56):
        grid = Grid.centred((n, n, n), 28 / n)
        found = RayProjector(grid, views, "reference").project(blob(grid))
        errors.append(np.abs(found.numpy() - wanted).max() / wanted.max())
        cast = voxel_line_integrals(blob(grid)[None], grid, views, step=0.5)[:, 0]
        others.append(np.abs(cast.numpy() - wanted).max() / wanted.max())
    assert errors[1] < 0.015
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    assert others[0] / others[1] == pytest.approx(4, rel=0.15)


def test_a_source_far_away_gives_parallel_rays():
    grid, parallel = Grid.centred((12, 10, 14), 1.0), anyhow(3, (11, 13))
    volume = randoms(*grid.shape)
    far = RayProjector(grid, replace(parallel, sources=np.full(3, 1e9)), "reference").project(volume)
    assert float((far - RayProjector(grid, parallel, "reference").project(volume)).abs().max()) < 1e-6


@cases
@pytest.mark.parametrize("metre", [1.0, 2.5e-7])
@pytest.mark.parametrize("threads", [1, 3])
def test_the_compiled_rays_and_their_gradients_are_those_of_the_float64_twin(grid, views, metre, threads):
    size, origin = (tuple(metre * a for a in ends) for ends in (grid.voxel_size, grid.origin))
    grid, sources = Grid(grid.shape, size, origin), None if views.sources is None else metre * views.sources
    views = replace(views, shifts=views.shifts * metre, pitch=metre, sources=sources)
    torch.set_num_threads(threads)
    assert_twins(grid, views, "cpu", torch.device("cpu"))
    torch.set_num_threads(1)


def test_the_gpus_rays_and_their_gradients_are_those_of_the_float64_twin(gpu):
    small = Grid((5, 4, 6), (1.1, 0.8, 0.9), (-2.3, -1.2, -1.7))
    assert_twins(small, replace(cones(anyhow(2, (5, 7))), scales=np.array([1, 0.8])), "cuda", gpu)


def assert_twins(grid: Grid, views: Views, backend: str, there: torch.device) -> None:
    """Lines, gradients and adjoint of a backend against the reference."""
    volume, image = randoms(*grid.shape), randoms(len(views), *views.shape, seed=1)
    twin, leaf = asking(views), volume.clone().requires_grad_()
    wanted = RayProjector(grid, twin, "reference").lines(leaf)
    (wanted * image).sum().backward()
    poses, values = asking(views, there), volume.float().to(there).requires_grad_()
    lines = RayProjector(grid, poses, backend).lines(values)
    (lines * image.float().to(there)).sum().backward()
    assert relative(lines.cpu(), wanted) < 1e-5
    assert values.grad is not None
    assert leaf.grad is not None
    assert relative(values.grad.cpu(), leaf.grad) < 1e-5
    for found, truth in zip(asked(poses), asked(twin), strict=True):
        assert found.dtype == torch.float64
        assert relative(found.cpu(), truth) < 1e-4
    known = RayProjector(grid, views, backend)
    assert torch.equal(known.project(volume.float().to(there)), lines.detach())
    back = known.backproject(image.float().to(there)).cpu()
    assert relative(back, leaf.grad) < 1e-5
    assert float((back.double() * volume).sum()) == pytest.approx(float((wanted.detach() * image).sum()), rel=1e-4)


def test_gradients_of_poses_are_those_of_differences():
    grid, views = CASES["of several sizes"]
    poses, volume = asking(views), blob(grid)
    image = randoms(len(views), *views.shape, seed=1)
    (RayProjector(grid, poses, "reference").lines(volume) * image).sum().backward()
    for name in ("shifts", "scales", "sources"):
        given, step = getattr(views, name), 1e-6
        turned = randoms(*given.shape, seed=4).numpy()
        moved = [replace(views, **{name: given + s * turned}) for s in (step, -step)]
        ends = [(RayProjector(grid, one, "reference").project(volume) * image).sum() for one in moved]
        wanted = float(ends[0] - ends[1]) / (2 * step)
        found = float((getattr(poses, name).grad.numpy() * turned).sum())
        assert found == pytest.approx(wanted, rel=1e-3), name


def test_what_knows_no_cones_refuses_them():
    grid, views = CASES["about one axis"]
    assert isinstance(projector_for(grid, views), RayProjector)
    assert not views.shares_axis
    for given in (views, Poses.of(views)):
        with pytest.raises(InputError, match="the lattice of voxels needs parallel beams, but these diverge"):
            LatticeProjector(grid, given)


def test_views_keep_their_sources():
    views = cones(anyhow(4, (5, 6)))
    assert distances(views[[2, 0]]).tolist() == distances(views)[[2, 0]].tolist()
    assert distances(views.in_units_of(0.5)).tolist() == (2 * distances(views)).tolist()
    assert distances(Poses.of(views)[torch.tensor([1])].views()).tolist() == [distances(views)[1]]
    assert views.fingerprint() != replace(views, sources=None).fingerprint()
    with pytest.raises(InputError, match="source distances must be above zero, but one is not"):
        replace(views, sources=np.array([1.0, -1, 1, 1]))
    with pytest.raises(InputError, match="source distance"):
        replace(views, sources=np.ones(3))


# --- meshes and surfaces ------------------------------------------------------------------------------------

NODES, FACES = icosphere(4)
BALL = (5.0 * NODES + CENTRE, FACES)
"""Of edges of a third of a pixel."""


def chords(views: Views) -> np.ndarray:
    """Lengths [V, H, W] of rays through the true ball, means of 8 × 8 rays a pixel."""
    h, w = views.shape
    out = np.empty((len(views), h, w))
    sub = (np.arange(8) + 0.5) / 8 - 0.5
    for v in range(len(views)):
        p, (sx, sy) = views.pixel_sizes[v], views.shifts[v]
        columns, rows = ((np.arange(n)[:, None] + 0.5 - n / 2 + sub).ravel() * p for n in (w, h))
        x, y = np.meshgrid(columns + sx, rows + sy)
        along = np.stack([x, y, np.full_like(x, distances(views)[v])], -1)
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        to = views.rotations[v] @ CENTRE + [0, 0, distances(views)[v]]
        squared = (to**2).sum() - (along @ to) ** 2
        out[v] = 2 * np.sqrt(np.clip(25.0 - squared, 0, None)).reshape(h, 8, w, 8).mean((1, 3))
    return out


@pytest.mark.parametrize("scales", [None, np.array([1.0, 1.25, 0.8])])
def test_meshes_and_surfaces_have_the_chords_of_a_ball(scales):
    views = replace(cones(anyhow(3, (21, 24))), scales=scales)
    vertices, faces = BALL
    wanted = chords(views)
    mesh = mesh_line_integrals(vertices, faces, np.ones((1, len(faces))), views, rays=4)[:, 0].numpy()
    assert np.sqrt(np.mean((mesh - wanted) ** 2)) < 0.005 * wanted.max()
    found = surface_of(views, torch.tensor(vertices), torch.tensor(faces), lines=4).numpy()
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.005 * wanted.max()
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.005)


def surface_of(views: Views | Poses, vertices: Tensor, faces: Tensor, lines: int = 2, backend: str = "cpu") -> Tensor:
    """The thickness of surfaces in views of pitch 1."""
    poses = Poses.of(views) if isinstance(views, Views) else views
    arrays = (vertices, faces, poses.rotations, poses.shifts, poses.shape, lines, backend)
    return surface_thickness(*arrays, pixels=poses.scales, sources=poses.sources)


def test_a_mesh_is_seen_exactly_and_a_surface_to_the_square_of_its_faces():
    """Of a box, faces are as deep as the box: cutting them in four leaves a quarter of the error, of a mesh nothing."""
    views, errors, exact = cones(anyhow(2, (31, 36), seed=3), 60.0), [], []
    for level in (0, 1, 2):
        vertices, faces = box_of_triangles(level)
        mesh = mesh_line_integrals(vertices, faces, np.ones((1, len(faces))), views, rays=8)[:, 0]
        found = surface_of(views, torch.tensor(vertices), torch.tensor(faces), lines=8)
        exact.append(mesh)
        errors.append(float((found - mesh).square().mean().sqrt()))
    assert float((exact[2] - exact[0]).abs().max()) < 1e-6
    assert errors[0] > 0.02
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.3 * errors[0]


def box_of_triangles(level: int) -> tuple[np.ndarray, np.ndarray]:
    """A box of 12 triangles, each cut in four `level` times."""
    corners = np.array([[x, y, z] for z in (-6.0, 5) for y in (-7.0, 6) for x in (-8.0, 7)])
    sides = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = np.array([corners[[a, b, c]] for q in sides for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    for _ in range(level):
        a, b, c = triangles.transpose(1, 0, 2)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        parts = [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        triangles = np.concatenate(parts)
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_gradients_of_surfaces_in_cones_are_those_of_differences(backend):
    views = replace(cones(anyhow(2, (21, 24))), scales=np.array([1.0, 1.2]))
    vertices, faces = (torch.tensor(a) for a in BALL)
    y, x = torch.meshgrid(torch.arange(21.0), torch.arange(24.0), indexing="ij")
    image = torch.stack([torch.cos(0.1 * x + 0.05 * y), torch.sin(0.08 * x - 0.1 * y)]).double()
    poses, leaf = asking(views), vertices.clone().requires_grad_()
    (surface_of(poses, leaf, faces, 48, backend) * image).sum().backward()
    assert leaf.grad is not None
    moved = 0.3 * torch.cos(vertices[:, [1, 2, 0]])

    def change(given: Views | Poses, by: Tensor) -> float:
        return float((surface_of(given, vertices + by, faces, 48, backend) * image).sum())

    step = 0.02
    wanted = (change(views, step * moved) - change(views, -step * moved)) / (2 * step)
    parts = leaf.grad * moved
    assert float(parts.sum()) == pytest.approx(wanted, abs=0.01 * float(parts.abs().sum()))
    for name in ("shifts", "scales", "sources"):
        given = getattr(views, name)
        turned = np.linspace(0.5, 1, given.size).reshape(given.shape) * (20 if name == "sources" else 1)
        ends = [change(replace(views, **{name: given + s * turned}), 0 * moved) for s in (step, -step)]
        parts = getattr(poses, name).grad.numpy() * turned
        assert parts.sum() == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=0.02 * np.abs(parts).sum()), name


# --- tomography ---------------------------------------------------------------------------------------------


def test_tomography_of_cones_is_as_good_as_that_of_parallel_beams():
    """Exact lines of a mesh, which share no arithmetic with what reconstructs them."""
    vertices, faces = icosphere(3)
    vertices = np.concatenate([4.0 * vertices + [4.5, 2, -3], 3.0 * vertices + [-5.0, -3, 4]])
    faces = np.concatenate([faces, faces + len(vertices) // 2])
    parallel = Views.from_angles(np.arange(24) * 15.0 + 2, (26, 32), 1.0)
    cone, grid = replace(parallel, sources=np.full(24, 30.0)), Grid.centred((24, 20, 24), 1.0)
    true = voxelise_meshes(vertices, faces, np.ones((1, len(faces))), grid)[0]

    def error(seen: Views, taken_for: Views) -> float:
        lines = mesh_line_integrals(vertices, faces, np.ones((1, len(faces))), seen)[:, 0]
        found = sirt(lines, taken_for, grid, 1.0, lambda share: None, options=Algebraic(sweeps=40)).numpy()
        return float(np.linalg.norm(found - true) / np.linalg.norm(true))

    assert error(cone, cone) < 1.03 * error(parallel, parallel)
    assert error(cone, parallel) > 1.2 * error(cone, cone)


def test_voxels_give_gradients_to_sources_alone():
    """Of poses whose other numbers are known."""
    poses = Poses.of(AXIS)
    assert poses.sources is not None
    poses = replace(poses, sources=poses.sources.clone().requires_grad_())
    grid = Grid.centred((12, 12, 17), AXIS.pitch)
    values = torch.rand(1, *grid.shape, generator=torch.Generator().manual_seed(3))
    VoxelGrid(values, grid, Matter.one(1e-7, 1e-10)).project(poses).channels.square().sum().backward()
    assert poses.sources is not None
    assert poses.sources.grad is not None
    assert bool(poses.sources.grad.any())
