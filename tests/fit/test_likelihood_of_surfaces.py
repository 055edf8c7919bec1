"""The likelihood of frames whose noise is not known, and the prior of smooth shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.bumpy import DELTA, bumpy, poses, surfaces
from holosplat.fit.problem import Batch
from holosplat.fit.terms import FrameTerm, Objective
from holosplat.fit.terms.frames import ProfileLikelihood
from holosplat.fit.terms.object import CurvatureVariation
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.model import Instrument, Model
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures, Scan

WHOLE = Batch(None, torch.zeros(3), torch.ones(()), 0)
PITCH = 1e-6


class Of:
    """A model of vertices alone."""

    def __init__(self, vertices: Tensor) -> None:
        self.vertices = vertices

    def parameters(self) -> dict[str, Tensor]:
        return {"object.vertices": self.vertices}


def energy(mesh: SurfaceMesh, vertices: Tensor | None = None) -> Tensor:
    """The prior at `vertices` of the triangles and scale of `mesh`."""
    (part,) = CurvatureVariation(1.0, mesh)(Of(mesh.vertices if vertices is None else vertices), WHOLE)  # type: ignore[arg-type]
    return part.value


def tube(rows: int, depth: float = 0.0, wave: int = 4, size: float = 1.0, shift: float = 0.0) -> SurfaceMesh:
    """A ring of radius 60 from a tube of radius 8, of even triangles, with a wave of `depth` around the tube."""
    edge = 2 * np.pi * 8 / rows * 2 / np.sqrt(3)
    columns = round(2 * np.pi * 60 / edge)
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    u, v = 2 * np.pi * (i + 0.5 * j) / columns, 2 * np.pi * j / rows
    out = 8 + depth * np.cos(wave * v)
    away = 60 + out * np.cos(v)
    points = np.stack([away * np.cos(u), away * np.sin(u), out * np.sin(v)], axis=-1).reshape(-1, 3)

    def at(right: int, up: int) -> np.ndarray:
        """Rows are shifted by half a column each, and by `rows` / 2 of them all around."""
        turned = np.where(j + up >= rows, i + right + rows // 2, i + right)
        return (turned % columns * rows + (j + up) % rows).ravel()

    faces = np.concatenate([np.stack(f, 1) for f in ((at(0, 0), at(1, 0), at(0, 1)), (at(1, 0), at(1, 1), at(0, 1)))])
    return surfaces(TriangleMesh(size * points + shift, faces))


@pytest.mark.parametrize(("rows", "off"), [(24, 0.3), (48, 0.08)])
def test_waves_on_a_tube_cost_what_mean_curvature_says(rows, off):
    """A tube of radius a with r = a + ε cos mv has H = 1/2a + (m² ± 1) ε cos mv / 2a² to first order, where lengths
    along it are those of r (-) or of a (+), so that ½ (3a/2)² ∫ |∇H|² dA is 9/64 (m² + 1)² m² ε² · 4π² R / a³. What is
    off falls with the triangles; the mean of a wave and its opposite has no odd order."""
    wave, depth, start = 4, 0.02, tube(rows)
    values = [float(energy(start, tube(rows, s * depth, wave).vertices)) for s in (1, -1, 0)]
    wanted = 9 / 64 * (wave**2 + 1) ** 2 * wave**2 * depth**2 * 4 * np.pi**2 * 60 / 8**3
    found = 0.5 * (values[0] + values[1]) - values[2]
    assert abs(found / wanted - 1) < off
    assert values[2] < 3  # nats of the ring's own bend
    assert float(energy(tube(rows, 0.5))) > 100


def test_a_shape_costs_as_much_at_any_size_and_place():
    ring, whole = tube(24, 0.5), energy(tube(24, 0.5))
    assert float(energy(tube(24, 0.5, size=0.3, shift=20.0))) == pytest.approx(float(whole), rel=1e-9)
    inside_out = SurfaceMesh(ring.vertices, ring.faces.flip(1), ring.unit_length, ring.matter)
    assert float(energy(inside_out)) == pytest.approx(float(whole), rel=1e-9)
    alone = [float(energy(surfaces(one))) for one in (bumpy(3, 9.0), bumpy(3, 3.0), bumpy(3, 9.0, depth=0.3))]
    assert alone[1] == pytest.approx(alone[0], rel=1e-9)
    both = surfaces(bumpy(3, 9.0), bumpy(3, 3.0, (20.0, 0.0, 0.0), depth=0.3))
    assert float(energy(both)) == pytest.approx(alone[0] + alone[2], rel=1e-9)


def test_uneven_triangles_of_the_same_shape_cost_more():
    """Vertices that are moved along the tube, where its curvature stays."""
    ring, off = tube(24), np.random.default_rng(3).normal(size=(len(tube(24).vertices), 1))
    along = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]).double().expand_as(ring.vertices), ring.vertices)
    moved = ring.vertices + 0.2 * torch.from_numpy(off) * along / along.norm(dim=1, keepdim=True)
    assert float(energy(ring, moved)) > 100 * float(energy(ring))


def test_vertices_of_no_triangle_cost_nothing():
    bumps = surfaces(bumpy(3, 9.0))
    points = torch.cat([bumps.vertices, torch.tensor([[50.0, 0.0, 0.0]])])
    lonely = SurfaceMesh(points, bumps.faces, bumps.unit_length, bumps.matter)
    vertices = lonely.vertices.clone().requires_grad_()
    value = energy(lonely, vertices)
    value.backward()
    assert float(value.detach()) == pytest.approx(float(energy(bumps)), rel=1e-9)
    assert vertices.grad is not None
    assert torch.isfinite(vertices.grad).all()
    assert not vertices.grad[-1].any()


def test_its_slope_is_that_of_differences():
    mesh = surfaces(bumpy(2, 5.0))
    vertices = mesh.vertices.clone().requires_grad_()
    energy(mesh, vertices).backward()
    way = torch.from_numpy(np.random.default_rng(2).normal(size=vertices.shape))
    ahead, behind = (float(energy(mesh, mesh.vertices + s * 1e-4 * way)) for s in (1, -1))
    assert vertices.grad is not None
    assert float((vertices.grad * way).sum()) == pytest.approx((ahead - behind) / 2e-4, rel=1e-5)


@pytest.fixture
def noisy() -> tuple[Scan, Model, FrameTerm]:
    """Frames of an empty beam with noise of .02, .01 and .04 in three rectangular views, one pixel of which is missing,
    beside a model of no matter to speak of."""
    exposures = Exposures.of(poses(3, (35, 42), seed=3, pitch=PITCH), 20.0, 0.05, 0.3)
    noise = np.array([0.02, 0.01, 0.04])[:, None, None] * np.random.default_rng(0).normal(size=(3, 35, 42))
    frames = (1 + noise).astype(np.float32)
    missing = np.zeros(frames.shape, dtype=bool)
    missing[1, 4, 5] = True
    scan = Scan(frames, exposures, np.zeros(3, dtype=bool), missing=missing)
    instrument = Instrument(exposures, 1)
    model = Model(surfaces(bumpy(1, 1e-3)), instrument)
    objective = Objective(l1=0.0, rounded=1.0, rounding=30.0)
    return scan, model, FrameTerm(scan, instrument, objective, Matter.one(DELTA, 0.0))


@pytest.mark.parametrize("alike", [False, True])
def test_the_likelihood_is_that_of_normal_noise_of_the_most_likely_levels(noisy, alike):
    """Of residuals that are far below c: N/2 log of their mean square in each view, or in all, up to a constant."""
    scan, model, frames = noisy
    term = ProfileLikelihood(frames, int(scan.measured.isfinite().sum()), alike)
    assert term.nat == 2 / (3 * 35 * 42 - 1)
    for index in (None, torch.tensor([2, 0])):
        part, shown = term(model, replace(WHOLE, index=index))
        assert (part.weight, shown.weight, shown.name) == (1.0, None, "rounded")
        left = scan.left(model.frames(None).detach()).double()
        squares = (left if index is None else left[index]).square().mean(dim=(1, 2))
        level = squares.mean() if alike else squares
        wanted = float((level / (2 * frames.resolved["rounding"] * frames.span**2)).log().mean())
        assert float(part.value.detach()) == pytest.approx(wanted, abs=0.01)
