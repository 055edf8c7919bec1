"""The fit: its loss falls, its rules hold, it resumes bit for bit, and it never looks at what it must not see."""

from __future__ import annotations

import copy
import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import fourier_gaussian

from helpers.fit_balls import HASTY, MATERIAL, RATES, a_cloud, cloud_of, equal, fit_of, found_by, frames_of, run
from holosplat.checks import InputError
from holosplat.fit.density import DensityControl
from holosplat.fit.terms import Objective
from holosplat.fit.terms import comparisons as terms
from holosplat.fit.terms.frames import photon_noise
from holosplat.fit.total_variation import total_variation
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods import GaussianRates
from holosplat.model import Instrument
from holosplat.optics.noise import noise_share
from holosplat.optics.propagation import poisson
from holosplat.representations import GaussianCloud, random_cloud

# --- what is fitted, and how fast ---------------------------------------------------------------------------


def test_the_loss_falls_and_held_out_frames_are_predicted_better(scan):
    def held_out_error(cloud: GaussianCloud) -> float:
        predicted = frames_of(cloud, Instrument(scan.test().exposures, 2)).numpy()
        return float(np.abs(predicted - scan.test().frames).mean())

    fit = fit_of(scan, cloud=a_cloud(200), steps=80, rates=GaussianRates(0.2, 0.1, 0.01, 0.2))
    before = held_out_error(cloud_of(fit))
    losses = [record["loss"] for record in run(fit)]
    assert losses[-1] < 0.35 * losses[0]
    assert held_out_error(found_by(fit)) < 0.75 * before
    assert fit.finished
    assert not fit.stopped_early


def test_rows_beyond_the_frames_do_not_weaken_what_bounds_the_volume(scan):
    """Means over a volume that is taller than the frames hold fewer voxels of matter beside those of air."""
    found, heights = list[dict[str, float]](), list[int]()
    for rows in (0, scan.views.shape[0]):
        cloud = a_cloud()
        cloud.raw_amplitudes += 3  # so that the occupancy exceeds one somewhere
        cloud.raw_amplitudes[0] = -20
        cloud.centres[0, 1] = 0.5 * scan.views.shape[0] + rows - 1
        fit = fit_of(scan, objective=Objective(tv_volume=0.02, overfull=3.0), cloud=cloud, steps=1)
        heights.append(fit.plan.grid.shape[1])
        found.append(next(iter(run(fit))))
    assert heights == [20, 60]
    for name in ("tv_volume", "overfull"):
        assert found[1][name] == pytest.approx(found[0][name], rel=0.05)  # tails that end with the frames


def test_a_loss_is_the_weighted_sum_of_its_recorded_terms(scan):
    """Weights, the linear FRC ramp, and volume terms made up for the steps they are left out of."""
    image = {"l1": 0.7, "l2_amplitude": 0.5, "ssim": 0.2, "tv_image": 0.05, "frc": 0.3, "frc_ramp": 0.5}
    volume = {"tv_volume": 0.02, "overfull": 3.0, "two_levels": 0.5}
    weights = Objective(**image, anisotropy=0.4, anisotropy_limit=1.001, **volume)
    bright = a_cloud()
    bright.raw_amplitudes += 3  # so that the occupancy exceeds one somewhere
    fit = fit_of(scan, objective=weights, cloud=bright, steps=12, volume_every=3, volume_edge=10)
    for step, record in enumerate(run(fit)):
        factors = dict.fromkeys(("l1", "l2_amplitude", "ssim", "tv_image", "anisotropy"), 1.0)
        factors["frc"] = min(1.0, step / 6)
        if step % 3 == 0:
            factors |= {"tv_volume": 3.0, "overfull": 3.0, "two_levels": 3.0 * step / 12}
        assert set(record) == {"step", "loss", "frames", "count", *factors}
        assert all(record[name] > 0 for name in factors if name != "anisotropy" or step > 0)
        wanted = sum(factor * getattr(weights, name) * record[name] for name, factor in factors.items())
        assert record["loss"] == pytest.approx(wanted, rel=1e-5)
        of_frames = sum(f * getattr(weights, n) * record[n] for n, f in factors.items() if n in image)
        assert record["frames"] == pytest.approx(of_frames, rel=1e-5)
        assert set(record) <= set(fit.columns())
    assert fit.columns()[:3] == ["step", "seconds", "loss"]


def test_recorded_image_terms_are_those_of_the_frames_on_the_training_range(scan):
    """Intensities go through the map of the training frames' minimum and maximum to 0 and 1."""
    fit = fit_of(scan, objective=Objective(1, 1, 1, 1), steps=1)
    train = scan.train()
    low, high = train.frames.min(), train.frames.max()
    predicted = frames_of(cloud_of(fit), Instrument(train.exposures, fit.model.instrument.oversample))
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
    fit = fit_of(noisy, objective=Objective(noise_width=1.2), steps=1)
    predicted = frames_of(cloud_of(fit), Instrument(noisy.train().exposures, fit.model.instrument.oversample))
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
        predicted = [frames_of(cloud_of(fit), fit.model.instrument).numpy()]
        records = run(fit, 1)
        fit.step = 2
        predicted.append(frames_of(cloud_of(fit), fit.model.instrument).numpy())
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
    two = random_cloud(30, scan.views, Matter.free(*MATERIAL), 1e-5, 0)
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
            plain = float(total_variation(cloud_of(fit).density(grid)))
        (record,) = run(fit)
        found[len(train)] = record["tv_volume"] / plain
    depth = scan.views.shape[1] / 100
    assert found == {n: pytest.approx(depth * (8 / n) ** 0.5, rel=1e-4) for n in found}


def test_total_variation_of_two_channels_is_the_sum_of_theirs(scan):
    """A material counts the same whether another one is there or not."""
    two = random_cloud(30, scan.views, Matter.free(*MATERIAL), 1e-5, 0)
    channels = two.raw_amplitudes.detach() + torch.tensor([0.0, 1.5])
    amplitudes = [channels, channels[:, :1], channels[:, 1:]]
    matters = [Matter.free(*MATERIAL), *[Matter.one(*MATERIAL)] * 2]
    clouds = [two.replaced((two.centres, two.log_scales, two.quaternions, a), m) for a, m in zip(amplitudes, matters)]
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
    "rates": replace(RATES, centres=0.1, raw_amplitudes=0.1),
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
    assert equal(cloud_of(second), cloud_of(whole))
    assert equal(found_by(second), found_by(whole))
    assert second.state_dict()["best"][:2] == whole.state_dict()["best"][:2]


def test_a_stopped_fit_stays_stopped(scan):
    options = {"steps": 400, "validation_views": 2, "validate_every": 3, "patience": 1, **HASTY}
    fit = fit_of(scan, **options)
    run(fit)
    other = fit_of(scan, **options)
    other.load(through_a_file(fit.state_dict()))
    assert other.finished
    assert run(other) == []
    assert equal(found_by(other), found_by(fit))


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
        assert equal(cloud_of(again), cloud_of(whole))


def test_the_same_seed_gives_the_same_fit_and_another_one_does_not(scan):
    fits = [fit_of(scan, seed=seed, **EVERYTHING) for seed in (3, 3, 4)]
    records = [run(fit) for fit in fits]
    assert records[0] == records[1]
    first, same, other = map(cloud_of, fits)
    assert equal(first, same)
    assert len(first) != len(other) or not equal(first, other)


def test_the_start_cloud_is_left_alone(scan):
    cloud = a_cloud()
    before = copy.deepcopy(cloud.parameters())
    run(fit_of(scan, cloud=cloud, steps=2))
    assert all(torch.equal(p, before[name]) for name, p in cloud.parameters().items())
    assert not any(p.requires_grad for p in cloud.parameters().values())


def test_test_frames_are_never_read(scan):
    """Poisoned with huge values, they change nothing at all."""
    frames = scan.frames.copy()
    frames[scan.is_test] = 1e30
    fits = [fit_of(s, **EVERYTHING) for s in (scan, replace(scan, frames=frames))]
    assert run(fits[0]) == run(fits[1])
    assert equal(*map(cloud_of, fits))
    assert equal(*map(found_by, fits))


def test_a_scan_without_training_frames_is_refused(scan):
    with pytest.raises(InputError, match="no training frame"):
        fit_of(replace(scan, is_test=np.ones(8, dtype=bool)))
