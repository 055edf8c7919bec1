"""Density control: growth and pruning keep mass, place and moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.fit_balls import MATERIAL, PIXEL, SHAPE, a_cloud, a_scan, fit_of, run
from holosplat.fit.density import CENTRES, DensityControl, DensityEvent, doomed, outside
from holosplat.fit.loop import Fit
from holosplat.fit.optimiser import Adam, Trainable
from holosplat.geometry import Views, rotation_y
from holosplat.matter import Matter
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.scan import Scan


def event_of(fit: Fit) -> DensityEvent:
    """The fit's density control."""
    (event,) = fit.plan.events
    assert isinstance(event, DensityEvent)
    return event


def trained(cloud: GaussianCloud, scan: Scan, steps: int = 3) -> tuple[Trainable, Tensor]:
    """A cloud under optimisation with some history, and its position gradients."""
    fit = fit_of(scan, cloud=cloud, steps=steps, density=DensityControl(every=10 * steps))
    run(fit)
    total = event_of(fit).total
    assert total is not None
    return fit.trainable, total


def of(trainable: Trainable) -> GaussianCloud:
    """The cloud under optimisation."""
    assert isinstance(trainable.model.object, GaussianCloud)
    return trainable.model.object


def untrained(cloud: GaussianCloud) -> Trainable:
    """A cloud under optimisation, at its start."""
    return fit_of(a_scan(), cloud=cloud).trainable


def event(options: DensityControl, views: Views, total: Tensor | None = None) -> DensityEvent:
    """Density control after gradients that add up to `total`."""
    made = DensityEvent(options, views)
    made.total = total
    return made


GROW_ONLY = DensityControl(every=1, grow_fraction=0.2, faint=0.0, huge_px=1e9, needle=1e9)


@pytest.mark.parametrize("limit", [1e9, 0.0])
def test_cloning_and_splitting_conserve_mass_and_place(scan, limit):
    """`limit` on the scale decides which of the two happens."""
    trainable, total = trained(a_cloud(), scan)
    before = of(trainable).detached()
    largest = set(torch.topk(total, 20).indices.tolist())
    control = event(replace(GROW_ONLY, split_scale_px=limit), scan.views, total)
    added, removed = control.control(trainable, torch.Generator().manual_seed(1))
    cloud = of(trainable).detached()
    assert (added, removed, len(cloud)) == (20, 0, 120)
    kept = [i for i in range(100) if i not in largest]
    for name, old in before.parameters().items():
        assert torch.equal(old[kept], cloud.parameters()[name][:80])
    parents = sorted(largest)
    for half in (slice(80, 100), slice(100, 120)):
        np.testing.assert_allclose(cloud.masses()[half], before.masses()[parents] / 2, rtol=1e-4)
        np.testing.assert_allclose(cloud.scales[half], before.scales[parents] / (1 if limit else 1.6), rtol=1e-5)
        assert torch.equal(cloud.quaternions[half], before.quaternions[parents])
    np.testing.assert_allclose((cloud.centres[80:100] + cloud.centres[100:]) / 2, before.centres[parents], atol=1e-5)
    apart = (cloud.centres[80:100] - cloud.centres[100:]).norm(dim=1)
    np.testing.assert_allclose(apart, before.scales[parents].mean(dim=1), rtol=0.1)  # half a deviation to each side
    assert control.total is None


def test_children_of_a_turned_needle_lie_along_it(scan):
    """Offsets are in the Gaussian's own axes."""
    parameters = [p[:40].clone() for p in a_cloud().parameters().values()]
    parameters[0][:] = 0
    parameters[1][:] = torch.tensor([4.0, 0.05, 0.05]).log()
    parameters[2][:] = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5])  # 90° about z: the long axis is y
    trainable = untrained(a_cloud().replaced(parameters))
    event(replace(GROW_ONLY, grow_fraction=1.0), scan.views, torch.ones(40)).control(trainable, torch.Generator())
    centres = of(trainable).centres.detach()
    offset = (centres[:40] - centres[40:]).abs().mean(0)
    assert float(offset[1]) > 10 * float(offset[0] + offset[2])


def test_growth_stops_at_the_largest_count(scan):
    trainable, total = trained(a_cloud(), scan)
    for wanted in (107, 107):
        event(replace(GROW_ONLY, max_count=107), scan.views, total).control(trainable, torch.Generator())
        assert len(of(trainable)) == wanted
        total = torch.ones(wanted)


def test_moments_follow_their_gaussians(scan):
    """Resizing keeps the moments of kept Gaussians, starts new ones at zero, and keeps the step count."""
    trainable, total = trained(a_cloud(), scan)
    before, largest = trainable.optimiser.state_dict(), torch.topk(total, 20).indices.tolist()
    kept = [i for i in range(100) if i not in largest]
    event(GROW_ONLY, scan.views, total).control(trainable, torch.Generator())
    after = trainable.optimiser.state_dict()
    for moment in ("first", "second"):
        assert set(after[moment]) == {f"object.{name}" for name in PARAMETERS}
        for name, new in after[moment].items():
            assert torch.equal(new[:80], before[moment][name][kept])
            assert len(new) == 120
            assert before[moment][name].any()
            assert not new[80:].any()
    assert after["count"] == 3
    assert all(p.is_leaf and p.requires_grad for p in of(trainable).parameters().values())


def test_resize_is_the_only_way_to_another_count(scan, monkeypatch):
    """Without it the count never changes; with it every change of the count is a call."""
    density = DensityControl(every=2, start=0, stop=1, grow_fraction=0.1, faint=0.02)
    sizes, resize = [], Trainable.resize
    monkeypatch.setattr(Trainable, "resize", lambda self, *args: None)
    assert {r["count"] for r in run(fit_of(scan, density=density, steps=6))} == {100}

    def counted(self, *args):
        sizes.append(len(of(self)))
        resize(self, *args)
        sizes.append(len(of(self)))

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
    longer = replace(options, prune_stop=1.0)
    due = {step + 1: longer.grows(step, 24) for step in range(24) if longer.due(step, 24)}
    assert due == {6: True, 9: True, 12: True, 15: True, 18: True, 21: False, 24: False}
    density = replace(GROW_ONLY, every=3, start=0.25, stop=0.75, grow_fraction=0.1)
    counts = [100] + [record["count"] for record in run(fit_of(scan, density=density, steps=12))]
    assert [step for step in range(1, 13) if counts[step] != counts[step - 1]] == [3, 6, 9]


def test_growth_follows_the_gradients_since_the_last_event(scan, monkeypatch):
    """The record sums the norms of the position gradients of every step, and is cleared by an event."""
    fit = fit_of(scan, density=replace(GROW_ONLY, every=3, start=0, stop=1), steps=6)
    norms, apply, control = [], Adam.apply, event_of(fit)

    def spy(self, loss):
        norms.append(self._leaves[CENTRES].grad.norm(dim=1).clone())
        apply(self, loss)

    monkeypatch.setattr(Adam, "apply", spy)
    run(fit, until=2)
    assert torch.equal(control.total, norms[0] + norms[1])
    run(fit, until=3)
    assert control.total is None
    run(fit, until=4)
    assert torch.equal(control.total, norms[3])


def test_gaussians_of_a_steep_mean_gradient_grow(scan):
    """Their number follows the gradients, whatever the share says, and the number of steps does not matter."""
    total = torch.linspace(0.0, 9.9, 100)
    for steps, most, grown in ((1, 1000, 19), (2, 1000, 0), (1, 107, 7)):
        trainable, _ = trained(a_cloud(), scan)
        before = of(trainable).detached()
        made = event(replace(GROW_ONLY, grow_gradient=8.05, max_count=most), scan.views, total)
        made.steps = steps
        assert made.control(trainable, torch.Generator().manual_seed(0)) == (grown, 0)
        assert torch.equal(of(trainable).centres.detach()[: 100 - grown], before.centres[: 100 - grown])
        assert made.steps == 0


def test_after_the_last_growth_gaussians_only_go(scan):
    trainable, total = trained(a_cloud(), scan)
    options = DensityControl(every=1, start=0, stop=0.5, prune_stop=1.0, grow_fraction=0.2, faint=0.02, huge_px=1e9)
    faint = int(doomed(of(trainable), scan.views, options).count_nonzero())
    made = event(options, scan.views, total)
    assert made.after_step(trainable, 6, 10, torch.Generator())
    assert len(of(trainable)) == 100 - faint
    assert not made.after_step(trainable, 10, 10, torch.Generator()), "behind the last step"


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
    return GaussianCloud((centres, log_scales, quaternions, raw), PIXEL, Matter.one(*MATERIAL))


PRUNING = DensityControl(every=1, grow_fraction=0.0, faint=0.01, huge_px=8.0, needle=7.0)


@pytest.mark.parametrize("defect", ["none", "faint", "huge", "needle", "outside", *PARAMETERS])
def test_only_the_bad_gaussian_goes(scan, defect):
    cloud = spoilt_cloud(defect)
    bad = [2] if defect != "none" else []
    assert torch.nonzero(doomed(cloud, scan.views, PRUNING)).flatten().tolist() == bad
    trainable = untrained(cloud)
    assert event(PRUNING, scan.views).control(trainable, torch.Generator()) == (0, len(bad))
    kept = [i for i in range(5) if i not in bad]
    assert torch.equal(of(trainable).centres, cloud.centres[kept])


def test_two_channels_are_faint_only_together(scan):
    raw = raw_of(torch.tensor([[0.5, 0.5], [0.004, 0.5], [0.5, 0.004], [0.004, 0.004], [0.5, 0.5]]))
    good = spoilt_cloud("none")
    cloud = good.replaced((good.centres, good.log_scales, good.quaternions, raw), Matter.free(*MATERIAL))
    assert doomed(cloud, scan.views, PRUNING).tolist() == [False, False, False, True, False]


def test_a_cloud_is_never_emptied(scan):
    trainable = untrained(a_cloud(10))
    nothing_is_good_enough = replace(PRUNING, faint=1e9)
    event(nothing_is_good_enough, scan.views).control(trainable, torch.Generator())
    assert len(of(trainable)) == 10


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
