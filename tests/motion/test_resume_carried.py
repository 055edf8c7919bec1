"""Matter in motion that is cut off after a step goes on as if nothing had happened."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.fading_lumps import EVEN
from helpers.kept import Kept
from holosplat.checks import InputError
from holosplat.fit.run import Run
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import SmoothVolume, Task
from holosplat.motion.flow_reconstruction import FlowOptions, FlowResult, FlowSearch
from holosplat.scan import Exposures, Scan
from holosplat_bench.specimens.carried import stirred_blob

MATTER = DeltaBeta(8e-7, 8e-10)
QUICK = FlowOptions(
    volume=SmoothVolume(coarser=(), rounds=1, iterations=3), cells=2, most_degree=1, most_cells=3, steps=2,
    iterations=2, final=2, most_final=4, spacing_px=2.0, approximate_steps=3,
)  # fmt: skip


@pytest.fixture(scope="module")
def scan() -> Scan:
    scene = stirred_blob(14e-6, MATTER, 1, turn=0.6)
    views = hs.Views.from_angles(np.array([0.0, 60.0, 110.0]), (19, 23), 1e-6)
    exposures = Exposures.of(views, 20.0, 0.1).repeated(np.linspace(0.0, 1.0, 4))
    return hs.simulate(scene, exposures, photons_per_pixel=800.0, seed=1, is_test=np.zeros(len(exposures), dtype=bool))


def found(scan: Scan, journal: Kept) -> FlowResult:
    search = FlowSearch(Task(scan, MaterialPrior.known(MATTER), 2, light=EVEN), MATTER, QUICK, Run(journal))
    return search.solve()


@pytest.fixture(scope="module")
def whole(scan) -> tuple[Kept, FlowResult]:
    """A run that nothing cuts off."""
    return (kept := Kept()), found(scan, kept)


def test_every_step_is_kept_and_gone_on_from(scan, whole):
    """Bit for bit, with the same history, from any of them; what is done is not done again."""
    whole, result = whole
    names = [state["steps"] for state in whole.states]
    assert names == list(range(1, len(names) + 1))
    assert len(names) >= 6  # the start, two windows, a degree, cells, all times, fine voxels
    for cut in (2, len(names) - 2, len(names)):
        again = found(scan, rest := Kept(whole.states[:cut]))
        assert len(rest.states) == len(names)
        assert torch.equal(again.volume.values, result.volume.values)
        for name, tensor in again.flow.parameters().items():
            assert torch.equal(tensor, result.flow.parameters()[name])
        assert again.history == result.history
        assert again.misfit == result.misfit


def test_a_checkpoint_of_an_older_version_is_gone_on_from(scan, whole):
    """It has the state of the last step beside its number, and no table of steps."""
    whole, result = whole
    kept = whole.states[2]
    older = {name: value for name, value in kept.items() if name not in ("stage_steps", "fit")}
    again = found(scan, rest := Kept([older | kept["stage_steps"][-1]]))
    assert len(rest.states) == len(whole.states) - 2
    assert torch.equal(again.volume.values, result.volume.values)


def test_a_damaged_state_is_named(scan):
    with pytest.raises(InputError, match=r"checkpoint\.pt"):
        found(scan, Kept([{"steps": 1}]))
