"""Adam over a few arrays at once: the compiled kernel, the plain form, and torch's own, step for step."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat import native
from holosplat.checks import InputError
from holosplat.fit import adam

RATES = (0.02, 0.01, 0.003, 0.05)
EPSILON = 1e-12
TOLERANCE = 1e-5
"""Of where the parameters went, over how far."""

State = list[list[Tensor]]
"""Parameters, first and second moments."""


def a_start(lengths: tuple[int, ...] = (301, 17, 40000, 1), dtype: torch.dtype = torch.float32) -> State:
    """Arrays of odd lengths (one longer than a thread's share), without history."""
    generator = torch.Generator().manual_seed(0)
    parameters = [0.1 * torch.randn(n, generator=generator).to(dtype) for n in lengths]
    return [parameters, *([torch.zeros_like(p) for p in parameters] for _ in range(2))]


def gradients_at(parameters: list[Tensor], step: int) -> list[Tensor]:
    """Noisy gradients of a bowl, of magnitudes from 1e-9 to 1e3; some are zero throughout."""
    generator = torch.Generator().manual_seed(step)
    found = []
    for p in parameters:
        scale = 10 ** torch.linspace(-9, 3, len(p))
        noisy = scale * (p.detach() + torch.randn(len(p), generator=generator))
        found.append((noisy * (torch.arange(len(p)) % 7 != 3)).to(p.dtype))
    return found


def walked(backend: str, steps: int = 50, dtype: torch.dtype = torch.float32) -> State:
    """Where `steps` steps lead, rates falling."""
    state = a_start(dtype=dtype)
    for count in range(1, steps + 1):
        factors = adam.factors([rate * 0.98**count for rate in RATES], count, EPSILON)
        adam.step(state[0], gradients_at(state[0], count), *state[1:], factors, backend)
    return state


def walked_by_torch(steps: int = 50, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    leaves = [p.clone().requires_grad_() for p in a_start(dtype=dtype)[0]]
    optimiser = torch.optim.Adam([{"params": [leaf]} for leaf in leaves], lr=0.0, eps=EPSILON, fused=True)
    for count in range(1, steps + 1):
        for leaf, gradient, group, rate in zip(leaves, gradients_at(leaves, count), optimiser.param_groups, RATES):
            leaf.grad, group["lr"] = gradient, rate * 0.98**count
        optimiser.step()
    return [leaf.detach() for leaf in leaves]


def error(found: list[Tensor], true: list[Tensor]) -> float:
    """Largest difference over the longest way, of the worst array."""
    starts = a_start(dtype=true[0].dtype)[0]
    return max(float((a - b).abs().max() / (b - start).abs().max()) for a, b, start in zip(found, true, starts))


@pytest.mark.parametrize("isa", native.available_isas())
def test_the_way_is_that_of_torch(isa, monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    found = walked("cpu")
    assert error(found[0], walked_by_torch()) < TOLERANCE
    exact = walked("reference", dtype=torch.float64)
    for array, true in zip(chain(*found), chain(*exact)):
        np.testing.assert_allclose(array, true, rtol=1e-4, atol=TOLERANCE * float(true.abs().max()))


def test_the_plain_form_is_that_of_torch():
    assert error(walked("reference", dtype=torch.float64)[0], walked_by_torch(dtype=torch.float64)) < 1e-6


@pytest.mark.parametrize("index", range(len(RATES) + 1))
def test_the_tolerance_sees_a_biased_factor(index, monkeypatch):
    true, exact = walked_by_torch(), adam.factors
    bias = torch.ones(len(RATES) + 1)
    bias[index] = 1.001 if index < len(RATES) else 1e9  # nothing sees what is added to divisors a million times larger
    monkeypatch.setattr(adam, "factors", lambda *args: exact(*args) * bias)
    assert error(walked("cpu")[0], true) > TOLERANCE


def test_the_first_step_is_as_long_as_the_rate_and_no_gradient_is_no_step():
    parameters, first, second = a_start()
    before = [p.clone() for p in parameters]
    gradients = gradients_at(parameters, 0)
    adam.step(parameters, gradients, first, second, adam.factors(RATES, 1, EPSILON))
    for new, old, gradient, rate in zip(parameters, before, gradients, RATES):
        np.testing.assert_allclose(new - old, -rate * gradient / (gradient.abs() + EPSILON), rtol=2e-3, atol=1e-6)


def test_threads_change_nothing():
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 7):
            torch.set_num_threads(threads)
            results.append(list(chain(*walked("cpu", steps=3))))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_arrays_of_any_number_and_order(backend):
    """Matrices, gradients in another memory order, empty arrays, and none at all."""
    generator = torch.Generator().manual_seed(1)
    parameters = [torch.randn(5, 3, generator=generator), torch.zeros(0, 4)]
    gradients = [torch.randn(3, 5, generator=generator).T, torch.zeros(0, 4)]
    moments = [[torch.zeros_like(p) for p in parameters] for _ in range(2)]
    wanted = parameters[0] - 0.1 * gradients[0].sign()
    adam.step(parameters, gradients, *moments, adam.factors([0.1, 0.2], 1, EPSILON), backend)
    np.testing.assert_allclose(parameters[0], wanted, rtol=1e-5)
    adam.step([], [], [], [], adam.factors([], 1, EPSILON), backend)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("count", [5, 8, 13])
def test_many_arrays_at_once_move_as_one_by_one(count, backend):
    """Bit for bit, each at its own rate."""
    lengths = tuple(3 + 41 * k % 97 for k in range(count))
    together, alone = a_start(lengths), a_start(lengths)
    rates = [0.01 * (k + 1) for k in range(count)]
    for step in (1, 2, 3):
        gradients = gradients_at(together[0], step)
        adam.step(together[0], gradients, *together[1:], adam.factors(rates, step, EPSILON), backend)
        for k, rate in enumerate(rates):
            one = [[group[k]] for group in (alone[0], gradients, *alone[1:])]
            adam.step(*one, adam.factors([rate], step, EPSILON), backend)
    assert all(torch.equal(a, b) for a, b in zip(chain(*together), chain(*alone)))
    assert all(not torch.equal(a, b) for a, b in zip(together[0], a_start(lengths)[0]))


def test_arrays_that_do_not_fit_together_are_refused():
    arrays, factors = [[torch.zeros(3, 4)] for _ in range(4)], adam.factors([0.1], 1, EPSILON)
    for wrong, message in (
        ([*arrays[:3], [torch.zeros(3, 5)]], "shape"),
        ([*arrays[:3], []], "one of each"),
        ([a * 5 for a in arrays], "one of each"),
        ([[torch.zeros(4, 3).T], *arrays[1:]], "contiguous"),
        ([[torch.zeros(3, 4).double()] for _ in range(4)], "float32"),
    ):
        with pytest.raises(InputError, match=message):
            adam.step(*wrong, factors)
    with pytest.raises(InputError, match="backend"):
        adam.step(*arrays, factors, "tpu")
