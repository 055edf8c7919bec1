"""The views of a fit: how they are drawn, which are detached, and those kept for validation; rates."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch

from helpers.fit_balls import HASTY, PIXEL, SHAPE, a_cloud, a_scan, cloud_of, equal, fit_of, found_by, frames_of, run
from holosplat.checks import InputError
from holosplat.fit.loop import Fit
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Schedule
from holosplat.fit.residuals import split_validation
from holosplat.fit.terms import Objective
from holosplat.fit.terms import comparisons as terms
from holosplat.geometry import Views
from holosplat.methods import GaussianRates
from holosplat.model import Instrument
from holosplat.representations import GaussianCloud
from holosplat.scan import Exposures, Scan

# --- views --------------------------------------------------------------------------------------------------


def batches(fit: Fit, monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The views of every step, as the instrument is asked for them."""
    instrument = fit.model.instrument
    seen, frames = [], instrument.frames

    def spy(lines, index=None):
        seen.append(list(range(len(instrument.views))) if index is None else index.tolist())
        return frames(lines, index)

    monkeypatch.setattr(instrument, "frames", spy)
    run(fit)
    return seen


@pytest.mark.parametrize("per_step", [0, 6, 9])
def test_all_views_are_used_where_nothing_else_is_asked(scan, monkeypatch, per_step):
    assert batches(fit_of(scan, steps=3, views_per_step=per_step), monkeypatch) == [list(range(6))] * 3


@pytest.mark.parametrize("per_step", [1, 2, 3])
def test_views_are_drawn_without_replacement_and_equally_often(scan, monkeypatch, per_step):
    drawn = batches(fit_of(scan, steps=24, views_per_step=per_step), monkeypatch)
    epoch = 6 // per_step
    for start in range(0, 24, epoch):
        assert sorted(chain.from_iterable(drawn[start : start + epoch])) == list(range(6))
    assert len({tuple(batch) for batch in drawn[::epoch]}) > 1  # the order is another in every round


@pytest.mark.parametrize("per_step", [4, 5])
def test_a_number_of_views_that_does_not_divide_draws_as_evenly(scan, monkeypatch, per_step):
    """Every step has as many different views as asked for, and after whole rounds all were used equally often."""
    drawn = batches(fit_of(scan, steps=24, views_per_step=per_step), monkeypatch)
    assert [len(set(batch)) for batch in drawn] == [per_step] * 24
    assert set(Counter(chain.from_iterable(drawn)).values()) == {24 * per_step // 6}


@pytest.mark.parametrize("ssim", [0.0, 0.5])
def test_drawn_views_are_compared_with_their_own_frames(scan, monkeypatch, ssim):
    """Pose, optics and measured frame of a step are those of one view, whichever were drawn."""
    unequal = replace(scan.exposures, distance=np.linspace(0.02, 0.08, len(scan)))
    unlike = replace(scan, exposures=unequal)
    fit = fit_of(unlike, steps=4, views_per_step=2, objective=Objective(l1=1.0, ssim=ssim))
    train, instrument = unlike.train(), fit.model.instrument
    whole = Instrument(train.exposures, instrument.oversample)
    wanted, frames = [], instrument.frames

    def spy(lines, index=None):
        predicted = frames_of(cloud_of(fit).detached(), whole, index)
        difference = (predicted - torch.from_numpy(train.frames)[index]).abs().mean()
        wanted.append(float(difference) / float(np.ptp(train.frames)))
        return frames(lines, index)

    monkeypatch.setattr(instrument, "frames", spy)
    assert [record["l1"] for record in run(fit)] == pytest.approx(wanted, rel=1e-4)


# --- rates, warm-up, detached views -------------------------------------------------------------------------


def test_rates_decay_exponentially_to_the_asked_fraction(scan, monkeypatch):
    schedule = Schedule(steps=11, decay=0.01)
    assert [schedule.factor(step, 0.0) for step in (0, 5, 10)] == pytest.approx([1.0, 0.1, 0.01])
    used, prepare = [], Adam.prepare
    monkeypatch.setattr(Adam, "prepare", lambda self, rates: (used.append(rates), prepare(self, rates)))
    rates = GaussianRates(0.3, 0.01, 0.03, 0.02)
    run(fit_of(scan, steps=11, decay=0.01, rates=rates))
    assert len(used) == 11
    first = {f"object.{name}": rate for name, rate in vars(rates).items()}
    assert used[0] == first
    assert used[5] == pytest.approx({name: 0.1 * rate for name, rate in first.items()})
    assert used[-1] == pytest.approx({name: 0.01 * rate for name, rate in first.items()})


def test_each_parameter_moves_at_its_own_rate(scan):
    """Adam's first step is as long as the rate (where there is a gradient at all)."""
    stretched = a_cloud()
    stretched.log_scales += torch.linspace(-0.5, 0.5, 3)  # round Gaussians do not feel rotations
    fit = fit_of(scan, steps=5, cloud=stretched, rates=GaussianRates(0.04, 0.03, 0.02, 0.01))
    run(fit, until=1)
    after = cloud_of(fit).detached().parameters()
    moved = [float((after[name] - p).abs().median()) for name, p in stretched.parameters().items()]
    assert moved == pytest.approx([0.04, 0.03, 0.02, 0.01], rel=0.05)


def test_warm_up_moves_amplitudes_only(scan):
    start = a_cloud()
    fit = fit_of(scan, steps=8, warmup_steps=4)
    run(fit, until=4)
    same = {name: torch.equal(p, start.parameters()[name]) for name, p in cloud_of(fit).parameters().items()}
    assert same == {"centres": True, "log_scales": True, "quaternions": True, "raw_amplitudes": False}
    run(fit, until=5)
    assert not torch.equal(cloud_of(fit).centres, start.centres)
    assert not torch.equal(cloud_of(fit).log_scales, start.log_scales)


def spoilt(scan: Scan, frames: list[int], seed: int) -> Scan:
    """The scan with some frames of noise that keeps the intensity range: their loss is by far the largest."""
    rng, train = np.random.default_rng(seed), scan.train().frames
    changed = scan.frames.copy()
    changed[frames] = rng.choice([train.min(), train.max()], (len(frames), *SHAPE))
    return replace(scan, frames=changed)


@pytest.mark.parametrize(("train", "bad"), [(5, [1, 3]), (6, [0, 2, 5])])
def test_views_above_the_median_give_no_gradient(train, bad):
    """The step does not depend on what the worst views show; without the rule it does."""
    scan = a_scan(train, 1)
    scans = [spoilt(scan, bad, seed) for seed in (1, 2)]

    def after_one_step(scan: Scan, detach: bool) -> GaussianCloud:
        fit = fit_of(scan, steps=2, detach_worst=detach)
        run(fit, until=1)
        return cloud_of(fit)

    first, second = (after_one_step(s, True) for s in scans)
    assert equal(first, second)
    assert not equal(*(after_one_step(s, False) for s in scans))
    for good in set(range(train)) - set(bad):
        changed = scans[0].frames.copy()
        changed[good] = changed[good, ::-1]
        assert not equal(after_one_step(replace(scans[0], frames=changed), True), first)


def test_one_view_alone_is_never_the_worst(scan):
    """And the record holds the loss of all views, detached or not."""
    fits = [fit_of(scan, steps=4, views_per_step=1, detach_worst=detach) for detach in (True, False)]
    assert run(fits[0]) == run(fits[1])
    both = [run(fit_of(scan, steps=1, detach_worst=detach))[0]["loss"] for detach in (True, False)]
    assert both[0] == pytest.approx(both[1], rel=1e-6)


# --- validation ---------------------------------------------------------------------------------------------


def numbered(count: int) -> Scan:
    """Frames that hold their own number."""
    frames = np.arange(count, dtype=np.float32)[:, None, None] * np.ones((1, 12, 12), np.float32)
    return Scan(frames, Exposures.of(Views.evenly_spaced(count, (12, 12), PIXEL), 20.0, 0.05), np.zeros(count, bool))


def numbers(scan: Scan) -> set[int]:
    return {int(frame[0, 0]) for frame in scan.frames}


def test_validation_frames_are_other_frames():
    """For every count: as many as asked for, spread, and none of them among the training frames."""
    for count in range(2, 15):
        for chosen in range(count):
            train, validation = split_validation(numbered(count), chosen)
            assert len(validation) == chosen
            assert numbers(train) | numbers(validation) == set(range(count))
            assert not numbers(train) & numbers(validation)
            if chosen > 1:
                gaps = np.diff(sorted(numbers(validation)))
                assert gaps.max() - gaps.min() <= 1
    with pytest.raises(InputError, match="validation_views"):
        split_validation(numbered(4), 4)


def test_a_fit_keeps_training_validation_and_test_frames_apart():
    scan = replace(numbered(12), is_test=np.arange(12) % 4 == 3)
    fit = fit_of(scan, validation_views=3)
    assert fit.plan.judge is not None
    trained, _ = split_validation(scan.train(), 3)
    np.testing.assert_array_equal(fit.model.instrument.exposures.views.rotations, trained.views.rotations)
    parts = [numbers(trained), numbers(fit.plan.judge.scan), numbers(scan.test())]
    assert [len(part) for part in parts] == [6, 3, 3]
    assert set.union(*parts) == set(range(12))


def test_validation_frames_do_not_move_the_fit(scan):
    """Whatever they show: the last state (not the best one) is the same."""
    plain = fit_of(scan, steps=5, validation_views=2, validate_every=2)
    frames = scan.frames.copy()
    trained, _ = split_validation(scan.train(), 2)
    validation = [i for i in range(6) if not (frames[i] == trained.frames).all(axis=(1, 2)).any()]
    assert len(validation) == 2
    frames[validation] = 7.0
    other = fit_of(replace(scan, frames=frames), steps=5, validation_views=2, validate_every=2)
    a, b = run(plain), run(other)
    assert equal(cloud_of(plain), cloud_of(other))
    assert a[-1]["val_l1"] != b[-1]["val_l1"]


def disagreement(record: dict[str, float]) -> float:
    """What the best state has least of: 1 - (SSIM + FRCM) / 2 of the validation views."""
    return 1 - (record["val_ssim"] + record["val_frcm"]) / 2


def test_the_best_state_by_the_validation_views_is_the_result(scan):
    fit = fit_of(scan, steps=33, validation_views=2, validate_every=4, **HASTY)
    seen: list[tuple[float, int, GaussianCloud]] = []

    def look(record: dict[str, float]) -> None:
        if "val_ssim" in record:
            seen.append((disagreement(record), fit.step, cloud_of(fit).detached()))

    fit.run(look)
    assert [step for _, step, _ in seen] == [4, 8, 12, 16, 20, 24, 28, 32, 33]
    score, step, cloud = min(seen, key=lambda look: look[0])
    assert step < 33
    assert fit.best_step == step
    assert fit.state_dict()["best"][:2] == (pytest.approx(score), step)
    assert equal(found_by(fit), cloud)
    assert not equal(found_by(fit), cloud_of(fit))


def test_validation_scores_are_those_of_the_validation_frames(scan):
    fit = fit_of(scan, steps=1, validation_views=2, validate_every=1)
    (record,) = run(fit)
    train, validation = split_validation(scan.train(), 2)
    low, high = train.frames.min(), train.frames.max()
    instrument = Instrument(validation.exposures, fit.model.instrument.oversample)
    predicted = frames_of(cloud_of(fit), instrument).numpy()
    a, b = (torch.from_numpy((frames - low) / (high - low)) for frames in (predicted, validation.frames))
    assert record["val_l1"] == pytest.approx(float(terms.l1(a, b).mean()), rel=1e-4)
    assert record["val_ssim"] == pytest.approx(1 - float(terms.one_minus_ssim(a, b).mean()), rel=1e-4)
    assert record["val_frcm"] == pytest.approx(1 - float(terms.one_minus_frcm(a, b).mean()), rel=1e-3)
    assert {"val_l1", "val_ssim", "val_frcm"} <= set(fit.columns())


def test_without_validation_the_last_state_is_the_result(scan):
    fit = fit_of(scan, steps=3)
    assert not any(name.startswith("val_") for record in run(fit) for name in record)
    assert equal(found_by(fit), cloud_of(fit))


def test_a_fit_that_gets_no_better_stops_early(scan):
    patience, every = 2, 3
    fit = fit_of(scan, steps=400, validation_views=2, validate_every=every, patience=patience, **HASTY)
    looks = [disagreement(r) for r in run(fit) if "val_ssim" in r]
    assert fit.stopped_early
    assert fit.finished
    assert patience <= fit.step / every - (np.argmin(looks) + 1) <= patience + 1
    assert fit.best_step == every * (np.argmin(looks) + 1)
    assert run(fit) == []


def test_without_patience_a_fit_goes_on_to_its_end(scan):
    fit = fit_of(scan, steps=60, validation_views=2, validate_every=3, patience=0, **HASTY)
    run(fit)
    assert (fit.step, fit.stopped_early) == (60, False)
