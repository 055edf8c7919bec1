"""What surfaces in motion cost beside what frames say, against sums, closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import MATERIAL, PIXEL, true_paths, truth
from holosplat.fit.problem import Batch
from holosplat.fit.terms.object import CurvatureVariation
from holosplat.matter import Matter
from holosplat.motion.elastic import Acceleration, Apart, MovingCurvature, area_kept, volume_kept
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere


class Fake:
    """Stands for a model of these paths."""

    def __init__(self, paths):
        self.paths = paths

    def parameters(self):
        return {"object.coefficients": self.paths}


def test_smoothness_in_time_is_the_mean_over_times():
    """A body that only moves costs what it does at rest, and one that changes the mean of its shapes; gradients of all
    terms against finite differences."""
    body, times = true_paths(), truth().times

    def energy_at(time: float) -> float:
        of = CurvatureVariation(1.0, body.at(0.5 * (body.basis.first + body.basis.last)))
        return float(of.energy(body.at(time).vertices))

    shown = np.linspace(body.basis.first, body.basis.last, body.basis.count + 1)
    term, paths = MovingCurvature(1.0, body), body.coefficients.clone().requires_grad_()
    (part,) = term(Fake(paths), None)  # type: ignore[arg-type]
    assert float(part.value.detach()) == pytest.approx(np.mean([energy_at(t) for t in shown]))
    still = balls((0.0, 0, 0)).coefficients + torch.tensor([0.0, 9.0])[:, None, None]
    (part,) = MovingCurvature(1.0, balls((0.0, 0, 0)))(Fake(still), None)  # type: ignore[arg-type]
    alone = balls((0.0, 0, 0)).at(0.0)
    assert float(part.value) == pytest.approx(float(CurvatureVariation(1.0, alone).energy(alone.vertices)))
    for made in (term, Acceleration(1.0, body), volume_kept(1.0, body, times), area_kept(1.0, body, times)):
        paths.grad = None
        made(Fake(paths), None)[0].value.backward()  # type: ignore[arg-type]
        way = torch.randn(paths.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        ends = [float(made(Fake(paths.detach() + s * way), None)[0].value) for s in (1e-4, -1e-4)]  # type: ignore[arg-type]
        assert paths.grad is not None
        assert float((paths.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=3e-3)


def test_bodies_of_any_number_of_vertices_count_alike_where_paths_bend():
    """Two balls, one of many triangles, whose middles go as t² and 3 t² [pixels]: Σ of the squares of 2 and 6."""
    basis, times = TimeBasis(0.0, 1.0, 2), np.linspace(0, 1, 5)
    (few, own), (many, others) = icosphere(1), icosphere(2)
    way = times[:, None, None] ** 2 * np.array([1.0, 0, 0])
    paths = [basis.fitted(times, PIXEL * (ball + size * way)) for ball, size in ((few, 1), (many + 20, 3))]
    pair = MovingSurfaces.of_bodies(paths, [own, others], basis, PIXEL, Matter.one(*MATERIAL))
    (part,) = Acceleration(1.0, pair)(Fake(pair.coefficients), None)  # type: ignore[arg-type]
    assert float(part.value) == pytest.approx(2**2 + 6**2)


def grown(rates, sizes_at, times):
    """Unit balls, far apart, blown up by `sizes_at` of the rate at `times`."""
    basis, (sphere, faces) = TimeBasis(0.0, 1.0, 3), icosphere(1)
    paths = [
        basis.fitted(times, PIXEL * (sizes_at(rate)[:, None, None] * sphere + 10.0 * k)) for k, rate in enumerate(rates)
    ]
    return MovingSurfaces.of_bodies(paths, [faces] * len(rates), basis, PIXEL, Matter.one(*MATERIAL))


@pytest.mark.parametrize(("kept", "power"), [(volume_kept, 3), (area_kept, 2)])
def test_sizes_are_kept_by_what_they_change(kept, power):
    """Bodies blown up evenly by 1, 2 and 3 % a time: Σ of the variances of their sizes over their squared means."""
    times = np.linspace(0, 1, 5)
    body = grown((0.01, 0.02, 0.03), lambda rate: 1 + 4 * rate * times, times)
    sizes = [(1 + 4 * rate * times) ** power for rate in (0.01, 0.02, 0.03)]
    wanted = sum(np.var(size) / np.mean(size) ** 2 for size in sizes)
    (part,) = kept(1.0, body, times)(Fake(body.coefficients), None)
    assert part.name == kept.args[0]
    assert float(part.value) == pytest.approx(wanted)


def balls(*places, radius=4.0, subdivisions=2) -> MovingSurfaces:
    """Balls that stand still, or go on a straight line from one place to another [pixels]."""
    sphere, faces = icosphere(subdivisions)
    ends = [np.array([place, place]) if np.ndim(place) == 1 else np.array(place) for place in places]
    paths = [PIXEL * (radius * sphere + end[:, None]) for end in ends]
    return MovingSurfaces.of_bodies(paths, [faces] * len(paths), TimeBasis(0.0, 1.0, 1), PIXEL, Matter.one(*MATERIAL))


def cap(radius: float, distance: float) -> float:
    """∫ d² dA over both balls' surfaces, d the depth in the other one, by quadrature of the angle to the axis."""
    cosine = np.linspace(distance / (2 * radius), 1, 20001)
    depth = radius - np.sqrt(radius**2 + distance**2 - 2 * radius * distance * cosine)
    return float(2 * 2 * np.pi * radius**2 * np.trapezoid(depth**2, cosine))


def test_the_overlap_of_balls_converges_to_the_integral():
    errors = []
    for subdivisions in (2, 3, 4):
        pair = balls((0.0, 0, 0), (5.0, 3.0, 1.0), subdivisions=subdivisions)
        found = Apart(1.0, pair, np.zeros(1)).overlap(pair.at(0.0).vertices)
        errors.append(abs(float(found) / cap(4.0, 35**0.5) - 1))
    assert errors[0] < 0.1
    assert errors[2] < 0.5 * errors[1] < 0.25 * errors[0]


def test_balls_that_do_not_overlap_cost_nothing():
    """Though their boxes meet; a ball in the middle of three touches both others."""
    apart = balls((0.0, 0, 0), (5.0, 5.0, 5.0))
    assert float(Apart(1.0, apart, np.zeros(1)).overlap(apart.at(0.0).vertices)) == 0
    row = balls((-7.0, 0, 0), (0.0, 0, 0), (7.0, 0, 0))
    assert float(Apart(1.0, row, np.zeros(1)).overlap(row.at(0.0).vertices)) == pytest.approx(
        2 * cap(4.0, 7.0), rel=0.2
    )


def test_overlap_is_the_mean_over_the_times_of_a_steps_frames():
    """One ball comes to the other: apart at first, deep in it at last."""
    pair, times = balls((0.0, 0, 0), ((12.0, 0, 0), (6.0, 0, 0))), np.array([0.0, 0.0, 1.0, 1.0])
    term = Apart(2.0, pair, times)

    def overlap_in(index):
        return term(Fake(pair.coefficients), Batch(index, torch.zeros(3), torch.zeros(()), 0))  # type: ignore[arg-type]

    (whole,) = overlap_in(None)
    (late,) = overlap_in(torch.tensor([2, 3]))
    assert (whole.name, whole.weight) == ("apart", 2.0)
    assert float(late.value) == pytest.approx(2 * float(whole.value))
    assert float(late.value) == pytest.approx(cap(4.0, 6.0), rel=0.1)


def test_the_gradient_of_the_overlap_parts_bodies():
    """Against finite differences; and down the slope the balls move away from each other."""
    pair = balls((0.0, 0, 0), (5.0, 3.0, 1.0))
    term, paths = Apart(1.0, pair, np.zeros(1)), pair.coefficients.clone().requires_grad_()
    term.overlap(paths[0]).backward()
    assert paths.grad is not None
    way = torch.randn(paths.shape[1:], dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ends = [float(term.overlap(paths.detach()[0] + s * way)) for s in (1e-6, -1e-6)]
    assert float((paths.grad[0] * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)
    pulls = [paths.grad[0][pair.body(k)[0]].sum(0) for k in range(2)]
    towards = torch.tensor([5.0, 3.0, 1.0], dtype=torch.float64)
    assert float(pulls[0] @ towards) > 0 > float(pulls[1] @ towards)
