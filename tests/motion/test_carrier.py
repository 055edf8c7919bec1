"""The velocity field that bodies share: against closed forms, finite differences, and bodies that share none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from helpers.moving_ellipsoids import MATERIAL, PIXEL, scan, true_paths
from holosplat.cli.bodies import MotionFlags
from holosplat.fit.schedule import Schedule
from holosplat.matter import Matter
from holosplat.motion.fit import MotionFit, motion_fit
from holosplat.motion.residual_detection import only
from holosplat.motion.velocity_prior import FAMILIES, Carried, Carrier, Expected, middles_of
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere

BASIS = TimeBasis(0.0, 1e-3, 2)
TIMES = np.linspace(BASIS.first, BASIS.last, 16)
BOX = np.array([17.0, 45.0, 23.0])
COUNT = 14


def starts(count: int = COUNT, seed: int = 0) -> np.ndarray:
    """[B, 3], in a box of three different edges [pixels]."""
    return np.random.default_rng(seed).uniform(-BOX, BOX, (count, 3))


def paths_of(way, noise: float = 0.0, count: int = COUNT) -> np.ndarray:
    """[K, B, 3] of bodies that are at `way(starts, share of the time)`, seen with some `noise` [pixels]."""
    begun = starts(count)
    places = np.array([way(begun, share) for share in np.linspace(0, 1, len(TIMES))])
    return BASIS.fitted(TIMES, places + noise * np.random.default_rng(1).normal(size=places.shape))


def turned(angle: float):
    """Bodies that turn about an axis which is none of the frame's."""
    axis = np.array([0.3, 0.9, -0.2]) / np.linalg.norm([0.3, 0.9, -0.2])

    def way(begun, share):
        along = (begun @ axis)[:, None] * axis
        about, across = begun - along, np.cross(axis, begun)
        return along + np.cos(angle * share) * about + np.sin(angle * share) * across

    return way, axis


def profile(places: np.ndarray) -> np.ndarray:
    """Poiseuille's flow in a tube along y, and something of a shift: [P, 3] pixels in the time of all frames."""
    speeds = 25 * (1 - (places[:, 0] ** 2 + places[:, 2] ** 2) / 30**2)
    return np.stack([0 * speeds, speeds, 0 * speeds], 1)


def found(paths: np.ndarray):
    """The family of the field, and the field as a function of places [P, 3] and of the time."""
    carrier = Carrier.about(paths, BASIS)
    expected = carrier.expected(paths)
    flow = carrier.flow(carrier.likeliest(paths, expected), expected)
    return expected, lambda places, time: flow.velocity(torch.from_numpy(places - carrier.middle), time).numpy()


@pytest.mark.parametrize("family", FAMILIES)
def test_no_field_has_a_divergence(family):
    """To rounding, at any place and time; and each is the polynomial that the equations have."""
    paths = paths_of(lambda begun, share: begun + share * profile(begun))
    carrier = Carrier.about(paths, BASIS)
    expected = Expected(family, True, 1.0, 1.0, 1.0, np.ones(COUNT))
    coefficients = np.random.default_rng(2).normal(size=2 * len(FAMILIES[family]))
    flow, places = carrier.flow(coefficients, expected), starts(31, 3)
    slopes = flow.gradient(torch.from_numpy(places), 3e-4)
    size = max(float(slopes.abs().max()), 1e-6)
    assert float(slopes.diagonal(dim1=1, dim2=2).sum(1).abs().max()) < 1e-12 * size
    seen = carrier.fields(np.repeat(places[:, None], len(carrier.nodes), 1), expected) @ coefficients
    for k, node in enumerate(carrier.nodes):
        ours = flow.velocity(torch.from_numpy(places), float(node)).numpy()
        assert ours == pytest.approx(seen.reshape(len(places), -1, 3)[:, k], abs=1e-9)


def test_families_have_as_many_fields_as_equations_leave():
    """Of degree 0, 1 and 2 in space 3, 8 and 15 have no divergence."""
    sizes = {name: len(fields) for name, fields in FAMILIES.items()}
    assert sizes == {"uniform": 3, "turning": 6, "profile": 8, "linear": 11, "quadratic": 26}
    assert all(np.linalg.matrix_rank(one.reshape(len(one), -1)) == len(one) for one in FAMILIES.values())


def test_a_parabolic_profile_is_found_from_paths():
    """Between bodies, too; and the scatter that is found is that of the paths."""
    way = lambda begun, share: begun + share * profile(begun)  # noqa: E731
    places = starts(40, 5)
    for noise, bound in ((0.0, 1e-4), (0.02, 0.03)):
        expected, field = found(paths_of(way, noise))
        assert (expected.family, expected.changes) == ("profile", False)
        assert np.abs(field(places, 5e-4) - profile(places)).mean() < bound
    assert expected.along < 0.1
    assert 0.01 < expected.passing < 0.1


def test_a_turn_is_found_to_the_order_of_the_paths():
    """Parabolas leave of a turn by an angle θ about θ³: of its velocity θ²."""
    errors, places = [], starts(40, 5)
    for angle in (0.4, 0.2, 0.1):
        way, axis = turned(angle)
        expected, field = found(paths_of(way))
        assert expected.family == "turning"
        wanted = angle * np.cross(axis, places)
        errors.append(np.abs(field(places, 5e-4) - wanted).max() / np.abs(wanted).max())
    assert errors[0] < 0.02
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.7).all(), (errors, orders)


def test_bodies_of_no_common_field_are_left_alone():
    """Each on a way of its own: the scatter is that of their velocities, and a pull is a ten-thousandth of that in a
    profile."""
    own = np.random.default_rng(4).normal(size=(COUNT, 3)) * 6
    alone = paths_of(lambda begun, share: begun + share * own, 0.02)
    together = paths_of(lambda begun, share: begun + share * profile(begun), 0.02)
    expected, _ = found(alone)
    assert 3 < min(expected.along, expected.across) < max(expected.along, expected.across) < 12
    pulls = []
    for paths in (alone, together):
        term = with_middles(paths)
        moved = paths.copy()
        moved[:, 0] += np.array([[-0.5], [0.0], [0.5]])  # one body faster by a pixel, along all axes
        pulls.append(float(term.cost(torch.from_numpy(moved))) - float(term.cost(torch.from_numpy(paths))))
    assert 0 <= abs(pulls[0]) < 2
    assert pulls[1] > 100 * max(abs(pulls[0]), 0.01)


def test_a_stray_body_counts_little():
    """One of fourteen goes against the flow: the others' scatter stays small, and their field right."""
    stray = np.r_[-40.0, np.ones(COUNT - 1)][:, None]

    def way(begun, share):
        return begun + share * np.where(stray < 0, np.array([[9.0, -20.0, 7.0]]), profile(begun))

    expected, field = found(paths_of(way, 0.02))
    assert expected.family == "profile"
    assert expected.counts[0] < 0.05 < 0.3 < expected.counts[1:].min()
    places = starts(40, 5)
    assert np.abs(field(places, 5e-4) - profile(places)).mean() < 0.2


def with_middles(paths: np.ndarray) -> Carried:
    """The term of bodies whose middles go on `paths` [K, B, 3] [pixels]."""
    sphere, faces = icosphere(1)
    every = [PIXEL * (np.broadcast_to(sphere, (3, *sphere.shape)) + paths[:, b, None]) for b in range(paths.shape[1])]
    bodies = MovingSurfaces.of_bodies(every, [faces] * len(every), BASIS, PIXEL, Matter.one(*MATERIAL))
    return Carried(1.0, bodies)


def test_the_gradient_is_that_of_the_likeliest_field():
    """Against finite differences, though the field is another one for other paths."""
    paths = torch.from_numpy(paths_of(lambda begun, share: begun + share * profile(begun), 0.3))
    term, leaf = with_middles(paths.numpy()), paths.clone().requires_grad_()
    term.cost(leaf).backward()
    way = torch.randn(paths.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ends = [float(term.cost(paths + step * way)) for step in (1e-4, -1e-4)]
    assert leaf.grad is not None
    assert float((leaf.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5)


def test_a_body_that_is_seen_once_moves_as_the_others_say():
    """Its place is known at one time alone, those of the others at all times: its velocity comes from the profile."""
    way = lambda begun, share: begun + share * profile(begun)  # noqa: E731
    true, noise = paths_of(way), 0.05 * np.random.default_rng(6).normal(size=(len(TIMES), COUNT, 3))
    weights = BASIS.weights(TIMES)
    seen = torch.from_numpy(np.einsum("tk,kbx->tbx", weights, true) + noise)
    known = torch.ones(len(TIMES), COUNT, 1, dtype=torch.float64)
    known[:, 0] = 0
    known[3, 0] = 1
    start = true.copy()
    start[:, 0] = np.array([0.0, 0.0, 0.0]) + (weights[3] @ true[:, 0])  # it stands still where it is seen
    centres, expected = torch.from_numpy(start).requires_grad_(), None
    for _ in range(2):  # as stiff and soft fits do: what is expected comes from the paths before
        term = with_middles(centres.detach().numpy())
        expected = term.expected
        optimiser = torch.optim.LBFGS([centres], max_iter=70, line_search_fn="strong_wolfe", tolerance_change=1e-12)

        def closure(term=term, optimiser=optimiser, centres=centres):
            optimiser.zero_grad()
            away = torch.einsum("tk,kbx->tbx", torch.from_numpy(weights), centres) - seen
            loss = 0.5 * (known * away.square()).sum() / 0.05**2 + term.cost(centres)
            loss.backward()
            return loss

        optimiser.step(closure)
    assert expected is not None
    assert expected.family == "profile"
    ends = [
        (BASIS.weights(BASIS.last)[0] - BASIS.weights(BASIS.first)[0]) @ one[:, 0]
        for one in (centres.detach().numpy(), true)
    ]
    assert np.linalg.norm(ends[1]) > 10
    assert ends[0] == pytest.approx(ends[1], abs=0.5)


def test_the_option_comes_to_every_fit():
    """Off unless it is asked for."""
    for weight, flags in ((0.0, MotionFlags()), (0.5, MotionFlags(carrier=0.5))):
        options = flags.options()
        assert [one.carrier for one in (options.stiff, options.soft, options.half)] == [weight] * 3


def test_middles_are_those_of_surfaces():
    body = true_paths()
    middles, places = middles_of(body), body.at(2e-5).vertices.numpy()
    for k in range(body.count):
        own, faces = (one.numpy() for one in body.body(k))
        corners = places[own][faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        wanted = (areas[:, None] * corners.mean(1)).sum(0) / areas.sum()
        assert (middles @ places)[k] == pytest.approx(wanted, abs=1e-9)


@cache
def one_fit(bodies: int, weight: float) -> MovingSurfaces:
    """A few steps from true paths."""
    start = only(true_paths(), list(range(bodies)))
    how = MotionFit(carrier=weight, schedule=Schedule(steps=3, views_per_step=8))
    fit = motion_fit(scan(), start, how)
    fit.run(lambda record: None)
    result = fit.result().object
    assert isinstance(result, MovingSurfaces)
    return result


def test_a_fit_has_the_term_where_two_bodies_are():
    """A body alone is fitted as without it, bit for bit; several are not; and columns and weights say so."""
    assert torch.equal(one_fit(1, 1.0).coefficients, one_fit(1, 0.0).coefficients)
    assert not torch.equal(one_fit(3, 1.0).coefficients, one_fit(3, 0.0).coefficients)
    problem = motion_fit(scan(), true_paths(), replace(MotionFit(), carrier=1.0)).plan.problem
    told = problem.resolved()
    assert told["carrier"] > 0
    assert told["carrier_along_px"] > 0
