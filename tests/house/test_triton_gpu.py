"""What only a GPU can show: larger problems, and a whole step as a CUDA graph. Without one, all of it is skipped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers import two_balls
from helpers.splats import error
from holosplat.backends import Backend
from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.fit import adam, fidelity
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, Gaussians, Method, Task, solve
from holosplat.optics.hologram import hologram, optical_path
from holosplat.projectors.splat import splat, voxelise
from holosplat.representations import Stored
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

pytestmark = pytest.mark.gpu
FORWARD_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-5
MATTER = [(0.02, 1e-4), (0.01, 3e-4)]


def scattered(count: int, extent: float, smallest: float, largest: float, channels: int = 2) -> list[Tensor]:
    """A float32 cloud on the GPU, spread over `extent` px, with scales between the two given, evenly in the log."""
    r = torch.Generator().manual_seed(0)
    centres = (torch.rand(count, 3, generator=r) - 0.5) * extent
    scales = smallest * (largest / smallest) ** torch.rand(count, 3, generator=r)
    arrays = [centres, scales, torch.randn(count, 4, generator=r), torch.randn(count, channels, generator=r)]
    return [a.cuda() for a in arrays]


def views(count: int) -> tuple[Tensor, Tensor]:
    """Rotations and shifts of random views, float64, on the GPU."""
    shifts = np.random.default_rng(0).normal(size=(count, 2)) * 3
    return torch.from_numpy(Rotation.random(count, rng=0).as_matrix()).cuda(), torch.from_numpy(shifts).cuda()


def assert_twins(draw, arrays: list[Tensor]) -> None:
    """The drawing, and the gradients of a random sum over it, in float32 and by the reference in float64."""
    found = []
    for backend, dtype in (("cuda", torch.float32), ("reference", torch.float64)):
        leaves = [a.to(dtype).requires_grad_() for a in arrays]
        value = draw(*leaves, backend=backend)
        weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        found.append((value.detach(), torch.autograd.grad(value, leaves, weights.to(value))))
    (value, gradients), (truth, true_gradients) = found
    assert error(value, truth) < FORWARD_TOLERANCE
    for gradient, true in zip(gradients, true_gradients):
        assert error(gradient, true) < GRADIENT_TOLERANCE


@pytest.mark.parametrize("scales", [(0.3, 1.0), (1.0, 4.0), (0.001, 20.0), (20.0, 60.0)])
@pytest.mark.parametrize("channels", [1, 2])
def test_larger_images_are_those_of_the_reference(channels, scales):
    count = 300 if scales[1] > 10 else 5000
    arrays = scattered(count, 300, *scales, channels)
    assert_twins(lambda *a, backend: splat(*a, *views(3), (250, 311), backend=backend), arrays)


@pytest.mark.parametrize("scales", [(0.3, 1.0), (1.0, 3.0), (0.001, 5.0), (5.0, 15.0)])
@pytest.mark.parametrize("channels", [1, 2])
def test_larger_volumes_are_those_of_the_reference(channels, scales):
    count = 50 if scales[1] > 3 else 1000
    assert_twins(
        lambda *a, backend: voxelise(*a, (90, 101, 120), backend=backend), scattered(count, 110, *scales, channels)
    )


def test_a_cloud_large_enough_for_all_programs_at_once():
    """Against the sum of its quarters: many records, and few of a launch's edges in common."""
    arrays, poses = scattered(100_000, 500, 1.0, 4.0), views(4)
    whole = splat(*arrays, *poses, (512, 512), backend="cuda", trusted=True)
    parts = [splat(*(a[k::4] for a in arrays), *poses, (512, 512), backend="cuda", trusted=True) for k in range(4)]
    assert error(whole, torch.stack(parts).double().sum(0)) < FORWARD_TOLERANCE


class Step:
    """A fit's step in small: splat, wave optics, fidelity, a volume, Adam."""

    def __init__(self) -> None:
        self.leaves = [a.requires_grad_() for a in scattered(2000, 100, 1.0, 4.0)]
        self.leaves[3].data.mul_(0.01)
        self.poses, raster = views(3), (96, 108)
        frame = ((64, 72), (16, 18), 1)
        self.path = optical_path(raster, 1e-6, 20.0, np.array([0.01, 0.02, 0.03]), np.full(3, 0.5), frame).to("cuda")
        frames = 1 + 0.1 * torch.rand(3, 64, 72, generator=torch.Generator().manual_seed(3))
        self.target = fidelity.Target(frames.cuda(), 0.9, 0.3, "cuda")
        self.moments = [[torch.zeros_like(p) for p in self.leaves] for _ in range(2)]
        self.factors = adam.factors([1e-3, 1e-3, 1e-3, 1e-4], 10, 1e-12).cuda()

    def __call__(self) -> Tensor:
        lines = splat(*self.leaves, *self.poses, self.path.raster, backend="cuda", trusted=True)
        predicted = hologram(lines, MATTER, self.path, "cuda")
        l1, ssim = fidelity.l1_and_ssim(predicted, self.target)
        density = voxelise(*self.leaves, (40, 40, 40), backend="cuda", trusted=True)
        loss = (0.8 * l1 + 0.2 * ssim).mean() + 1e-3 * density.square().mean()
        gradients = torch.autograd.grad(loss, self.leaves)
        adam.step([p.data for p in self.leaves], list(gradients), *self.moments, self.factors, backend="cuda")
        return loss.detach()


def test_a_step_waits_for_nothing():
    step = Step()
    step()
    torch.cuda.set_sync_debug_mode("error")
    try:
        step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_a_step_is_captured_in_a_graph():
    """Ten replays give the losses of ten eager steps, up to the order of the image's additions."""
    eager, captured, stream = Step(), Step(), torch.cuda.Stream()
    losses = [float(eager()) for _ in range(13)]
    with torch.cuda.stream(stream):
        first = [float(captured()) for _ in range(3)]
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        value = captured()
    replayed = []
    for _ in range(10):
        graph.replay()
        replayed.append(float(value))
    assert first + replayed == pytest.approx(losses, rel=1e-4)
    assert replayed[-1] < first[0]


def two_balls_by(backend: Backend, method: Method) -> Stored:
    """What a method makes of small frames."""
    scan = replace(two_balls.scan(count=5), is_test=np.arange(5) == 4)
    prior = MaterialPrior.known(DeltaBeta(two_balls.DELTA, two_balls.BETA))
    return solve(method.on_backend(backend), Task(scan.train(), prior, 0), "levels")  # type: ignore[attr-defined]


@pytest.mark.parametrize("method", [Gaussians().with_effort(0.1), Auto().with_effort(0.1)], ids=["Gaussians", "auto"])
def test_a_whole_run_finds_what_the_cpu_finds(method):
    """By volumes, as Gaussians drift apart in a fit; and everything that a GPU has stays there to the end."""
    found, true = (two_balls_by(backend, method) for backend in ("cuda", "cpu"))
    assert all(value.is_cuda for value in found.parameters().values())
    grid = Grid.of_views(two_balls.scan(count=5).views)
    ours, theirs = (each.voxelise(grid).delta for each in (found, true))
    assert np.linalg.norm(ours - theirs) < 0.03 * np.linalg.norm(theirs)


def test_simulated_frames_are_those_of_the_cpu():
    scene = MeshScene.of_one_material(
        random_cells(3, (40e-6,) * 3, 0, 12e-6), DeltaBeta(two_balls.DELTA, two_balls.BETA)
    )
    exposures = Exposures.of(Views.evenly_spaced(2, (41, 48), 1e-6), 20.0, 0.05)
    found, true = (list(simulated_frames(scene, exposures, Simulation(backend=name))) for name in ("cuda", "cpu"))
    assert np.abs(np.array(found) - np.array(true)).max() < 1e-5
