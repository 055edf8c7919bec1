"""The fit: its loss falls, its rules hold, it resumes bit for bit, and it never looks at what it must not see."""

from __future__ import annotations

import copy
import io
from collections import Counter
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch
from scipy.ndimage import fourier_gaussian
from torch import Tensor

from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit import objective as terms
from holosplat.fit.density import DensityControl, GradientRecord, control_density, doomed, outside
from holosplat.fit.loop import Fit, FitOptions, split_validation
from holosplat.fit.misfit import photon_noise
from holosplat.fit.objective import Objective
from holosplat.fit.schedule import Schedule
from holosplat.fit.total_variation import total_variation
from holosplat.fit.trainable import Trainable
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.model.instrument import Instrument
from holosplat.optics.detector import poisson
from holosplat.optics.noise import noise_share
from holosplat.representations import GaussianCloud, random_cloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.scan import Exposures, Scan

PIXEL = 2e-6
MATERIAL = (7e-7, 2.6e-10)
SHAPE = (20, 24)
BALLS = np.array([[-5.0, -3.0, 2.0, 4.0], [4.0, 4.0, -3.0, 3.0], [3.0, -5.0, -1.0, 3.5]]) * PIXEL
"""Centre (x, y, z) and radius of each ball [m]."""


class Balls:
    """Balls of the material; their line integrals are chords (no numerics shared with the Gaussians)."""

    def at(self, time: float) -> Balls:
        return self

    def project(self, views: Views) -> tuple[Tensor, Tensor]:
        h, w = views.shape
        x = (np.arange(w) + 0.5 - w / 2) * views.pixel_size
        y = (np.arange(h) + 0.5 - h / 2) * views.pixel_size
        chords = np.zeros((len(views), h, w))
        for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
            for *centre, radius in BALLS:
                cx, cy, _ = rotation @ centre
                square = (x + shift[0] - cx)[None] ** 2 + (y + shift[1] - cy)[:, None] ** 2
                chords[v] += 2 * np.sqrt(np.clip(radius**2 - square, 0, None))
        return torch.from_numpy(chords * MATERIAL[1]), torch.from_numpy(chords * MATERIAL[0])


def a_scan(train: int = 6, test: int = 2) -> Scan:
    """Noise-free frames of the balls; the test frames stand last."""
    count = train + test
    views = Views.from_angles(np.arange(count) * 180.0 / count, SHAPE, PIXEL)
    is_test = np.arange(count) >= train
    return simulate(Balls(), Exposures.of(views, 20.0, 0.05, 0.3), is_test=is_test)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return a_scan()


def a_cloud(count: int = 100, seed: int = 0) -> GaussianCloud:
    return random_cloud(count, Views.evenly_spaced(1, SHAPE, PIXEL), MATERIAL, 1, 4e-6, seed)


def fit_of(scan: Scan, *, objective=None, density=None, seed=0, cloud=None, **schedule) -> Fit:
    """A fit of a small random cloud; `schedule` are fields of `Schedule`."""
    options = FitOptions(objective or Objective(), Schedule(**schedule), density or DensityControl(), "cpu")
    return Fit(scan, cloud or a_cloud(), options, seed)


def run(fit: Fit, until: int | None = None) -> list[dict[str, float]]:
    """Advance the fit; returns its records without the clock."""
    records: list[dict[str, float]] = []
    fit.run(records.append, until)
    return [{name: value for name, value in record.items() if name != "seconds"} for record in records]


def equal(a: GaussianCloud, b: GaussianCloud) -> bool:
    """Whether two clouds are bit for bit the same."""
    return all(torch.equal(p, q) for p, q in zip(a.parameters, b.parameters))


# --- what is fitted, and how fast ---------------------------------------------------------------------------


def test_the_loss_falls_and_held_out_frames_are_predicted_better(scan):
    def held_out_error(cloud: GaussianCloud) -> float:
        with torch.no_grad():
            predicted = Instrument(scan.test().exposures, 2).measure(cloud).numpy()
        return float(np.abs(predicted - scan.test().frames).mean())

    fit = fit_of(scan, cloud=a_cloud(200), steps=80, rate_position=0.2, rate_scale=0.1, rate_amplitude=0.2)
    before = held_out_error(fit.cloud)
    losses = [record["loss"] for record in run(fit)]
    assert losses[-1] < 0.35 * losses[0]
    assert held_out_error(fit.result()) < 0.75 * before
    assert fit.finished
    assert not fit.stopped_early


def test_a_loss_is_the_weighted_sum_of_its_recorded_terms(scan):
    """Weights, the linear FRC ramp, and volume terms made up for the steps they are left out of."""
    weights = Objective(0.7, 0.5, 0.2, 0.05, 0.3, 0.5, 0.4, 1.001, 0.02, 3.0, 0.5)
    fit = fit_of(scan, objective=weights, steps=12, volume_every=3, volume_edge=10)
    bright = a_cloud()
    bright.raw_amplitudes += 3  # so that the occupancy exceeds one somewhere
    fit.trainable = Trainable(bright)
    for step, record in enumerate(run(fit)):
        factors = dict.fromkeys(("l1", "l2_amplitude", "ssim", "tv_image", "anisotropy"), 1.0)
        factors["frc"] = min(1.0, step / 6)
        if step % 3 == 0:
            factors |= {"tv_volume": 3.0, "overfull": 3.0, "two_levels": 3.0 * step / 12}
        assert set(record) == {"step", "loss", "count", *factors}
        assert all(record[name] > 0 for name in factors if name != "anisotropy" or step > 0)
        wanted = sum(factor * getattr(weights, name) * record[name] for name, factor in factors.items())
        assert record["loss"] == pytest.approx(wanted, rel=1e-5)
        assert set(record) <= set(fit.columns())
    assert fit.columns()[:3] == ["step", "seconds", "loss"]


def test_recorded_image_terms_are_those_of_the_frames_on_the_training_range(scan):
    """Intensities go through the map of the training frames' minimum and maximum to 0 and 1."""
    fit = fit_of(scan, objective=Objective(1, 1, 1, 1), steps=1)
    train = scan.train()
    low, high = train.frames.min(), train.frames.max()
    with torch.no_grad():
        predicted = Instrument(train.exposures, fit.instrument.oversample).measure(fit.cloud)
    measured = torch.from_numpy(train.frames)
    a, b = ((frames - low) / (high - low) for frames in (predicted, measured))
    (record,) = run(fit)
    assert record["l1"] == pytest.approx(float(terms.l1(a, b).mean()), rel=1e-5)
    assert record["ssim"] == pytest.approx(float(terms.one_minus_ssim(a, b).mean()), rel=1e-4)
    assert record["tv_image"] == pytest.approx(float(terms.tv_image(a).mean()), rel=1e-4)
    assert record["l2_amplitude"] == pytest.approx(float(terms.l2_amplitude(predicted, measured).mean()), rel=1e-4)


def test_differences_within_the_noise_count_by_their_square(scan):
    """Frames without noise: the plain absolute difference. With it: Huber's, as wide as each pixel's own noise."""
    noisy = replace(scan, frames=poisson(scan.frames, 500.0, 3))
    for frames, wide in ((scan, False), (noisy, True)):
        found = [run(fit_of(frames, objective=Objective(noise_width=k), steps=1))[0]["l1"] for k in (0.0, 1.2)]
        assert (found[1] < 0.98 * found[0]) == wide
    measured = torch.from_numpy(noisy.train().frames)
    width = 1.2 * photon_noise(measured)
    with torch.no_grad():
        fit = fit_of(noisy, objective=Objective(noise_width=1.2), steps=1)
        predicted = Instrument(noisy.train().exposures, fit.instrument.oversample).measure(fit.cloud)
    wanted = terms.huber(predicted, measured, width).mean() / (measured.max() - measured.min())
    assert found[1] == pytest.approx(float(wanted), rel=1e-5)


def test_noisy_frames_are_compared_coarse_to_fine(scan):
    """Both blurred by the pixels asked for at first, by half of them half-way; less where there is less noise."""
    for sigma, photons in ((1.4, 200), (0.9, 100_000)):
        frames = poisson(scan.frames, photons, 3).astype(np.float32)
        noisy = replace(scan, frames=frames)
        train = noisy.train()
        share = noise_share(torch.from_numpy(train.frames))
        fit = fit_of(noisy, objective=Objective(coarse=sigma), steps=4)
        predicted = [fit.instrument.measure(fit.cloud).detach().numpy()]
        records = run(fit, 1)
        fit.step = 2
        predicted.append(fit.instrument.measure(fit.cloud).detach().numpy())
        records += run(fit, 3)
        for record, prediction, narrower in zip(records, predicted, (1.0, 0.5)):
            width = narrower * sigma * min(1.0, share / 0.5)
            spectra = [fourier_gaussian(np.fft.fft2(frame), width) for frame in prediction - train.frames]
            wanted = np.abs(np.fft.ifft2(spectra).real).mean() / np.ptp(train.frames)
            assert record["l1"] == pytest.approx(wanted, rel=1e-3)
    assert 0.1 < share < 0.5


def test_frames_without_noise_are_compared_as_they_are(scan):
    records = [run(fit_of(scan, objective=Objective(coarse=coarse), steps=3)) for coarse in (0.0, 1.0)]
    assert records[0] == records[1]


def test_the_noise_of_a_pixel_is_that_of_its_photons():
    """Its root, where frames show it: a ramp of intensity, on 61 × 75 pixels."""
    clean = np.broadcast_to(np.linspace(0.5, 1.5, 75, dtype="f4"), (4, 61, 75)).copy()
    found = photon_noise(torch.from_numpy(poisson(clean, 1000.0, 0))).numpy()
    np.testing.assert_allclose(found.mean(axis=(0, 1)), np.sqrt(clean[0, 0] / 1000), rtol=0.25)
    assert found.mean() == pytest.approx(np.sqrt(1 / 1000), rel=0.2)


def test_constant_frames_are_refused(scan):
    with pytest.raises(InputError, match="constant"):
        fit_of(replace(scan, frames=np.ones_like(scan.frames)))


def test_bounds_are_for_amplitudes_that_are_occupancies(scan):
    two = random_cloud(30, scan.views, MATERIAL, 2, 1e-5, 0)
    weights = Objective(overfull=1.0, two_levels=1.0, tv_volume=0.1)
    (record,) = run(fit_of(scan, objective=weights, steps=1, cloud=two))
    assert "tv_volume" in record
    assert not {"overfull", "two_levels"} & set(record)


def test_terms_on_the_volume_weigh_by_its_depth_and_the_number_of_views(scan):
    """The same object counts the same however deep the field; and more, the fewer views there are."""
    weights, found = Objective(tv_volume=0.1), {}
    for train in (scan.train(), scan.train()[[0, 1]]):
        fit = fit_of(train, objective=weights, steps=1)
        grid = Grid.of_views(train.views)
        with torch.no_grad():
            plain = float(
                total_variation(fit.cloud.density_around(torch.tensor(grid.centre), grid.shape, grid.voxel_size[0]))
            )
        (record,) = run(fit)
        found[len(train)] = record["tv_volume"] / plain
    depth = scan.views.shape[1] / 100
    assert found == {n: pytest.approx(depth * (8 / n) ** 0.5, rel=1e-4) for n in found}


def test_total_variation_of_two_channels_is_the_sum_of_theirs(scan):
    """A material counts the same whether another one is there or not."""
    two = random_cloud(30, scan.views, MATERIAL, 2, 1e-5, 0)
    channels = two.raw_amplitudes.detach() + torch.tensor([0.0, 1.5])
    amplitudes = [channels, channels[:, :1], channels[:, 1:]]
    clouds = [GaussianCloud([*two.parameters[:3], a], two.unit_length, *MATERIAL) for a in amplitudes]
    both, first, second = (run(fit_of(scan, objective=Objective(tv_volume=1.0), cloud=c, steps=1))[0] for c in clouds)
    assert first["tv_volume"] < 0.8 * second["tv_volume"]
    assert both["tv_volume"] == pytest.approx(first["tv_volume"] + second["tv_volume"], rel=1e-4)


def test_two_levels_weighs_more_for_noisy_frames(scan):
    noisy = replace(scan, frames=scan.frames + np.random.default_rng(0).normal(0, 0.1, scan.frames.shape).astype("f4"))
    share = noise_share(torch.from_numpy(noisy.train().frames))
    assert share > 0.2
    for gain in (0.0, 2.0):
        fit = fit_of(noisy, objective=Objective(two_levels=1.0, noise_gain=gain), steps=2)
        last = run(fit)[-1]  # the first has no such term yet
        wanted = last["l1"] + 0.5 * (1 + gain * share) * last["two_levels"]
        assert last["loss"] == pytest.approx(wanted, rel=1e-5)


def test_a_fit_can_run_in_parts(scan):
    fit = fit_of(scan, steps=7)
    assert [r["step"] for r in run(fit, until=3)] == [1, 2, 3]
    assert not fit.finished
    assert run(fit, until=0) == run(fit, until=2) == []
    assert [r["step"] for r in run(fit, until=99)] == [4, 5, 6, 7]
    assert fit.finished
    assert run(fit) == []


# --- views --------------------------------------------------------------------------------------------------


def batches(fit: Fit, monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The views of every step, as the instrument is asked for them."""
    seen, frames = [], fit.instrument.frames

    def spy(lines, index=None):
        seen.append(list(range(len(fit.train))) if index is None else index.tolist())
        return frames(lines, index)

    monkeypatch.setattr(fit.instrument, "frames", spy)
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
    whole = Instrument(fit.train.exposures, fit.instrument.oversample)
    wanted, frames = [], fit.instrument.frames

    def spy(lines, index=None):
        with torch.no_grad():
            predicted = whole.measure(fit.cloud.detached(), index.numpy())
        difference = (predicted - torch.from_numpy(fit.train.frames)[index]).abs().mean()
        wanted.append(float(difference) / float(np.ptp(fit.train.frames)))
        return frames(lines, index)

    monkeypatch.setattr(fit.instrument, "frames", spy)
    assert [record["l1"] for record in run(fit)] == pytest.approx(wanted, rel=1e-4)


# --- rates, warm-up, detached views -------------------------------------------------------------------------


def test_rates_decay_exponentially_to_the_asked_fraction(scan, monkeypatch):
    schedule = Schedule(steps=11, decay=0.01)
    assert schedule.rates(0) == (0.02, 0.01, 0.01, 0.02)
    assert schedule.rates(5) == pytest.approx((0.002, 0.001, 0.001, 0.002))
    assert schedule.rates(10) == pytest.approx((0.0002, 0.0001, 0.0001, 0.0002))
    used, prepare = [], Trainable.prepare
    monkeypatch.setattr(Trainable, "prepare", lambda self, rates: (used.append(rates), prepare(self, rates)))
    run(fit_of(scan, steps=11, decay=0.01, rate_position=0.3))
    assert len(used) == 11
    assert used[-1] == pytest.approx((0.003, 1e-4, 1e-4, 2e-4))


def test_each_parameter_moves_at_its_own_rate(scan):
    """Adam's first step is as long as the rate (where there is a gradient at all)."""
    fit = fit_of(scan, steps=5, rate_position=0.04, rate_scale=0.03, rate_rotation=0.02, rate_amplitude=0.01)
    stretched = a_cloud()
    stretched.log_scales += torch.linspace(-0.5, 0.5, 3)  # round Gaussians do not feel rotations
    fit.trainable = Trainable(stretched)
    run(fit, until=1)
    moved = [float((a - b).abs().median()) for a, b in zip(fit.cloud.detached().parameters, stretched.parameters)]
    assert moved == pytest.approx([0.04, 0.03, 0.02, 0.01], rel=0.05)


def test_warm_up_moves_amplitudes_only(scan):
    start = a_cloud()
    fit = fit_of(scan, steps=8, warmup_steps=4)
    run(fit, until=4)
    same = [torch.equal(a, b) for a, b in zip(fit.cloud.parameters, start.parameters)]
    assert same == [True, True, True, False]
    run(fit, until=5)
    assert not torch.equal(fit.cloud.centres, start.centres)
    assert not torch.equal(fit.cloud.log_scales, start.log_scales)


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
        return fit.cloud

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


# --- density control ----------------------------------------------------------------------------------------


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
    parts = [numbers(fit.train), numbers(fit.validation), numbers(scan.test())]
    assert [len(part) for part in parts] == [6, 3, 3]
    assert set.union(*parts) == set(range(12))


def test_validation_frames_do_not_move_the_fit(scan):
    """Whatever they show: the last state (not the best one) is the same."""
    plain = fit_of(scan, steps=5, validation_views=2, validate_every=2)
    frames = scan.frames.copy()
    validation = [i for i in range(6) if not (frames[i] == plain.train.frames).all(axis=(1, 2)).any()]
    assert len(validation) == 2
    frames[validation] = 7.0
    other = fit_of(replace(scan, frames=frames), steps=5, validation_views=2, validate_every=2)
    a, b = run(plain), run(other)
    assert equal(plain.cloud, other.cloud)
    assert a[-1]["val_l1"] != b[-1]["val_l1"]


HASTY = {"rate_position": 3.0, "rate_scale": 0.5, "rate_amplitude": 2.0, "decay": 1.0}
"""Rates at which the fit soon gets worse on views it does not see."""


def disagreement(record: dict[str, float]) -> float:
    """What the best state has least of: 1 - (SSIM + FRCM) / 2 of the validation views."""
    return 1 - (record["val_ssim"] + record["val_frcm"]) / 2


def test_the_best_state_by_the_validation_views_is_the_result(scan):
    fit = fit_of(scan, steps=33, validation_views=2, validate_every=4, **HASTY)
    seen: list[tuple[float, int, GaussianCloud]] = []

    def look(record: dict[str, float]) -> None:
        if "val_ssim" in record:
            seen.append((disagreement(record), fit.step, fit.cloud.detached()))

    fit.run(look)
    assert [step for _, step, _ in seen] == [4, 8, 12, 16, 20, 24, 28, 32, 33]
    score, step, cloud = min(seen, key=lambda look: look[0])
    assert step < 33
    assert fit.best_step == step
    assert fit.best_score == pytest.approx(score)
    assert equal(fit.result(), cloud)
    assert not equal(fit.result(), fit.cloud)


def test_validation_scores_are_those_of_the_validation_frames(scan):
    fit = fit_of(scan, steps=1, validation_views=2, validate_every=1)
    (record,) = run(fit)
    low, high = fit.train.frames.min(), fit.train.frames.max()
    with torch.no_grad():
        predicted = Instrument(fit.validation.exposures, fit.instrument.oversample).measure(fit.cloud).numpy()
    a, b = (torch.from_numpy((frames - low) / (high - low)) for frames in (predicted, fit.validation.frames))
    assert record["val_l1"] == pytest.approx(float(terms.l1(a, b).mean()), rel=1e-4)
    assert record["val_ssim"] == pytest.approx(1 - float(terms.one_minus_ssim(a, b).mean()), rel=1e-4)
    assert record["val_frcm"] == pytest.approx(1 - float(terms.one_minus_frcm(a, b).mean()), rel=1e-3)
    assert {"val_l1", "val_ssim", "val_frcm"} <= set(fit.columns())


def test_without_validation_the_last_state_is_the_result(scan):
    fit = fit_of(scan, steps=3)
    assert not any(name.startswith("val_") for record in run(fit) for name in record)
    assert equal(fit.result(), fit.cloud)


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


# --- going on, repeating, and not looking -------------------------------------------------------------------

EVERYTHING = {
    "objective": Objective(
        l1=1.0, ssim=0.2, frc=0.1, anisotropy=0.1, anisotropy_limit=1.1, tv_volume=0.1, overfull=1.0
    ),
    "density": DensityControl(every=4, start=0.1, stop=0.9, grow_fraction=0.1, faint=0.02),
    "steps": 20,
    "views_per_step": 2,
    "validation_views": 1,
    "validate_every": 3,
    "volume_every": 2,
    "volume_edge": 8,
    "rate_position": 0.1,
    "rate_amplitude": 0.1,
}
"""A fit that uses all that is random or carries state."""


def through_a_file(state: dict) -> dict:
    """The state as a checkpoint gives it back."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


@pytest.mark.parametrize("stop", [1, 5, 8, 13])
def test_an_interrupted_fit_goes_on_bit_for_bit(scan, stop):
    whole = fit_of(scan, **EVERYTHING)
    records = run(whole)
    assert len({r["count"] for r in records}) > 2
    first = fit_of(scan, **EVERYTHING)
    head = run(first, until=stop)
    second = fit_of(scan, seed=99, cloud=a_cloud(7, seed=5), **EVERYTHING)
    second.load(through_a_file(first.state_dict()))
    assert second.step == stop
    assert second.seconds == first.seconds > 0
    assert head + run(second) == records
    assert equal(second.cloud, whole.cloud)
    assert equal(second.result(), whole.result())
    assert (second.best_score, second.best_step) == (whole.best_score, whole.best_step)


def test_a_stopped_fit_stays_stopped(scan):
    options = {"steps": 400, "validation_views": 2, "validate_every": 3, "patience": 1, **HASTY}
    fit = fit_of(scan, **options)
    run(fit)
    other = fit_of(scan, **options)
    other.load(through_a_file(fit.state_dict()))
    assert other.finished
    assert run(other) == []
    assert equal(other.result(), fit.result())


def test_a_state_kept_in_memory_does_not_change(scan):
    """Later steps, of the fit that gave the state or of one that took it, leave it alone."""
    whole = fit_of(scan, **EVERYTHING)
    run(whole)
    fit = fit_of(scan, **EVERYTHING)
    run(fit, until=6)
    state = fit.state_dict()
    run(fit)
    for _ in range(2):
        again = fit_of(scan, **EVERYTHING)
        again.load(state)
        run(again)
        assert equal(again.cloud, whole.cloud)


def test_the_same_seed_gives_the_same_fit_and_another_one_does_not(scan):
    fits = [fit_of(scan, seed=seed, **EVERYTHING) for seed in (3, 3, 4)]
    records = [run(fit) for fit in fits]
    assert records[0] == records[1]
    assert equal(fits[0].cloud, fits[1].cloud)
    assert len(fits[0].cloud) != len(fits[2].cloud) or not equal(fits[0].cloud, fits[2].cloud)


def test_the_start_cloud_is_left_alone(scan):
    cloud = a_cloud()
    before = copy.deepcopy(cloud.parameters)
    run(fit_of(scan, cloud=cloud, steps=2))
    assert all(torch.equal(a, b) for a, b in zip(cloud.parameters, before))
    assert not any(p.requires_grad for p in cloud.parameters)


def test_test_frames_are_never_read(scan):
    """Poisoned with huge values, they change nothing at all."""
    frames = scan.frames.copy()
    frames[scan.is_test] = 1e30
    fits = [fit_of(s, **EVERYTHING) for s in (scan, replace(scan, frames=frames))]
    assert run(fits[0]) == run(fits[1])
    assert equal(fits[0].cloud, fits[1].cloud)
    assert equal(fits[0].result(), fits[1].result())


def test_a_scan_without_training_frames_is_refused(scan):
    with pytest.raises(InputError, match="no training frame"):
        fit_of(replace(scan, is_test=np.ones(8, dtype=bool)))
