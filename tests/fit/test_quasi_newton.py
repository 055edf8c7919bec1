"""L-BFGS: directions, an optimiser of one parameter, and a loop that looks at frames some at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.checks import InputError
from holosplat.fit.problem import Batch, Batches, Schedule
from holosplat.fit.projected_gradient import LONGER, QuasiNewton, direction

SHAPE = (3, 7, 5)
CURVATURES = torch.from_numpy(np.random.default_rng(0).uniform(1.0, 300.0, SHAPE))
LEAST = torch.from_numpy(np.random.default_rng(1).normal(size=SHAPE))


def same(gradient: Tensor) -> Tensor:
    return gradient


def quadratic(x: Tensor) -> Tensor:
    return 0.5 * (CURVATURES * (x - LEAST).square()).sum()


def rosenbrock(x: Tensor) -> Tensor:
    flat = x.flatten()
    return (100 * (flat[1:] - flat[:-1].square()).square() + (1 - flat[:-1]).square()).sum()


def optimiser(start: Tensor, memory: int = 20, worth: float = 0.0) -> QuasiNewton:
    return QuasiNewton({"x": start.clone().requires_grad_()}, same, memory, worth)


def steps(of: QuasiNewton, objective, count: int, rate: float = 1.0) -> list[float]:
    leaf, values = of._leaves["x"], []
    for _ in range(count):
        of.prepare({"x": rate})
        loss = objective(leaf)
        loss.backward()
        values.append(float(loss.detach()))
        of.apply(loss.detach())
    return values


def test_a_direction_by_enough_pairs_is_newtons():
    """Of a quadratic function of n unknowns, n independent pairs tell the second derivative."""
    matrix = torch.from_numpy(np.random.default_rng(2).normal(size=(5, 5)))
    second = matrix @ matrix.T + torch.eye(5)
    pairs, left = [], [torch.eye(5, dtype=torch.float64)[k] for k in range(5)]
    for way in left:  # conjugate steps: the pairs do not disturb each other
        for s, y in pairs:
            way = way - float(way @ y) / float(s @ y) * s
        pairs.append((way, second @ way))
    gradient = torch.arange(1.0, 6.0, dtype=torch.float64)
    torch.testing.assert_close(direction(gradient, pairs, same), -torch.linalg.solve(second, gradient))


def test_a_direction_without_pairs_is_that_of_the_preconditioner_among_the_free():
    gradient, free = torch.tensor([1.0, -2.0, 3.0]), torch.tensor([1.0, 0.0, 1.0])
    torch.testing.assert_close(direction(gradient, [], lambda x: 2 * x), -2 * gradient)
    torch.testing.assert_close(direction(gradient, [], lambda x: 2 * x, free), torch.tensor([-2.0, 0.0, -6.0]))


def test_pairs_that_bend_the_wrong_way_are_left_out():
    gradient = torch.tensor([1.0, 2.0])
    bad = (torch.tensor([1.0, 0.0]), torch.tensor([-1.0, 0.0]))
    torch.testing.assert_close(direction(gradient, [bad], same), -gradient)


@pytest.mark.parametrize("objective", [quadratic, rosenbrock])
def test_the_minimum_is_found_and_accepted_values_fall(objective):
    start = torch.zeros(SHAPE, dtype=torch.float64)
    found = optimiser(start)
    steps(found, objective, 600)
    best = found.best()["x"]
    wanted = LEAST if objective is quadratic else torch.ones(SHAPE, dtype=torch.float64)
    torch.testing.assert_close(best, wanted, atol=1e-5, rtol=0)
    assert found._values == sorted(found._values, reverse=True)


def test_no_step_is_longer_than_its_bound():
    start = torch.full(SHAPE, 50.0, dtype=torch.float64)
    found, rate = optimiser(start), 0.01
    leaf = found._leaves["x"]
    for turn in range(4):
        steps(found, quadratic, 1, rate)
        bound = rate * (LONGER if turn else 1)
        assert float((leaf.detach() - found.best()["x"]).abs().max()) <= bound * (1 + 1e-12)


def test_a_fit_settles_when_steps_gain_too_little():
    patient, busy = (optimiser(torch.zeros(SHAPE, dtype=torch.float64), worth=worth) for worth in (1e-3, 1e6))
    assert not busy.settled
    for count, found in ((11, busy), (60, patient)):
        steps(found, quadratic, count)
        assert found.settled


def test_at_the_minimum_nothing_is_left_to_do():
    found = optimiser(LEAST)
    steps(found, quadratic, 1)
    assert found.settled
    assert torch.equal(found.best()["x"], LEAST)


def test_it_goes_on_from_its_state_bit_for_bit():
    start = torch.zeros(SHAPE, dtype=torch.float64)
    whole, first = optimiser(start), optimiser(start)
    steps(whole, rosenbrock, 25)
    steps(first, rosenbrock, 12)
    second = optimiser(first._leaves["x"].detach())
    second.load(first.state_dict())
    steps(second, rosenbrock, 13)
    assert torch.equal(second.best()["x"], whole.best()["x"])
    assert torch.equal(second._leaves["x"], whole._leaves["x"])


def test_what_it_cannot_do_is_said():
    leaves = {name: torch.zeros(2, requires_grad=True) for name in "ab"}
    with pytest.raises(InputError, match="moves one parameter, but a, b are free"):
        QuasiNewton(leaves, same, 5, 0.0)
    assert optimiser(LEAST).best() is None
    with pytest.raises(InputError, match="no number"):
        steps(optimiser(LEAST), lambda x: (x * float("nan")).sum(), 1)


def test_a_step_looks_at_its_frames_some_at_a_time():
    schedule = Schedule(views_at_once=3)
    batches = Batches(7, schedule, torch.device("cpu"), torch.Generator(), None)
    whole = batches.draw(0, 0.0)
    found = list(batches.parts(whole))
    indices = [part.index for part, _ in found]
    assert [None if one is None else one.tolist() for one in indices] == [[0, 1, 2], [3, 4, 5], [6]]
    assert [share for _, share in found] == pytest.approx([3 / 7, 3 / 7, 1 / 7])
    few = replace(whole, index=torch.tensor([5, 1]))
    assert [part for part, _ in batches.parts(few)] == [few]
    every = Batches(7, Schedule(), torch.device("cpu"), torch.Generator(), None)
    assert [(part, share) for part, share in every.parts(whole)] == [(whole, 1.0)]
    assert isinstance(whole, Batch)


def test_where_the_objective_bends_down_steps_are_as_long_as_the_rate():
    """Far from its minimum log(1 + x²) has a second derivative below zero, and its slope falls with the distance."""
    of = optimiser(torch.tensor([40.0], dtype=torch.float64))
    values = steps(of, lambda x: (1 + x.square()).log().sum(), 60)
    assert values[30] < values[0] - 1
    assert values[-1] < 1e-9
