"""Adam over named parameters, and a model under optimisation: groups, saved states, and other numbers of rows."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.checks import InputError
from holosplat.fit.optimiser import EPSILON, Adam, Group, Leaves, Trainable
from holosplat.fit.problem import Problem
from holosplat.fit.projected_gradient import ProjectedGradient
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.model import Alignment, Instrument, Model
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS
from holosplat.scan import Exposures

NAMES = [f"object.{name}" for name in PARAMETERS]
RATES = dict(zip(NAMES, (0.02, 0.01, 0.003, 0.05)))
NO_LOSS = torch.zeros(())


def a_model(count: int = 12, aligned: bool = False) -> Model:
    """A random cloud in two views, whose detector shifts are unknown if they are `aligned`."""
    generator = torch.Generator().manual_seed(2)
    parameters = [torch.randn(count, width, generator=generator) for width in (3, 3, 4, 1)]
    exposures = Exposures.of(Views.evenly_spaced(2, (5, 7), 1e-6), 20.0, 0.02)
    alignment = Alignment.planned(2, "shifts") if aligned else None
    return Model(GaussianCloud(parameters, 1e-6, Matter.one(1e-7, 1e-9)), Instrument(exposures), alignment)


def a_trainable(count: int = 12, free: tuple[str, ...] | None = None, aligned: bool = False) -> Trainable:
    return Trainable(Problem(a_model(count, aligned), (), free), lambda leaves: Adam(leaves, "cpu"))


def draw_gradients(leaves: Leaves, step: int) -> None:
    """The gradients of a step, the same for all leaves of one name and shape."""
    generator = torch.Generator().manual_seed(step)
    for leaf in leaves.values():
        leaf.grad = torch.randn(leaf.shape, generator=generator).to(leaf.dtype)


def advance(trainable: Trainable, steps: int, start: int = 0, rates: Mapping[str, float] = RATES) -> None:
    for count in range(start, start + steps):
        trainable.optimiser.prepare(rates)
        draw_gradients(trainable.leaves, count)
        trainable.optimiser.apply(NO_LOSS)


def same(a: Trainable, b: Trainable) -> bool:
    return a.leaves.keys() == b.leaves.keys() and all(torch.equal(p, b.leaves[name]) for name, p in a.leaves.items())


def through_a_file(state: dict) -> dict:
    """The state as a checkpoint gives it back."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


# --- a model under optimisation -----------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [0, 1, 4])
def test_a_saved_state_goes_on_bit_for_bit(stop):
    whole, first, second = a_trainable(), a_trainable(), a_trainable(5)
    advance(whole, 7)
    advance(first, stop)
    second.load(through_a_file(first.state_dict()))
    for trainable in (first, second):
        advance(trainable, 7 - stop, start=stop)
        assert same(trainable, whole)
        assert trainable.state_dict()["optimiser"]["count"] == 7


def test_a_saved_state_is_by_name():
    state = a_trainable().state_dict()
    assert list(state["parameters"]) == list(state["optimiser"]["first"]) == list(state["optimiser"]["second"]) == NAMES


def test_a_parameter_without_gradient_stays_and_keeps_its_moments():
    trainable = a_trainable()
    advance(trainable, 2)
    before, saved = trainable.snapshot(), trainable.optimiser.state_dict()
    trainable.optimiser.prepare(RATES)
    trainable.leaves["object.quaternions"].grad = torch.ones(12, 4)
    trainable.optimiser.apply(NO_LOSS)
    moved = [not torch.equal(p, before[name]) for name, p in trainable.leaves.items()]
    assert moved == [False, False, True, False]
    after = trainable.optimiser.state_dict()
    for moment in ("first", "second"):
        assert [not torch.equal(m, saved[moment][name]) for name, m in after[moment].items()] == moved
    assert all(p.grad is None for p in trainable.leaves.values())
    advance(trainable, 1)
    assert all(bool(torch.isfinite(p).all()) for p in trainable.leaves.values())


def test_a_parameter_without_a_rate_stays():
    trainable = a_trainable()
    before = trainable.snapshot()
    advance(trainable, 1, rates={"object.quaternions": 0.1})
    assert [name for name in NAMES if not torch.equal(trainable.leaves[name], before[name])] == ["object.quaternions"]


def test_only_free_parameters_are_fitted():
    """The others are the model's own tensors, and take no gradients."""
    trainable = a_trainable(free=("object.centres", "alignment.shifts"), aligned=True)
    assert list(trainable.leaves) == ["object.centres", "alignment.shifts"]
    parameters = trainable.model.parameters()
    assert [name for name, p in parameters.items() if p.requires_grad] == ["object.centres", "alignment.shifts"]
    assert all(parameters[name] is trainable.leaves[name] for name in trainable.leaves)
    advance(trainable, 1, rates=dict.fromkeys(trainable.leaves, 0.1))
    start = a_model(aligned=True).parameters()
    moved = [name for name, p in trainable.model.parameters().items() if not torch.equal(p, start[name])]
    assert moved == ["object.centres", "alignment.shifts"]


def test_resizing_one_part_leaves_the_others():
    """Kept rows keep values and moments, new ones have none; the alignment is as it was; the next step moves all."""
    trainable = a_trainable(aligned=True)
    rates = {**RATES, "alignment.shifts": 0.1}
    advance(trainable, 3, rates=rates)
    values, moments = trainable.snapshot(), trainable.optimiser.state_dict()
    keep = torch.tensor([7, 0, 3])
    added = {name: torch.full((2, p.shape[1]), 0.5) for name, p in a_model().object.parameters().items()}
    trainable.resize("object", keep, added)
    state = trainable.optimiser.state_dict()
    for name in NAMES:
        assert torch.equal(trainable.leaves[name][:3], values[name][keep])
        assert bool((trainable.leaves[name][3:] == 0.5).all())
        for moment in ("first", "second"):
            assert torch.equal(state[moment][name][:3], moments[moment][name][keep])
            assert not state[moment][name][3:].any()
        assert trainable.model.parameters()[name] is trainable.leaves[name]
    assert torch.equal(trainable.leaves["alignment.shifts"], values["alignment.shifts"])
    assert torch.equal(state["first"]["alignment.shifts"], moments["first"]["alignment.shifts"])
    assert state["count"] == 3
    before = trainable.snapshot()
    advance(trainable, 1, start=3, rates=rates)
    assert all(not torch.equal(p, before[name]) for name, p in trainable.leaves.items())


def test_an_unknown_name_is_refused():
    with pytest.raises(InputError, match=r"free must be names of object.centres, .*, but it has object.colours"):
        a_trainable(free=("object.colours",))


# --- Adam ---------------------------------------------------------------------------------------------------


STARTS = {"a": (5, 3), "b": (4,), "c": (2, 3, 4)}


def starts(dtype: torch.dtype = torch.float64) -> Leaves:
    generator = torch.Generator().manual_seed(0)
    return {n: torch.randn(s, generator=generator).to(dtype).requires_grad_() for n, s in STARTS.items()}


def walked(leaves: Leaves, groups: Mapping[str, Group], rates: Mapping[str, float], backend="reference") -> Leaves:
    """Where twenty steps lead, rates falling."""
    optimiser = Adam(leaves, backend, groups)
    for step in range(20):
        optimiser.prepare({name: rate * 0.95**step for name, rate in rates.items()})
        draw_gradients(leaves, step)
        optimiser.apply(NO_LOSS)
    return leaves


def walked_by_torch(groups: list[dict], dtype: torch.dtype = torch.float64) -> Leaves:
    """The same by torch.optim.AdamW, an options' dictionary a parameter."""
    leaves = starts(dtype)
    table = [{"params": [leaf], **group} for leaf, group in zip(leaves.values(), groups)]
    optimiser = torch.optim.AdamW(table, weight_decay=0.0, eps=EPSILON)
    first = [group["lr"] for group in optimiser.param_groups]
    for step in range(20):
        for group, rate in zip(optimiser.param_groups, first):
            group["lr"] = rate * 0.95**step
        draw_gradients(leaves, step)
        optimiser.step()
    return leaves


def assert_there(found: Leaves, wanted: Leaves, tolerance: float) -> None:
    """All leaves are within `tolerance`, relative to how far they went."""
    for name, start in starts(found["a"].dtype).items():
        way = float((wanted[name] - start).detach().abs().max())
        assert way > 0.1
        assert float((found[name] - wanted[name]).detach().abs().max()) < tolerance * way, name


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-7), (torch.float32, 1e-5)])
def test_groups_are_those_of_adamw(dtype, tolerance):
    """Betas, epsilon and decay of one parameter, decay of another, the default of the third; each at its own rate."""
    rates = {"a": 0.05, "b": 0.3, "c": 0.02}
    groups = {"a": Group((0.8, 0.9), 1e-3, 0.5), "b": Group(decay=0.1)}
    wanted = walked_by_torch(
        [
            {"lr": 0.05, "betas": (0.8, 0.9), "eps": 1e-3, "weight_decay": 0.5},
            {"lr": 0.3, "weight_decay": 0.1},
            {"lr": 0.02},
        ],
        dtype,
    )
    backend = "cpu" if dtype == torch.float32 else "reference"
    assert_there(walked(starts(dtype), groups, rates, backend), wanted, tolerance)
    for wrong in (Group((0.9, 0.8), 1e-3, 0.5), Group((0.8, 0.9), 1e-2, 0.5), Group((0.8, 0.9), 1e-3, 0.4)):
        with pytest.raises(AssertionError):
            assert_there(walked(starts(dtype), {**groups, "a": wrong}, rates, backend), wanted, tolerance)


def test_a_group_of_defaults_changes_nothing():
    rates = {"a": 0.05, "b": 0.3, "c": 0.02}
    assert_there(walked(starts(), {"b": Group()}, rates), walked(starts(), {}, rates), 1e-7)


def test_one_length_for_all_and_a_preconditioner():
    """Nicolet et al. (2021): x ← x - η S m̂ / √max v̂, the gradient taken through the solve; written out here."""
    matrix = torch.eye(5, dtype=torch.float64) + 0.3 * torch.diag(torch.ones(4, dtype=torch.float64), 1)
    group = Group((0.9, 0.99), 1e-30, solve=lambda gradient: matrix @ gradient, together=True)
    found = walked(starts(), {"a": group}, {"a": 0.05})["a"]
    wanted, leaves = starts()["a"].detach().clone(), starts()
    first, second = torch.zeros_like(wanted), 0.0
    for step in range(20):
        draw_gradients(leaves, step)
        direction = matrix @ leaves["a"].grad
        first = 0.9 * first + 0.1 * direction
        second = 0.99 * second + 0.01 * float(direction.square().max())
        length = 0.05 * 0.95**step / (1 - 0.9 ** (step + 1)) / (second / (1 - 0.99 ** (step + 1))) ** 0.5
        wanted -= length * first
    np.testing.assert_allclose(found.detach(), wanted, rtol=1e-9)


def test_states_of_groups_go_on_bit_for_bit():
    groups = {"a": Group((0.8, 0.9), solve=lambda gradient: 2 * gradient, together=True), "b": Group(decay=0.1)}
    rates = dict.fromkeys(STARTS, 0.05)

    def steps(optimiser: Adam, leaves: Leaves, numbers: range) -> None:
        for step in numbers:
            optimiser.prepare(rates)
            draw_gradients(leaves, step)
            optimiser.apply(NO_LOSS)

    whole, first = starts(torch.float32), starts(torch.float32)
    steps(Adam(whole, "cpu", groups), whole, range(6))
    half = Adam(first, "cpu", groups)
    steps(half, first, range(2))
    second = {name: leaf.detach().clone().requires_grad_() for name, leaf in first.items()}
    resumed = Adam(second, "cpu", groups)
    resumed.load(through_a_file(half.state_dict()))
    steps(resumed, second, range(2, 6))
    assert all(torch.equal(leaf, second[name]) for name, leaf in whole.items())


# --- the projected gradient ---------------------------------------------------------------------------------


def bowl(x: Tensor) -> Tensor:
    """A quadratic whose minimum lies partly out of bounds."""
    scale = torch.logspace(0, 2, 12).reshape(3, 4)
    return 0.5 * (scale * (x - torch.linspace(-0.5, 1.5, 12).reshape(3, 4)) ** 2).sum()


def descend(optimiser: ProjectedGradient, leaves: Leaves, steps: int) -> None:
    for _ in range(steps):
        loss = bowl(leaves["x"])
        loss.backward()
        optimiser.prepare({})
        optimiser.apply(loss.detach())


@pytest.mark.parametrize("stop", [1, 4, 9])
def test_a_projected_gradient_goes_on_bit_for_bit(stop):
    scale = torch.tensor([1.0, 10.0, 3.0])[:, None]
    whole = {"x": torch.full((3, 4), 0.4, requires_grad=True)}
    optimiser = ProjectedGradient(whole, 1.0, scale)
    descend(optimiser, whole, 15)
    first = {"x": torch.full((3, 4), 0.4, requires_grad=True)}
    half = ProjectedGradient(first, 1.0, scale)
    descend(half, first, stop)
    saved = through_a_file({"leaf": first["x"].detach(), "state": half.state_dict()})
    descend(half, first, 2)  # a state that was given away does not change
    second = {"x": torch.zeros(3, 4, requires_grad=True)}
    resumed = ProjectedGradient(second, 1.0, scale)
    second["x"] = saved["leaf"].requires_grad_()
    resumed.load(saved["state"])
    descend(resumed, second, 15 - stop)
    assert torch.equal(second["x"], whole["x"])
    assert torch.equal(resumed.best()["x"], optimiser.best()["x"])
    assert float(bowl(optimiser.best()["x"])) < 0.5 * float(bowl(torch.full((3, 4), 0.4)))


def test_bounds_are_in_units_of_the_scale():
    leaves = {"x": torch.full((3, 4), 0.4, requires_grad=True)}
    scale = torch.tensor([1.0, 10.0, 3.0])[:, None]
    optimiser = ProjectedGradient(leaves, 1.0, scale)
    for _ in range(20):
        loss = -leaves["x"].sum()
        loss.backward()
        optimiser.apply(loss.detach())
    np.testing.assert_allclose(optimiser.best()["x"], scale.expand(3, 4), rtol=1e-6)
