"""Held-out frames: which they are, and how long a fit goes on by them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.fit.flow_volume import FlowProblem
from holosplat.fit.smooth_volume import ContinuousPrior, Descent
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Task
from holosplat.motion.timed_frames import Frames, iterations_that_predict, kept_frames, others
from holosplat.representations import Flow, Lattice, TimeBasis
from holosplat.scan import Exposures
from holosplat.specimens.continuous import Bump, ContinuousScene, ellipsoid

MATTER = DeltaBeta(8e-7, 8e-10)
PIXEL, TIMES = 1e-6, np.array([0.0, 1.0])
LEFT = np.array([[False, True, False, False], [False, False, False, True]])


def test_a_share_of_the_frames_is_held_out_and_one_a_time_is_kept():
    counts = [3, 3, 2, 3, 3, 3, 4]
    keep = kept_frames(counts, 4, 1)
    assert [len(each) for each in keep] == counts
    assert sum(int(each.sum()) for each in others(keep)) == 5
    assert all(np.array_equal(*each) for each in zip(keep, kept_frames(counts, 4, 1)))
    assert not all(np.array_equal(*each) for each in zip(keep, kept_frames(counts, 4, 2)))
    assert all(each.all() for each in kept_frames([1] * 9, 2, 0))


def problems(photons: float) -> tuple[FlowProblem, FlowProblem, torch.Tensor]:
    """Matter that stands still, on 19 × 23 pixels: of kept frames, and of those held out; and a faint start."""
    parts = tuple(
        ellipsoid(c, (3e-6, 2.4e-6, 2.7e-6), Bump(2), MATTER) for c in [(-3e-6, -1e-6, 1e-6), (2e-6, 2e-6, -2e-6)]
    )
    views = Views.from_angles([0.0, 40.0, 80.0, 120.0], (19, 23), PIXEL)
    exposures = Exposures.of(views, 20.0, 0.1).repeated(TIMES)
    whole = np.zeros(len(exposures), dtype=bool)
    scene = ContinuousScene(parts)
    scan = hs.simulate(scene, exposures, photons_per_pixel=photons, seed=3, is_test=whole, oversample=2)
    frames = Frames.of(Task(scan, MaterialPrior.known(MATTER)), MATTER)
    flow = Flow.still(Lattice.around((23.0, 19.0, 23.0), 2), TimeBasis(0, 1, 0), 0.0, 2)
    weak = ContinuousPrior().weakened(1 / 16)
    made = [
        FlowProblem([frames.whitened(k, 1, which[k]) for k in range(2)], [0.0, 1.0], weak, 0.5, flow, 1)
        for which in (~LEFT, LEFT)
    ]
    return made[0], made[1], torch.full(Grid.of_views(scan.views).shape, 0.02)


@pytest.mark.parametrize("photons", [200.0, 1e6])
def test_the_fit_ends_where_held_out_frames_are_predicted_best(photons):
    kept, aside, begun = problems(photons)
    count, gain = iterations_that_predict(kept, aside, begun, 80)
    descent, missed = Descent(kept, begun), {}
    while descent.done < 80 and not descent.ended:
        descent.step()
        if descent.done % 10 == 0 or descent.ended:
            missed[descent.done] = sum(aside.misfit(descent.u))
    first = min(missed)
    assert gain == pytest.approx(missed[first] - missed[count])
    assert missed[count] <= min(value for done, value in missed.items() if done <= count + 30)
    assert (count < 80) == (photons < 1e3)  # noise is followed after a while, and without it nothing is


def test_no_more_iterations_than_are_allowed():
    kept, aside, begun = problems(1e6)
    assert iterations_that_predict(kept, aside, begun, 3)[0] == 3
