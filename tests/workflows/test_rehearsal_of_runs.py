"""Rehearsals: bias and spread of numbers, intervals, the verdict of three words, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import isotonic_regression

import holosplat as hs
from holosplat.align.geometry import Geometry
from holosplat.align.poses import PosePrior
from holosplat.align.views import AlignedViews
from holosplat.geometry import Grid
from holosplat.inference import Decision
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import METHODS
from holosplat.methods.uncertain import Determined
from holosplat.metrics import dice
from holosplat.optics import NoiseModel
from holosplat.representations import VoxelGrid
from holosplat.volume import Volume
from holosplat.workflows import Reconstruction, RunFolder, certainty, rehearsal
from holosplat.workflows.certainty import (
    NULL,
    Factor,
    errors_of,
    scale_of,
    true_sizes,
)
from holosplat.workflows.matter_map import BINS, MatterMap, matter_probabilities, occupancy_counts
from holosplat.workflows.rehearsal import Rehearsal, read_rehearsal, rehearse
from holosplat.workflows.totals import TotalMatter
from holosplat.workflows.verdict import Verdict

WATER = hs.materials.parse_material("water").delta_beta(20.0)
PRIOR, PIXEL, SHAPE = hs.MaterialPrior.known(WATER), 1e-6, (20, 23)


def cells() -> hs.MeshScene:
    return hs.MeshScene.of_one_material(hs.specimens.random_cells(2, (16e-6, 16e-6, 16e-6), 5, 9e-6), WATER)


def scan_of(count: int, photons: float | None = 20000.0) -> hs.Scan:
    views = hs.Views.evenly_spaced(count, SHAPE, PIXEL)
    return hs.simulate(cells(), hs.Exposures.of(views, 20.0, 0.03), photons_per_pixel=photons, seed=3)


def ball(factor: float = 1.0, move: int = 0) -> VoxelGrid:
    """A ball of occupancy `factor`, `move` voxels further along x, in a box of odd sides."""
    grid = Grid.centred((13, 11, 15), PIXEL)
    z, y, x = np.meshgrid(*(np.arange(n) - n // 2 for n in grid.shape), indexing="ij")
    values = factor * ((x - move) ** 2 + y**2 + z**2 <= 9)
    return VoxelGrid(torch.from_numpy(values)[None].float(), grid, Matter.one(*WATER))


def result(found: VoxelGrid) -> Reconstruction:
    return Reconstruction(found, "voxels", 20.0, 1, {}, True)


def test_errors_of_the_truth_are_none_and_those_of_changes_are_as_large_as_these():
    truth = ball().voxelise(ball().grid)
    exact = errors_of(result(ball()), truth)
    assert all(abs(value) < 1e-6 for value in exact.values())
    more, moved = errors_of(result(ball(1.1)), truth), errors_of(result(ball(move=2)), truth)
    for name in ("total", "delta", "error"):
        assert more[name] == pytest.approx(0.1, abs=1e-5)
    assert more["centre"] == pytest.approx(0, abs=1e-6)
    assert moved["centre"] == pytest.approx(2, abs=1e-6)
    assert moved["total"] == pytest.approx(0, abs=1e-6)
    inside = (ball().values > 0).numpy()
    both = float((inside & (ball(move=2).values > 0).numpy()).sum())
    assert moved["dice"] == pytest.approx(1 - both / inside.sum(), abs=1e-6)


def test_scales_are_root_mean_squares_and_that_of_a_resolution_is_the_mean():
    assert scale_of("total", np.array([0.3, -0.4])) == pytest.approx(np.sqrt(0.125))
    assert scale_of("resolution", np.array([1.0, 3.0])) == 2.0


def test_sizes_whose_measurement_is_found_are_those_that_the_errors_allow():
    assert true_sizes(2.0, -0.5, 0.25) == pytest.approx((1.6, 4.0))
    assert true_sizes(2.0, -1.5, 1.0) == (1.0, np.inf)
    assert true_sizes(-0.1, -1.5, 1.0) == (0.0, np.inf)
    wrong = errors_of(
        replace(result(ball()), total=TotalMatter("δ", -1e-25, 1e-26, 1e-25, "")), ball().voxelise(ball().grid)
    )
    assert wrong["total"] < -1


@pytest.fixture(scope="module")
def few() -> tuple[Reconstruction, hs.Scan, Rehearsal]:
    """Linear retrieval of four views, three of them for training."""
    scan, method = scan_of(4), METHODS["ctf-tv"]
    done = hs.reconstruct(scan, PRIOR, method)
    return done, scan, rehearse(done, scan, PRIOR, method, times=2, causes=False)


def test_a_biased_method_shows_its_bias_and_an_exact_one_has_none(few, monkeypatch):
    done, scan, shown = few
    assert shown.values("error").min() > 0.1
    assert shown.values("dice").min() > 0.01

    monkeypatch.setattr(certainty, "reconstruct", lambda *args, **how: done)
    exact = rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, causes=False)
    for name in ("delta", "volume", "centre", "dice", "error"):
        assert np.abs(exact.values(name)).max() < 1e-6
        low, high = exact.interval(name)
        assert high - low < shown.interval(name)[1] - shown.interval(name)[0]


def test_frames_of_a_rehearsal_are_those_of_the_result_with_noise_of_the_measured_ones(few, monkeypatch):
    done, scan, _ = few
    seen = []

    def look(frames, **how):
        seen.append(frames)
        return done

    monkeypatch.setattr(certainty, "reconstruct", look)
    rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, causes=False)
    level = NoiseModel.of_frames(scan.train().measured).level
    for each in seen:
        assert each.frames.shape == scan.train().frames.shape
        noise = each.frames - hs.workflows.render(done, each.exposures)
        assert noise.std() == pytest.approx(float(level.square().mean().sqrt()), rel=0.15)
    first, second = (each.views.rotations for each in seen)
    assert not np.allclose(first, second)
    given = scan.train().views.rotations
    between = [turns[0].T @ turns[1] for turns in (first, second, given)]
    assert [np.trace(turn) for turn in between] == pytest.approx([np.trace(between[2])] * 3)  # by one angle together


def test_views_turn_about_what_they_look_at():
    """A point there stays where it is on all detectors, and a quarter turn moves one beside it as the axis says."""
    views = hs.Views.from_angles([0.0, 50.0], (5, 7), PIXEL)
    middle = np.array([4.0, -2.0, 3.0]) * PIXEL
    views = replace(views, shifts=(views.rotations @ middle)[:, :2])
    turned = rehearsal.turned_by(hs.Exposures.of(views, 20.0, 0.03), 90.0).views
    assert Grid.of_views(turned).centre == pytest.approx(middle)
    assert (turned.rotations @ middle)[:, :2] == pytest.approx(turned.shifts)
    beside = middle + np.array([1.0, 0.0, 0.0]) * PIXEL
    along = turned.rotations @ beside - np.c_[turned.shifts, (turned.rotations @ middle)[:, 2]]
    assert along == pytest.approx(views.rotations @ np.array([0.0, 0.0, -1.0]) * PIXEL, abs=1e-15)


def test_what_a_run_found_of_distance_energy_and_poses_is_drawn_from_its_errors(few, monkeypatch):
    """They are found at 0.03 m and 20 keV, within 20 % and 2 % (95 %, as logarithms), and in their plane within 0.5 px
    and 2°; frames are reconstructed at what was found, and are those of what may be true."""
    done, scan, _ = few
    rng, train = np.random.default_rng(0), scan.train().exposures
    constants = tuple(
        Determined(name, value, value / by, value * by, (value / 2, value * 2), True)
        for name, value, by in (("distance", 0.03, 1.2), ("energy_kev", 20.0, 1.02))
    )
    errors, none = np.tile([0.5, 0.5, 0, 2.0, 0, 0, 0], (3, 1)), np.zeros(3)
    searched = AlignedViews(train, np.zeros((3, 7)), errors, none, none, none, ())
    geometry = Geometry.of_training(scan, searched, PosePrior())
    unsure = replace(done, constants=constants, geometry=geometry)
    drawn = [certainty.as_uncertain(unsure, train, 2, rng) for _ in range(400)]
    for name, by in (("distance", 1.2), ("energy_kev", 1.02)):
        logs = np.log([getattr(each, name)[0] / getattr(train, name)[0] for each in drawn])
        assert logs.std() == pytest.approx(0.5 * np.log(by), rel=0.1)
    moved = np.array([each.views.shifts - train.views.shifts for each in drawn]) / PIXEL
    assert moved.std(axis=0) == pytest.approx(np.full((3, 2), 0.25), rel=0.15)
    turns = [
        np.rad2deg(np.arccos((np.trace(e.views.rotations[1].T @ train.views.rotations[1]) - 1) / 2)) for e in drawn
    ]
    assert np.sqrt(np.square(turns).mean()) == pytest.approx(2.0, rel=0.1)
    assert certainty.as_uncertain(done, train, 2, rng) is train

    told = []
    real = certainty.reconstruct
    monkeypatch.setattr(certainty, "reconstruct", lambda *a, **how: told.append(a[0].exposures) or real(*a, **how))
    monkeypatch.setattr(rehearsal, "turned_by", lambda exposures, degrees: exposures)
    shown = rehearse(replace(done, constants=constants[:1]), scan, PRIOR, METHODS["ctf-tv"], times=2, causes=False)
    assert {each.distance[0] for each in told} == {0.03}
    exact = rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, causes=False)
    assert shown.values("error").mean() > exact.values("error").mean() + 0.005


def test_intervals_hold_what_rehearsals_take_for_true(few):
    """The stated error of the total, and of an estimated δ/β that of δ."""
    done, _, shown = few
    unknown = certainty.doubts_of(replace(done, total=None), MaterialPrior.unknown())
    assert unknown == dict.fromkeys(("total", "delta", "error"), 0.4)
    stated = replace(done, total=TotalMatter("δ", -2e-22, 1e-22, 2e-22, ""))
    assert certainty.doubts_of(stated, PRIOR) == {"total": 0.5}
    doubted = replace(shown, doubts={"total": 3.0})
    assert doubted.interval("total")[1] > certainty.factors()["total"].factor * 3.0
    assert doubted.interval("delta") == shown.interval("delta")
    again = Rehearsal.from_dict(doubted.as_dict())  # a verdict's powers are written with four digits
    assert again.interval("total") == pytest.approx(doubted.interval("total"), rel=1e-3)
    assert "m³ or more in size" in "".join(replace(doubted, total=1e-22).intervals())


def test_larger_pixels_are_rehearsed_on_measured_frames_of_such_pixels(few, monkeypatch):
    done, scan, _ = few
    seen = []

    def look(frames, **how):
        seen.append(frames.views.shape)
        return done

    monkeypatch.setattr(certainty, "reconstruct", look)
    shown = rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, bins=2, causes=False)
    assert seen == [(10, 11)] * 3
    assert shown.pixel == pytest.approx(2 * PIXEL)


def test_turned_views_show_what_one_view_leaves_free(monkeypatch):
    """Of one view the depth is free. Rehearsed from where it stands, the result seems nearly twice as good as it is."""
    scan, method = scan_of(1, None), METHODS["ctf-tv"]
    scan = replace(scan, is_test=np.zeros(1, dtype=bool))
    done = hs.reconstruct(scan, PRIOR, method)
    true = errors_of(done, cells().voxelise(Grid.of_views(scan.views)))["error"]
    turned = rehearse(done, scan, PRIOR, method, times=2, causes=False).values("error")
    monkeypatch.setattr(rehearsal, "turned_by", lambda exposures, degrees: exposures)
    still = rehearse(done, scan, PRIOR, method, times=2, causes=False).values("error")
    assert still.max() < 0.75 * true
    assert np.abs(turned - true).max() < 0.2 * true


def test_the_map_of_matter_is_calibrated_on_what_it_was_counted_on(few):
    """The mean probability over the voxels that were counted is the share of matter among them, but for the prior."""
    shown = few[2]
    voxels, matter = (shown.values(name).sum(axis=0) for name in ("voxels", "matter"))
    table = shown.matter.table
    assert voxels.sum() == 2 * 20 * 23 * 23
    assert (np.diff(table) >= 0).all()
    assert (voxels * table).sum() == pytest.approx(matter.sum(), abs=len(table))
    assert shown.matter.values.shape == (23, 20, 23)
    assert 0 < shown.matter.expected_dice < 1
    assert f"expected by the map of matter: {shown.matter.expected_dice:.2f}" in "".join(shown.lines())
    with pytest.raises(hs.InputError, match="is not kept; rehearse again"):
        _ = replace(shown, found=None).matter


def test_probabilities_are_the_isotonic_fit_of_shares():
    """The twin: scipy's weighted isotonic regression; without disorder the shares themselves."""
    rng = np.random.default_rng(4)
    voxels = rng.integers(0, 200, 41).astype(float)
    matter = np.floor(voxels * rng.random(41))
    twin = isotonic_regression((matter + 0.5) / (voxels + 1), weights=voxels + 1).x
    assert matter_probabilities(voxels, matter) == pytest.approx(twin, rel=1e-12)
    rising = matter_probabilities(np.array([9.0, 9.0, 9.0]), np.array([0.0, 4.0, 9.0]))
    assert rising == pytest.approx([0.05, 0.45, 0.95])
    with pytest.raises(hs.InputError, match="among those counted"):
        matter_probabilities(np.ones(2), np.array([1.0, 2.0]))


def test_occupancies_of_known_noise_have_the_probabilities_of_bayes():
    """Matter of occupancy 1 in a third of a box of odd sides, Gaussian noise: p = 1/(1 + 2 exp((1 - 2 o)/(2 σ²)))."""
    rng, grid, sigma = np.random.default_rng(0), Grid.centred((31, 45, 53), PIXEL), 0.3
    matter = rng.random(grid.shape) < 1 / 3
    truth = Volume(1e-7 * matter, 1e-9 * matter, grid)
    noisy = 1e-7 * (matter + sigma * rng.normal(size=grid.shape))
    counts = occupancy_counts(Volume(noisy, 0.01 * noisy, grid), truth)
    table = matter_probabilities(*(np.array(counts[name]) for name in ("voxels", "matter")))
    middles = 0.5 * (BINS[1:] + BINS[:-1])[1:-1]
    exact = 1 / (1 + 2 * np.exp((1 - 2 * middles) / (2 * sigma**2)))
    assert table[1:-1] == pytest.approx(exact, abs=0.05)
    other = MatterMap(Volume(noisy, noisy, grid), 1e-7, table)
    both = float(other.values[noisy > 0.5e-7].sum()) * 2 / float((noisy > 0.5e-7).sum() + other.values.sum())
    assert other.expected_dice == pytest.approx(both)
    assert other.expected_dice == pytest.approx(dice(noisy > 0.5e-7, matter), abs=0.01)
    assert other.on(grid) == pytest.approx(other.values, abs=1e-5)
    finer = Grid.centred((31, 45, 105), PIXEL)
    between = other.on(replace(finer, voxel_size=(PIXEL / 2, PIXEL, PIXEL), origin=grid.origin))
    assert between[..., 1::2] == pytest.approx(0.5 * (other.values[..., 1:] + other.values[..., :-1]), abs=1e-5)


def made(own: float, left: float, allowed: float, good: bool, cause: Decision | None = None) -> Rehearsal:
    """A run whose only band has a residual `own`, and rehearsals that leave `left`."""
    powers = {name: np.full((2, 1), value) for name, value in (("residual", own), ("allowed", allowed))}
    powers |= {name: np.ones((2, 1)) for name in ("noise", "contrast")}
    said = Verdict(good, "words", (), np.array([[2e-6, np.inf]]), **powers, tested={}, cause="" if good else "mass")
    runs = [{"residual": [left], "cause": ""}, {"residual": [left], "cause": "mass"}]
    return Rehearsal(1, PIXEL, said, tuple(runs), cause=cause)


def test_an_experiment_of_more_views_and_photons_is_foreseen_to_be_surer():
    """Of the same cell; the truth is the mesh, on the grid of odd frames."""
    cell = hs.specimens.random_cells(1, (14e-6, 14e-6, 14e-6), 1, 9e-6)
    scene = hs.MeshScene.of_one_material(cell, WATER)
    errors = []
    for views, photons in ((3, 1e3), (12, 1e5)):
        exposures = hs.Exposures.of(hs.Views.evenly_spaced(views, (17, 19), PIXEL), 20.0, 0.03)
        shown = rehearsal.foresee(scene, exposures, photons, PRIOR, METHODS["ctf-tv"], times=2)
        assert "total δ: up to" in "".join(shown.intervals())
        assert shown.interval("error")[1] > shown.values("error").max()
        errors.append(shown.values("error").mean())
    assert errors[1] < 0.7 * errors[0]
    with pytest.raises(hs.InputError, match="2 rehearsals or more"):
        rehearsal.foresee(scene, exposures, 1e3, PRIOR, METHODS["ctf-tv"], times=1)


def test_the_three_words(monkeypatch):
    factor = Factor(0.0, 1.5, 99)
    monkeypatch.setattr(rehearsal, "factors", lambda: {"residual": factor})
    assert made(1.0, 0.5, 1.0, True).word == "consistent"
    assert made(3.0, 2.5, 1.0, False).word == "limited"
    assert made(3.0, 0.5, 1.0, False).word == "wrong"
    assert made(3.0, 0.5, 1.0, False).excess == (pytest.approx(3.0), 0)
    assert made(3.0, 2.5, 1.0, False, Decision("", "angles", "")).word == "wrong"
    assert made(3.0, 2.5, 1.0, False, Decision("", NULL, "")).word == "limited"
    assert made(3.0, 2.5, 1.0, False).doubtful  # rehearsals of wrong metadata leave as much, and have its cause
    assert made(3.0, 0.5, 1.0, True).doubtful
    assert not made(1.0, 0.5, 1.0, True).doubtful


@pytest.mark.parametrize(("power", "times"), [(0, 1.0), (1, 3.0)])
def test_an_interval_grows_with_the_excess_where_the_calibration_says_so(power, times, monkeypatch):
    """A residual three times that of rehearsals; one that is less makes no interval shorter."""
    monkeypatch.setattr(rehearsal, "factors", lambda: {"total": Factor(0.5, 2.0, 99, power)})
    for own, grown in ((3.0, times), (0.3, 1.0)):
        shown = made(own, 1.0, 1.0, False)
        shown = replace(shown, runs=tuple({**run, "total": 0.1} for run in shown.runs))
        reach = 2.0 * (0.1 * grown + 0.5)
        assert shown.interval("total") == (pytest.approx(-reach), pytest.approx(reach))


def test_rehearsals_are_kept_and_only_those_that_are_missing_are_made(tmp_path, monkeypatch):
    scan, method, folder = scan_of(4), METHODS["ctf-tv"], RunFolder(tmp_path / "run")
    done = hs.reconstruct(scan, PRIOR, method, folder=folder)
    assert read_rehearsal(folder) is None
    calls = []
    real = certainty.reconstruct
    monkeypatch.setattr(certainty, "reconstruct", lambda *args, **how: calls.append(1) or real(*args, **how))
    first = rehearse(done, scan, PRIOR, method, times=2, causes=False, folder=folder)
    more = rehearse(done, scan, PRIOR, method, times=3, causes=False, folder=folder)
    assert len(calls) == 3
    assert more.runs[:2] == first.runs
    kept = read_rehearsal(folder)
    assert kept is not None
    assert kept.runs == more.runs
    assert np.array_equal(kept.matter.values, more.matter.values)
    assert kept.lines() == more.lines()
    table = folder.read_summary()["rehearsal"]
    assert table["word"] == more.word
    assert hs.workflows.load_reconstruction(folder).method == done.method
    rehearsal._keep(folder, replace(more, runs=more.runs[:1]))
    assert read_rehearsal(folder) is None  # one has no spread
    rehearsal._keep(folder, more)

    def stopped(*args, **how):
        raise KeyboardInterrupt

    monkeypatch.setattr(rehearsal, "_shown_by", stopped)
    with pytest.raises(KeyboardInterrupt):
        rehearse(done, scan, PRIOR, method, times=2, bins=2, causes=False, folder=folder)
    assert read_rehearsal(folder) is None  # its map was of the volume that is no longer there
    folder.write_summary(folder.read_summary() | {"rehearsal": {"binned": 1}})
    with pytest.raises(hs.InputError, match="what rehearse wrote"):
        read_rehearsal(folder)


def test_bad_input_is_refused(few):
    done, scan, _ = few
    with pytest.raises(hs.InputError, match="2 rehearsals or more, but it is 1"):
        rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=1)
    with pytest.raises(hs.InputError, match="bins must be 1 pixel or more"):
        rehearse(done, scan, PRIOR, METHODS["ctf-tv"], bins=0)
    with pytest.raises(hs.InputError, match="has no verdict"):
        rehearse(replace(done, verdict=None), scan, PRIOR)
    assert isinstance(done.object, VoxelGrid)
    empty = done.object.with_parameters({"values": torch.zeros_like(done.object.values)})
    with pytest.raises(hs.InputError, match="its volume is empty"):
        rehearse(replace(done, object=empty), scan, PRIOR, METHODS["ctf-tv"])
