"""Density control: growth and pruning keep mass, place and moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.fit_balls import MATERIAL, PIXEL, SHAPE, a_cloud, fit_of, run
from holosplat.fit.density import DensityControl, GradientRecord, control_density, doomed, outside
from holosplat.fit.trainable import Trainable
from holosplat.geometry import Views, rotation_y
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.scan import Scan


def trained(cloud: GaussianCloud, scan: Scan, steps: int = 3) -> tuple[Trainable, GradientRecord]:
    """A cloud under optimisation with some history, and its position gradients."""
    fit = fit_of(scan, cloud=cloud, steps=steps, density=DensityControl(every=10 * steps))
    run(fit)
    return fit.trainable, fit.gradients


def moments(trainable: Trainable) -> dict[str, list[Tensor]]:
    """Copies of Adam's moments of every parameter."""
    states = trainable.state_dict()["moments"]
    return {name: [state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step")}


GROW_ONLY = DensityControl(every=1, grow_fraction=0.2, faint=0.0, huge_px=1e9, needle=1e9)


@pytest.mark.parametrize("limit", [1e9, 0.0])
def test_cloning_and_splitting_conserve_mass_and_place(scan, limit):
    """`limit` on the scale decides which of the two happens."""
    trainable, record = trained(a_cloud(), scan)
    before = trainable.cloud.detached()
    largest = set(torch.topk(record.total, 20).indices.tolist())
    options = replace(GROW_ONLY, split_scale_px=limit)
    added, removed = control_density(trainable, record, scan.views, options, torch.Generator().manual_seed(1))
    cloud = trainable.cloud.detached()
    assert (added, removed, len(cloud)) == (20, 0, 120)
    kept = [i for i in range(100) if i not in largest]
    for old, new in zip(before.parameters, cloud.parameters):
        assert torch.equal(old[kept], new[:80])
    parents = sorted(largest)
    for half in (slice(80, 100), slice(100, 120)):
        np.testing.assert_allclose(cloud.masses()[half], before.masses()[parents] / 2, rtol=1e-4)
        np.testing.assert_allclose(cloud.scales[half], before.scales[parents] / (1 if limit else 1.6), rtol=1e-5)
        assert torch.equal(cloud.quaternions[half], before.quaternions[parents])
    np.testing.assert_allclose((cloud.centres[80:100] + cloud.centres[100:]) / 2, before.centres[parents], atol=1e-5)
    apart = (cloud.centres[80:100] - cloud.centres[100:]).norm(dim=1)
    np.testing.assert_allclose(apart, before.scales[parents].mean(dim=1), rtol=0.1)  # half a deviation to each side
    assert record.total is None


def test_children_of_a_turned_needle_lie_along_it(scan):
    """Offsets are in the Gaussian's own axes."""
    parameters = [p[:40].clone() for p in a_cloud().parameters]
    parameters[0][:] = 0
    parameters[1][:] = torch.tensor([4.0, 0.05, 0.05]).log()
    parameters[2][:] = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5])  # 90° about z: the long axis is y
    trainable = Trainable(a_cloud().replaced(parameters))
    record = GradientRecord()
    record.add(torch.ones(40, 3))
    control_density(trainable, record, scan.views, replace(GROW_ONLY, grow_fraction=1.0), torch.Generator())
    offset = (trainable.cloud.centres[:40] - trainable.cloud.centres[40:]).detach().abs().mean(0)
    assert float(offset[1]) > 10 * float(offset[0] + offset[2])


def test_growth_stops_at_the_largest_count(scan):
    trainable, record = trained(a_cloud(), scan)
    for wanted in (107, 107):
        control_density(trainable, record, scan.views, replace(GROW_ONLY, max_count=107), torch.Generator())
        assert len(trainable.cloud) == wanted
        record.add(torch.ones(len(trainable.cloud), 3))


def test_moments_follow_their_gaussians(scan):
    """Resizing keeps the moments of kept Gaussians, starts new ones at zero, and keeps the step count."""
    trainable, record = trained(a_cloud(), scan)
    before, largest = moments(trainable), torch.topk(record.total, 20).indices.tolist()
    kept = [i for i in range(100) if i not in largest]
    control_density(trainable, record, scan.views, GROW_ONLY, torch.Generator())
    after = moments(trainable)
    for name in ("exp_avg", "exp_avg_sq"):
        for old, new in zip(before[name], after[name]):
            assert torch.equal(new[:80], old[kept])
            assert len(new) == 120
            assert not new[80:].any()
    assert all(float(step) == 3 for step in after["step"])
    assert all(p.is_leaf and p.requires_grad for p in trainable.cloud.parameters)


def test_resize_is_the_only_way_to_another_count(scan, monkeypatch):
    """Without it the count never changes; with it every change of the count is a call."""
    density = DensityControl(every=2, start=0, stop=1, grow_fraction=0.1, faint=0.02)
    sizes, resize = [], Trainable.resize
    monkeypatch.setattr(Trainable, "resize", lambda self, *args: None)
    assert {r["count"] for r in run(fit_of(scan, density=density, steps=6))} == {100}

    def counted(self, *args):
        sizes.append(len(self.cloud))
        resize(self, *args)
        sizes.append(len(self.cloud))

    monkeypatch.setattr(Trainable, "resize", counted)
    counts = [r["count"] for r in run(fit_of(scan, density=density, steps=6))]
    assert len(set(counts)) > 1
    assert sizes[0] == 100
    assert sizes[-1] == counts[-1]
    assert sizes[1:-1:2] == sizes[2::2]  # nothing changed the count between two calls


def test_events_take_place_when_due(scan):
    options = DensityControl(every=3, start=0.25, stop=0.75)
    assert [step + 1 for step in range(24) if options.due(step, 24)] == [6, 9, 12, 15, 18]
    assert not any(DensityControl(every=0).due(step, 24) for step in range(24))
    density = replace(GROW_ONLY, every=3, start=0.25, stop=0.75, grow_fraction=0.1)
    counts = [100] + [record["count"] for record in run(fit_of(scan, density=density, steps=12))]
    assert [step for step in range(1, 13) if counts[step] != counts[step - 1]] == [3, 6, 9]


def test_growth_follows_the_gradients_since_the_last_event(scan, monkeypatch):
    """The record sums the norms of the position gradients of every step, and is cleared by an event."""
    fit = fit_of(scan, density=replace(GROW_ONLY, every=3, start=0, stop=1), steps=6)
    norms, apply = [], Trainable.apply

    def spy(self):
        norms.append(self.cloud.centres.grad.norm(dim=1).clone())
        apply(self)

    monkeypatch.setattr(Trainable, "apply", spy)
    run(fit, until=2)
    assert torch.equal(fit.gradients.total, norms[0] + norms[1])
    run(fit, until=3)
    assert fit.gradients.total is None
    run(fit, until=4)
    assert torch.equal(fit.gradients.total, norms[3])


def spoilt_cloud(defect: str) -> GaussianCloud:
    """Five good Gaussians, of which number 2 gets one defect."""
    centres = torch.tensor([[0.0, 0, 0], [3, 2, 1], [-2, 1, 4], [5, -6, 2], [1, 1, 9]])
    log_scales, raw = torch.zeros(5, 3), raw_of(torch.full((5, 1), 0.5))
    quaternions = torch.tensor([1.0, 0, 0, 0]).repeat(5, 1)
    if defect == "faint":
        raw[2] = raw_of(torch.tensor([0.004]))
    elif defect == "huge":
        log_scales[2] = np.log(9.0)
    elif defect == "needle":
        log_scales[2] = torch.tensor([4.0, 0.5, 3.0]).log()
    elif defect == "outside":
        centres[2] = torch.tensor([1.0, 10.5, 0])  # beyond the last row: y ends at 10 pixels
    elif defect in PARAMETERS:
        (centres, log_scales, quaternions, raw)[PARAMETERS.index(defect)][2, 0] = float("nan")
    return GaussianCloud((centres, log_scales, quaternions, raw), PIXEL, *MATERIAL)


PRUNING = DensityControl(every=1, grow_fraction=0.0, faint=0.01, huge_px=8.0, needle=7.0)


@pytest.mark.parametrize("defect", ["none", "faint", "huge", "needle", "outside", *PARAMETERS])
def test_only_the_bad_gaussian_goes(scan, defect):
    cloud = spoilt_cloud(defect)
    bad = [2] if defect != "none" else []
    assert torch.nonzero(doomed(cloud, scan.views, PRUNING)).flatten().tolist() == bad
    trainable = Trainable(cloud)
    added, removed = control_density(trainable, GradientRecord(), scan.views, PRUNING, torch.Generator())
    assert (added, removed) == (0, len(bad))
    kept = [i for i in range(5) if i not in bad]
    assert torch.equal(trainable.cloud.centres, cloud.centres[kept])


def test_two_channels_are_faint_only_together(scan):
    raw = raw_of(torch.tensor([[0.5, 0.5], [0.004, 0.5], [0.5, 0.004], [0.004, 0.004], [0.5, 0.5]]))
    cloud = GaussianCloud((*spoilt_cloud("none").parameters[:3], raw), PIXEL, *MATERIAL)
    assert doomed(cloud, scan.views, PRUNING).tolist() == [False, False, False, True, False]


def test_a_cloud_is_never_emptied(scan):
    trainable = Trainable(a_cloud(10))
    nothing_is_good_enough = replace(PRUNING, faint=1e9)
    control_density(trainable, GradientRecord(), scan.views, nothing_is_good_enough, torch.Generator())
    assert len(trainable.cloud) == 10


def test_a_gaussian_that_one_view_sees_is_inside():
    """Also with detector shifts and an angle: at 90° the detector's x is the object's -z."""
    views = Views(rotation_y([0, 90]), PIXEL * np.array([[0, 0], [20, 3]]), SHAPE, PIXEL)
    centres = torch.tensor([[11.9, 9.9, 0], [12.1, 0, 0], [50, 0, 20.0], [50, 0, -20.0], [50, 0, -7], [50, -8, -20]])
    cloud = spoilt_cloud("none")
    parameters = (centres, torch.zeros(6, 3), cloud.quaternions[:1].repeat(6, 1), cloud.raw_amplitudes[:1].repeat(6, 1))
    at_right_angles = views.rotations[1] @ np.array([0, 0, 1.0])
    sees = np.sign(at_right_angles[0])
    found = outside(cloud.replaced(parameters), views).tolist()
    assert found == [False, True, sees < 0, sees > 0, True, True]
