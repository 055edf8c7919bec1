"""Whole runs with all tensors where a GPU's would be: none is left behind, and the results are the CPU's.

The GPU is pretended (`helpers.pretended_gpu`), and the kernels' plain twins run: kernels have tests of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from helpers import two_balls
from helpers.pretended_gpu import OnGpu, pretended_gpu
from holosplat.align.poses import PoseOptions
from holosplat.baselines import HolographicTV
from holosplat.fit.problem import Schedule
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import Auto, FitOptions, Gaussians, Method, solve
from holosplat.methods.coarse import CoarseToFine, on_pixels
from holosplat.methods.method import Task
from holosplat.methods.volume import SmoothVolume
from holosplat.optics.background import LightOptions
from holosplat.representations import SurfaceMesh
from holosplat.scan import Scan
from holosplat.specimens.phantoms import unit_ball
from holosplat.workflows.evaluate import evaluate
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

triton = pytest.importorskip("triton")

KNOWN = MaterialPrior.known(DeltaBeta(two_balls.DELTA, two_balls.BETA))
START = HolographicTV(retrieval=5, iterations=10, corrections=1, inner=2, settling=0, refine=1)
GAUSSIANS = Gaussians(
    volume=START,
    approximate_steps=3,
    fit=FitOptions(schedule=Schedule(steps=3)),
    coarse=CoarseToFine().with_effort(0.05),
)
AUTO = replace(Auto(gaussians=GAUSSIANS).with_effort(0.05), gaussians=GAUSSIANS)
ALONE = replace(AUTO, gaussians=replace(GAUSSIANS, coarse=replace(GAUSSIANS.coarse, join_missing=False)))
"""That missing bodies are looked for on a GPU, a run in a folder holds."""
SMOOTH = SmoothVolume(volume=replace(START, upper=0.0), coarser=(), rounds=1, iterations=2)
EVEN = LightOptions("even", still="none", noise="white")
"""Told where light is not what a test is about: that it is decided on a GPU, a run in a folder holds."""


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """All of the test sees a GPU."""
    with pretended_gpu(monkeypatch, kernels=False):
        yield


def frames(photons: float | None = None) -> Scan:
    """Five frames of two balls, the last of which is held out."""
    scan = two_balls.scan(photons, count=5)
    return replace(scan, is_test=np.arange(5) == 4)


def found(method: Method, scan: Scan) -> dict[str, np.ndarray]:
    """The parameters of what a method makes of the training frames, in main memory."""
    result = solve(method, Task(scan.train(), KNOWN, 0, light=EVEN))
    return {name: value.detach().cpu().numpy() for name, value in result.parameters().items()}


@pytest.mark.parametrize("method", [GAUSSIANS, ALONE], ids=["Gaussians", "surfaces"])
def test_a_method_finds_what_it_finds_on_the_cpu(method, monkeypatch):
    true = found(method.on_backend("cpu"), frames())
    with pretended_gpu(monkeypatch, kernels=False):
        same = found(method.on_backend("cuda"), frames())
    for name, values in true.items():
        if name != "quaternions":  # a round Gaussian has any
            assert np.linalg.norm(same[name] - values) < 1e-3 * np.linalg.norm(values), name


def test_a_smooth_volume_is_that_of_the_cpu(monkeypatch):
    cpu, gpu = (replace(SMOOTH, volume=replace(SMOOTH.volume, backend=name)) for name in ("cpu", "cuda"))
    true = found(cpu, frames(1000.0))["values"]
    with pretended_gpu(monkeypatch, kernels=False):
        same = found(gpu, frames(1000.0))["values"]
    assert np.linalg.norm(same - true) < 1e-3 * np.linalg.norm(true)


def test_what_a_fit_ends_with_stays_where_it_was(on_gpu):
    result = solve(GAUSSIANS.on_backend("cuda"), Task(frames().train(), KNOWN, 0, light=EVEN))
    assert result.backend == "cuda"
    assert all(isinstance(value, OnGpu) for value in result.parameters().values())


@pytest.mark.parametrize(
    ("method", "light"), [(GAUSSIANS, LightOptions()), (AUTO, EVEN)], ids=["Gaussians", "surfaces"]
)
def test_a_run_folder_is_written_judged_and_read_again(method, light, on_gpu, tmp_path):
    scan, folder = frames(), RunFolder(tmp_path / "run")
    done = reconstruct(scan, KNOWN, method.on_backend("cuda"), folder=folder, matter="levels", light=light)
    assert folder.read_summary()["backend"] == "cuda"
    assert folder.read_summary()["device"] == "a pretended GPU"
    again = load_reconstruction(folder)
    assert done.object.backend == again.object.backend == "cpu"
    first, second = (evaluate(each, scan, None) for each in (done, again))
    assert first.test is not None
    assert second.test is not None
    assert second.test.ssim == pytest.approx(first.test.ssim, abs=1e-4)
    assert first.test.ssim > 0.5


def test_a_run_goes_on_from_its_checkpoint(on_gpu, tmp_path):
    def stop(stage: str, fraction: float, record: dict[str, float]) -> None:
        if record.get("step") == 2:
            raise KeyboardInterrupt

    scan, folder, method = frames(), RunFolder(tmp_path / "run"), GAUSSIANS.on_backend("cuda")
    run = partial(reconstruct, scan, KNOWN, method, folder=folder, matter="levels", light=EVEN)
    assert not run(on_progress=stop).finished
    assert run(resume=True).finished


def test_a_run_that_finds_where_frames_are(on_gpu):
    refine = PoseOptions()
    done = reconstruct(frames(), KNOWN, GAUSSIANS.on_backend("cuda"), matter="levels", light=EVEN, refine=refine)
    assert done.geometry is not None


def test_surfaces_of_coarse_pixels_go_on_to_finer_ones(on_gpu):
    vertices, faces = unit_ball(1)
    matter = Matter.one(two_balls.DELTA, two_balls.BETA)
    coarse = SurfaceMesh(torch.tensor(4 * vertices), torch.tensor(faces), 2e-6, matter).on("cuda")
    finer = on_pixels(coarse, 1e-6, 2.5)
    assert len(finer.faces) > len(faces)
    assert float(finer.vertices.norm(dim=1).mean()) == pytest.approx(8.0, rel=0.05)
