"""What runs of the tests share (`helpers.once`) is what the program computes, and nothing of other frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.contract import two_balls
from helpers.once import Once, of, once
from holosplat.baselines import HolographicTV
from holosplat.fit.problem import Schedule
from holosplat.matter import MaterialPrior
from holosplat.methods import FitOptions, Gaussians, Task
from holosplat.methods.solve import solve

pytestmark = pytest.mark.usefixtures("unjudged_runs")

QUICK = Gaussians(
    spacing_px=2.0,
    approximate_steps=1,
    volume=HolographicTV(retrieval=8, iterations=8, corrections=1, inner=4, refine=1),
    fit=FitOptions(schedule=Schedule(steps=0)),
)


def test_an_answer_is_given_again_with_its_progress():
    memory, told, computed = Once(), [], []

    def compute(progress):
        computed.append(1)
        progress("stage", 0.25)
        return len(computed)

    answers = [memory.answer((key,), compute, lambda *step: told.append(step)) for key in ("a", "b", "a")]
    assert answers == [1, 2, 1]
    assert told == 3 * [("stage", 0.25)]

    def fail(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        memory.answer(("c",), fail, print)
    assert memory.answer(("c",), compute, lambda *step: None) == 3


def test_runs_that_share_are_as_runs_that_do_not():
    """Bit for bit: it also says that all that is shared comes out the same when it is computed again."""
    scan, memory = two_balls().train(), Once()
    task = Task(scan, MaterialPrior.unknown())
    alone = solve(QUICK, task)
    with once(memory):
        first, again = solve(QUICK, task), solve(QUICK, task)
    assert {key[0] for key in memory.made} == {"delta", "kind", "level", "light", "ratio", "sides", "sign", "volume"}
    for name, value in alone.parameters().items():
        assert torch.equal(first.parameters()[name], value)
        assert torch.equal(again.parameters()[name], value)


@pytest.mark.parametrize(
    "change",
    [
        lambda s: replace(s, frames=s.frames[:, ::-1].copy()),
        lambda s: replace(s, exposures=replace(s.exposures, distance=1.01 * s.exposures.distance)),
        lambda s: s[np.array([1, 0, 2, 3, 4, 5])],
    ],
    ids=["frames", "distance", "order"],
)
def test_other_frames_are_others(change):
    scan = two_balls().train()
    assert of(change(scan)) != of(scan)
