"""Line integrals along the rays of cones: closed forms, orders of convergence, float64 twins, and adjoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.poses import relative
from helpers.voxels import anyhow, around, randoms
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.projectors.voxels import LatticeProjector, RayProjector, projector_for, voxel_line_integrals

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
        source = np.array([0.0, 0.0, -views.sources[v]])
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
    for name in ("any", "about one axis"):
        grid, views = CASES[name]
        assert_twins(grid, views[:2], "cuda", gpu)


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
        ends = [
            (RayProjector(grid, replace(views, **{name: given + s * turned}), "reference").project(volume) * image).sum()
            for s in (step, -step)
        ]
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
    assert views.sources is not None
    assert views[[2, 0]].sources.tolist() == views.sources[[2, 0]].tolist()
    assert views.in_units_of(0.5).sources.tolist() == (2 * views.sources).tolist()
    assert Poses.of(views)[torch.tensor([1])].views().sources.tolist() == [views.sources[1]]
    assert views.fingerprint() != replace(views, sources=None).fingerprint()
    with pytest.raises(InputError, match="source distances must be above zero, but one is not"):
        replace(views, sources=np.array([1.0, -1, 1, 1]))
    with pytest.raises(InputError, match="source distance"):
        replace(views, sources=np.ones(3))
