"""The fit of closed surfaces, and its sparse algebra, on the GPU or in Triton's interpreter, against the CPU's."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from torch import Tensor

from helpers.bumpy import bumpy, poses, surfaces
from helpers.poses import relative
from holosplat.beamline.simulate import simulate
from holosplat.fit.loop import Fit
from holosplat.fit.pose_refinement import PoseRefinement
from holosplat.fit.problem import Schedule
from holosplat.fit.terms.object import Neighbours, membrane_inverse
from holosplat.materials import HAEMOGLOBIN
from holosplat.methods import Auto, SurfaceFit, Surfaces, finished
from holosplat.methods.surface_fit import surface_fit
from holosplat.optics.hologram import reference as plain_waves
from holosplat.representations import SurfaceMesh
from holosplat.representations.isosurface import adjacency
from holosplat.scan import Exposures, Scan
from holosplat.specimens.scene import MeshScene

PITCH = 1e-6
STEPS = SurfaceFit(schedule=Schedule(steps=4, oversample=1))


@pytest.fixture(scope="module")
def mesh() -> SurfaceMesh:
    """A ball beside a pointed one: vertices of 4 to 6 neighbours."""
    return surfaces(bumpy(2, 3.0), bumpy(0, 2.0, (9.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def tiny() -> Scan:
    """A bumpy body in three views of a few pixels."""
    true = bumpy(2, 3.6, (0.4, -0.3, 0.2), depth=0.25)
    scene = MeshScene.of_one_material([replace(true, vertices=PITCH * true.vertices)], HAEMOGLOBIN.delta_beta(20.0))
    return simulate(scene, Exposures.of(poses(3, (13, 16), seed=3, pitch=PITCH), 20.0, 0.01, 0.3))


def random(*shape: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=shape))


def test_a_product_is_that_of_scipy(mesh, gpu):
    """Of rows of different lengths, one of them empty, and of a matrix that is not square."""
    matrix = csr_array(np.where(np.arange(7)[:, None] * np.arange(5) % 3 == 1, 1.0, 0.0) * np.linspace(-1, 2, 5))
    assert len(set(np.diff(matrix.indptr))) > 1
    assert np.diff(matrix.indptr).min() == 0
    x = random(5, 3)
    assert relative((Neighbours(matrix, gpu) @ x.to(gpu)).cpu(), torch.from_numpy(matrix @ x.numpy())) < 1e-15
    nothing = Neighbours(csr_array((4, 5)), gpu) @ x.to(gpu)
    assert nothing.shape == (4, 3)
    assert not nothing.any()


@pytest.mark.parametrize("stiffness", [0.0, 0.5, 10.0, 300.0])
def test_the_membrane_is_that_of_the_direct_solver(mesh, stiffness, gpu):
    edges, count = adjacency(mesh.faces.numpy(), len(mesh.vertices)), len(mesh.vertices)
    whole = csc_array(eye_array(count) + stiffness * (diags_array(edges.sum(1)) - edges))
    solve = membrane_inverse(edges, stiffness, gpu)
    for x in (random(count, 3), torch.ones(count, 1).double(), torch.eye(count, 2).double()):
        wanted = torch.from_numpy(splu(whole).solve(x.numpy()))
        assert relative(solve(x.to(gpu)).cpu(), wanted) < 3e-9
    assert relative(membrane_inverse(edges, stiffness, gpu, 0.1)(x.to(gpu)).cpu(), wanted) < 0.3


@pytest.fixture
def quick_waves(gpu, monkeypatch):
    """Waves, which other tests look at, are not those of the interpreter, which would take most of the time here."""
    if gpu.type == "cpu":
        monkeypatch.setitem(sys.modules, "holosplat.optics.hologram.cuda", plain_waves)


def run(fit: Fit) -> tuple[Tensor, list[float]]:
    """The vertices that a fit ends with, in main memory, and the losses of its steps."""
    losses = list[float]()
    fit.run(lambda record: losses.append(float(record["loss"])))
    found = finished(fit)
    assert isinstance(found, SurfaceMesh)
    return found.vertices.cpu(), losses


@pytest.mark.parametrize("freed", [False, True], ids=["", "freed"])
@pytest.mark.usefixtures("quick_waves")
def test_a_fit_is_that_on_the_cpu(tiny, freed):
    start = surfaces(bumpy(1, 3.4, depth=0.0), unit=PITCH)
    freedom = PoseRefinement(0.5, 0.01, 0.01, 0.02, np.zeros((3, 7)), edges=True) if freed else None
    ends, losses = zip(
        *(run(surface_fit(tiny, start, replace(STEPS, backend=of), freedom=freedom)) for of in ("cpu", "cuda"))
    )
    assert losses[0][-1] < losses[0][0] - 0.1
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    assert (ends[0] - start.vertices).abs().max() > 0.15
    assert (ends[1] - ends[0]).abs().max() < 1e-4
    assert start.vertices.device.type == "cpu"
    assert start.backend == "cpu"


def test_a_fit_of_the_gpu_needs_no_solver_of_the_cpu(tiny, gpu, monkeypatch):
    monkeypatch.setattr("holosplat.methods.surface_fit.splu", None)
    start = surfaces(bumpy(0, 3.4), unit=PITCH)
    fit = surface_fit(tiny, start, replace(STEPS, backend="cuda"))
    assert isinstance(fit.model.object, SurfaceMesh)
    assert fit.backend == fit.model.object.backend == "cuda"
    assert not fit.plan.capture
    with pytest.raises(TypeError):
        surface_fit(tiny, start, replace(STEPS, backend="cpu"))


def test_methods_pass_the_backend_on():
    for backend in ("cuda", "reference"):
        assert Surfaces().on_backend(backend).fit.backend == backend
        assert Auto().on_backend(backend).surfaces.fit.backend == backend
