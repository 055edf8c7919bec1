"""Paths in time and surfaces on them: splines against polynomials, an ellipsoid that moves and deforms, gradients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Object

PITCH, LAST = 2e-6, 3e-5
MATTER = Matter.one(3e-7, 2e-10)
BASIS = TimeBasis(0.0, LAST, 2)
AXES = np.array([[7.0, 5.0, 6.0], [1.5, -1.0, 0.5], [-0.8, 0.6, 0.4]])
"""Half axes [pixels] of the ellipsoid: constant, and by the time and its square in units of `LAST`."""
CENTRE = np.array([[-4.0, 2.0, 1.0], [9.0, -5.0, 2.0], [1.0, 0.5, -1.5]])


def polynomial(coefficients: np.ndarray, time: float) -> np.ndarray:
    """Of the time in units of `LAST`."""
    t = time / LAST
    return coefficients[0] + coefficients[1] * t + coefficients[2] * t**2


def ellipsoid(subdivisions: int = 3, basis: TimeBasis = BASIS, centre: np.ndarray = CENTRE) -> MovingSurfaces:
    """It moves and deforms by polynomials of second degree, which the basis holds."""
    sphere, faces = icosphere(subdivisions)
    times = np.linspace(basis.first, basis.last, 9)
    places = np.array([polynomial(AXES, t) * sphere + polynomial(centre, t) for t in times])
    return MovingSurfaces.of_bodies([PITCH * basis.fitted(times, places)], [faces], basis, PITCH, MATTER)


def thickness(views: Views, time: float) -> np.ndarray:
    """Mean thickness [V, H, W] [m] of the ellipsoid over pixels, by rays through 6² points of each.

    A ray p + s d is inside where |E⁻¹(p + s d - c)| < 1: between the roots of a quadratic equation.
    """
    half, centre = PITCH * polynomial(AXES, time), PITCH * polynomial(CENTRE, time)
    fine, found = views.refined(6), []
    h, w = fine.shape
    for rotation, shift in zip(views.rotations, views.shifts):
        x = (np.arange(w) + 0.5 - 0.5 * w) * fine.pixel_size + shift[0]
        y = (np.arange(h) + 0.5 - 0.5 * h) * fine.pixel_size + shift[1]
        points = np.stack([*np.broadcast_arrays(x, y[:, None]), np.zeros((h, w))], -1) @ rotation
        p, d = (points - centre) / half, rotation[2] / half
        a, b, c = d @ d, p @ d, (p * p).sum(-1) - 1
        found.append(2 * np.sqrt(np.maximum(b**2 - a * c, 0)) / a)
    height, width = views.shape
    return np.array(found).reshape(len(views), height, 6, width, 6).mean((2, 4))


def finely(body: MovingSurfaces, lines: int) -> MovingSurfaces:
    """The same, integrated along more rows of a pixel."""
    return MovingSurfaces(body.coefficients, body.faces, body.of_body, body.basis, PITCH, MATTER, lines)


@pytest.mark.parametrize(("degree", "pieces"), [(1, 1), (2, 1), (2, 4), (3, 5), (0, 1)])
def test_splines_are_the_polynomials_of_their_degree(degree, pieces):
    basis = TimeBasis(1e-5, 5e-5, degree, pieces)
    powers = np.random.default_rng(degree).normal(size=degree + 1)
    at = lambda t: np.polyval(powers, (t - 3e-5) / 1e-5)  # noqa: E731
    coefficients = basis.fitted(np.linspace(1e-5, 5e-5, 23), at(np.linspace(1e-5, 5e-5, 23)))
    inside, beyond = np.linspace(1e-5, 5e-5, 57), np.array([0.0, 5.6e-5])
    assert basis.weights(inside).sum(1) == pytest.approx(1.0)
    for times in (inside, beyond):
        assert basis.weights(times) @ coefficients == pytest.approx(at(times), abs=1e-9)
    slope = np.polyval(np.polyder(powers), (inside - 3e-5) / 1e-5) / 1e-5
    assert basis.weights(inside, 1) @ coefficients == pytest.approx(slope, abs=1e-3)


def test_the_curvature_is_that_of_the_second_derivative():
    for basis in (
        TimeBasis(0.0, 1.0, 2),
        TimeBasis(0.0, 1.0, 2, 5),
        TimeBasis(0.0, 1.0, 3, 4),
        TimeBasis(0.0, 1.0, 5, 2),
    ):
        times = np.linspace(0, 1, 31)
        straight, bent = (basis.fitted(times, 2 + times**power) for power in (1, 2))
        assert basis.curvature() @ straight == pytest.approx(0, abs=1e-9)
        assert basis.curvature() @ bent * basis.pieces**2 == pytest.approx(2.0)  # the second derivative of t²


def test_paths_of_too_few_times_are_the_smallest():
    found = TimeBasis(0.0, 1.0, 2).fitted(np.array([0.5]), np.array([[2.0, 4.0]]))
    assert TimeBasis(0.0, 1.0, 2).weights(0.5) @ found == pytest.approx(np.array([[2.0, 4.0]]))
    assert np.abs(found).max() < 4.01 * 4


def test_the_gram_matrix_gives_mean_squares():
    basis, times = TimeBasis(0.0, 2.0, 3, 3), np.array([0.0, 0.1, 0.7, 1.3, 2.0])
    path = np.random.default_rng(0).normal(size=basis.count)
    assert path @ basis.gram(times) @ path == pytest.approx(np.mean((basis.weights(times) @ path) ** 2))


@pytest.mark.parametrize(
    "bad", [(0.0, 1.0, 9), (0.0, 1.0, -1), (0.0, 1.0, 2, 0), (1.0, 1.0, 2), (2.0, 1.0), (0.0, np.nan)]
)
def test_a_basis_that_cannot_be_is_refused(bad):
    with pytest.raises(InputError, match="paths"):
        TimeBasis(*bad)


def test_a_moving_ellipsoid_has_its_shape_between_frames_too():
    body, (sphere, faces) = ellipsoid(), icosphere(3)
    assert isinstance(body, Object)
    whole = body.at(0.0).bodies()[0].volume / (PITCH**3 * np.prod(AXES[0]))
    for time in (0.0, 0.37 * LAST, 0.5 * LAST, LAST, 1.1 * LAST):
        (mesh,) = body.bodies(time)
        wanted = PITCH * (polynomial(AXES, time) * sphere + polynomial(CENTRE, time))
        assert mesh.vertices == pytest.approx(wanted, abs=1e-9 * PITCH)
        assert mesh.volume == pytest.approx(whole * PITCH**3 * np.prod(polynomial(AXES, time)), rel=1e-9, abs=0)
        assert np.array_equal(mesh.faces, faces)


@pytest.mark.parametrize("time", [0.0, 0.63 * LAST])
def test_its_line_integrals_are_those_of_rays(time):
    """On a rectangular field of odd sides; finer triangles come nearer to the smooth body, four times a level."""
    views = Views.from_angles([0.0, 37.0, 100.0], (25, 33), PITCH)
    wanted, errors = thickness(views, time), []
    for level in (2, 3):
        B, D = ellipsoid(level).at(time).project(views)
        errors.append(float(np.abs(D.numpy() / 3e-7 - wanted).mean() / wanted.mean()))
        assert B.numpy() == pytest.approx(D.numpy() * 2e-10 / 3e-7)
    assert errors[1] < 0.35 * errors[0] < 0.35 * 0.05


def test_its_volume_on_voxels_follows_it():
    grid = Grid.of_views(Views.from_angles([0.0], (25, 33), PITCH))
    for time in (0.0, LAST):
        volume = ellipsoid().at(time).voxelise(grid)
        (mesh,) = ellipsoid().bodies(time)
        assert volume.delta.sum() * PITCH**3 == pytest.approx(3e-7 * mesh.volume, rel=1e-3, abs=0)
        z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
        middle = [float((volume.delta * c).sum() / volume.delta.sum()) / PITCH for c in (x, y, z)]
        assert middle == pytest.approx(polynomial(CENTRE, time), abs=0.02)


def test_the_gradient_of_paths_is_the_frames_difference():
    """Of thickness at five times at once, weighed smoothly and along many lines, for the gradient is the integral's."""
    views = Views.from_angles([0.0, 71.0], (23, 31), PITCH)
    body, times, outward = ellipsoid(2), np.linspace(0, LAST, 5), torch.from_numpy(icosphere(2)[0].copy())
    weights = 1 + 0.7 * torch.sin(torch.arange(23.0) / 9)[:, None] * torch.cos(torch.arange(31.0) / 8)

    def measure(paths: torch.Tensor) -> torch.Tensor:
        moved = finely(body.with_parameters({"coefficients": paths}), 16)
        thick = [moved.at(t).project(views).channels[:, 0] / PITCH for t in times]
        return sum((1 + k) * (weights * one).sum() for k, one in enumerate(thick))  # type: ignore[return-value]

    paths = body.coefficients.clone().requires_grad_()
    measure(paths).backward()
    assert paths.grad is not None
    for k in range(body.basis.count):
        way = torch.zeros_like(body.coefficients)
        way[k] = outward * (1 + 0.5 * torch.sin(2 * outward.roll(1, 1) + k))
        with torch.no_grad():
            found = (measure(paths + 0.02 * way) - measure(paths - 0.02 * way)) / 0.04
        assert float((paths.grad * way).sum()) == pytest.approx(float(found), rel=0.01)


def test_a_model_of_several_times_has_the_gradients_of_each():
    """A path's coefficient moves the surfaces of every time by its weight there; batches of frames add up."""
    views = Views.from_angles([0.0, 71.0], (23, 31), PITCH)
    times = np.linspace(0, LAST, 4)
    instrument, body = Instrument(Exposures.of(views, 20.0, 0.05).repeated(times)), ellipsoid(2)
    paths = body.coefficients.clone().requires_grad_()
    model = Model(body.with_parameters({"coefficients": paths}), instrument)
    for batch in (torch.tensor([0, 3, 4]), torch.tensor([1, 2, 5, 6, 7])):
        (model.frames(batch) ** 2).sum().backward()
    wanted = torch.zeros_like(paths)
    for time, weights in zip(times, body.basis.weights(times)):
        still = body.at(time)
        vertices = still.vertices.clone().requires_grad_()
        one = Instrument(Exposures.of(views, 20.0, 0.05))
        (Model(still.with_parameters({"vertices": vertices}), one).frames() ** 2).sum().backward()
        assert vertices.grad is not None
        wanted += torch.from_numpy(weights)[:, None, None] * vertices.grad
    assert paths.grad is not None
    assert float((paths.grad - wanted).abs().max()) < 1e-5 * float(wanted.abs().max())


def test_bodies_keep_their_numbers():
    sphere, faces = icosphere(1)
    still = TimeBasis(0.0, 0.0, 0)
    paths = [(PITCH * (r * sphere + at))[None] for r, at in ((3.0, 0.0), (5.0, 20.0))]
    both = MovingSurfaces.of_bodies(paths, [faces, faces], still, PITCH, MATTER)
    assert both.count == 2
    assert [m.name for m in both.bodies(1.0)] == ["body000", "body001"]
    for mesh, path in zip(both.bodies(1.0), paths):
        assert mesh.vertices == pytest.approx(path[0], abs=1e-15)
    low, high = (both.enclosing_grid(10**6).axes()[0][k] / PITCH for k in (0, -1))
    assert low < -3.0
    assert high > 24.0


def test_what_does_not_fit_is_refused():
    body = ellipsoid(1)
    with pytest.raises(InputError, match=r"coefficients \(3, P, 3\)"):
        body.with_parameters({"coefficients": body.coefficients[:2]})
    with pytest.raises(InputError, match="needs its body"):
        MovingSurfaces(body.coefficients, body.faces, body.of_body[1:], BASIS, PITCH, MATTER)
    with pytest.raises(InputError, match="finite"):
        body.with_parameters({"coefficients": body.coefficients * torch.nan})
    with pytest.raises(InputError, match="name vertices"):
        MovingSurfaces.from_state(body.state() | {"faces": body.faces + 1})
    with pytest.raises(InputError, match="δ and β of the matter are free"):
        MovingSurfaces(body.coefficients, body.faces, body.of_body, BASIS, PITCH, Matter.free(3e-7, 2e-10))
    assert replace(BASIS, pieces=3).count == 5
