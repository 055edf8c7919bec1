"""Rehearsals: bias and spread of numbers, intervals, the verdict of three words, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.inference import Decision
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import METHODS
from holosplat.optics import NoiseModel
from holosplat.optics.background import LightOptions
from holosplat.representations import VoxelGrid
from holosplat.workflows import Reconstruction, RunFolder, next_step, rehearsal
from holosplat.workflows.certainty import Factor, centre_and_scale, conformal_quantile, errors_of
from holosplat.workflows.next_step import MISTAKES, NULL, STEPS, compare_causes
from holosplat.workflows.rehearsal import Again, Rehearsal, read_rehearsal, rehearse
from holosplat.workflows.verdict import Verdict

WATER = hs.materials.parse_material("water").delta_beta(20.0)
PRIOR, PIXEL, SHAPE = hs.MaterialPrior.known(WATER), 1e-6, (20, 23)


def scan_of(count: int, photons: float | None = 20000.0) -> hs.Scan:
    views = hs.Views.evenly_spaced(count, SHAPE, PIXEL)
    box = (16e-6, 16e-6, 16e-6)
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(2, box, 5, 9e-6), WATER)
    return hs.simulate(scene, hs.Exposures.of(views, 20.0, 0.03), photons_per_pixel=photons, seed=3)


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


def test_the_conformal_quantile_covers_what_it_says():
    assert conformal_quantile(np.arange(9.0), 0.9) == 8
    assert conformal_quantile(np.arange(8.0), 0.9) == np.inf
    assert conformal_quantile(np.arange(99.0), 0.9) == 89
    draws = np.random.default_rng(0).exponential(size=(2000, 40))
    inside = [each[-1] <= conformal_quantile(each[:-1], 0.9) for each in draws]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.02)


def test_scales_are_root_mean_squares_and_that_of_a_resolution_is_one():
    assert centre_and_scale("total", np.array([0.3, -0.4])) == (0.0, pytest.approx(np.sqrt(0.125)))
    assert centre_and_scale("resolution", np.array([1.0, 3.0])) == (2.0, 1.0)


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

    monkeypatch.setattr(rehearsal, "reconstruct", lambda *args, **how: done)
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

    monkeypatch.setattr(rehearsal, "reconstruct", look)
    rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, causes=False)
    first, second = (each.frames for each in seen)
    assert first.shape == scan.train().frames.shape
    noise, level = (first - second) / np.sqrt(2), NoiseModel.of_frames(scan.train().measured).level
    assert noise.std() == pytest.approx(float(level.square().mean().sqrt()), rel=0.1)
    predicted = hs.workflows.render(done, scan.train().exposures)
    assert np.std(0.5 * (first + second) - predicted) == pytest.approx(noise.std() / np.sqrt(2), rel=0.15)


def test_larger_pixels_are_rehearsed_on_measured_frames_of_such_pixels(few, monkeypatch):
    done, scan, _ = few
    seen = []

    def look(frames, **how):
        seen.append(frames.views.shape)
        return done

    monkeypatch.setattr(rehearsal, "reconstruct", look)
    shown = rehearse(done, scan, PRIOR, METHODS["ctf-tv"], times=2, bins=2, causes=False)
    assert seen == [(10, 11)] * 3
    assert shown.pixel == pytest.approx(2 * PIXEL)


def made(own: float, left: float, allowed: float, good: bool, cause: Decision | None = None) -> Rehearsal:
    """A run whose only band has a residual `own`, and rehearsals that leave `left`."""
    powers = {name: np.full((2, 1), value) for name, value in (("residual", own), ("allowed", allowed))}
    powers |= {name: np.ones((2, 1)) for name in ("noise", "contrast")}
    said = Verdict(good, "words", (), np.array([[2e-6, np.inf]]), **powers, tested={}, cause="" if good else "mass")
    runs = [{"residual": [left], "cause": ""}, {"residual": [left], "cause": "mass"}]
    return Rehearsal(1, PIXEL, said, tuple(runs), cause=cause)


def test_the_three_words(monkeypatch):
    factor = Factor(0.0, 1.5, 99)
    monkeypatch.setattr(rehearsal, "factors", lambda: {"residual": factor})
    assert made(1.0, 0.5, 1.0, True).word == "consistent"
    assert made(3.0, 2.5, 1.0, False).word == "limited"
    assert made(3.0, 0.5, 1.0, False).word == "wrong"
    assert made(3.0, 0.5, 1.0, False).excess == (pytest.approx(3.0), 0)
    assert made(3.0, 2.5, 1.0, False, Decision("", "angles", "")).word == "wrong"
    assert made(3.0, 2.5, 1.0, False, Decision("", NULL, "")).word == "limited"
    assert not made(3.0, 2.5, 1.0, False).doubtful
    alone = made(3.0, 2.5, 1.0, False)
    assert replace(alone, runs=tuple({**run, "cause": ""} for run in alone.runs)).doubtful


def test_rehearsals_are_kept_and_only_those_that_are_missing_are_made(tmp_path, monkeypatch):
    scan, method, folder = scan_of(4), METHODS["ctf-tv"], RunFolder(tmp_path / "run")
    done = hs.reconstruct(scan, PRIOR, method, folder=folder)
    assert read_rehearsal(folder) is None
    calls = []
    real = rehearsal.reconstruct
    monkeypatch.setattr(rehearsal, "reconstruct", lambda *args, **how: calls.append(1) or real(*args, **how))
    first = rehearse(done, scan, PRIOR, method, times=2, causes=False, folder=folder)
    more = rehearse(done, scan, PRIOR, method, times=3, causes=False, folder=folder)
    assert len(calls) == 3
    assert more.runs[:2] == first.runs
    kept = read_rehearsal(folder)
    assert kept is not None
    assert kept.runs == more.runs
    assert kept.lines() == more.lines()
    table = folder.read_summary()["rehearsal"]
    assert table["word"] == more.word
    assert hs.workflows.load_reconstruction(folder).method == done.method
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


def test_every_mistake_has_a_command():
    assert {key for key, _ in MISTAKES.values()} <= STEPS.keys()


@pytest.mark.slow
def test_mistakes_are_found_on_held_out_frames_and_none_where_there_is_none(monkeypatch):
    scan, method = scan_of(12), METHODS["paganin-tv"]
    few = ("other sign of δ", "twice the angles", "matter beyond the field")
    monkeypatch.setattr(next_step, "MISTAKES", {name: MISTAKES[name] for name in few})
    again = Again(PRIOR, method, 0, hs.reconstruct(scan, PRIOR, method))
    halved, _ = MISTAKES["half the angles"][1](scan, again)
    found = compare_causes(halved, again)
    assert found.choice == "angles"
    assert [each.name for each in found.compared] == ["other sign of δ", "twice the angles"]
    assert compare_causes(scan, again).choice == NULL
    other = MaterialPrior.known(DeltaBeta(-WATER.delta, -WATER.beta))
    assert compare_causes(scan, replace(again, prior=other)).choice == "sign"
    assert compare_causes(scan[np.arange(3)], again).choice == NULL


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["", "half the angles"])
def test_the_verdict_separates_right_and_wrong_scans(wrong, few, monkeypatch):
    """By the shipped factors; the cause is compared by one mistake, beside the right one."""
    tried = ("other sign of δ", "twice the angles")
    scan, method = scan_of(12, 50000.0), METHODS["holographic-tv"]
    if wrong:
        scan, _ = MISTAKES[wrong][1](scan, Again(PRIOR, method, 0, few[0]))
    monkeypatch.setattr(next_step, "MISTAKES", {name: MISTAKES[name] for name in tried})
    shown = rehearse(hs.reconstruct(scan, PRIOR, method), scan, PRIOR, method, times=2)
    assert (shown.word == "wrong") == bool(wrong)
    if wrong:
        assert shown.cause is not None
        assert shown.cause.choice == "angles"


def test_smooth_light_without_air_is_refused():
    with pytest.raises(hs.InputError, match="shows no air"):
        hs.reconstruct(scan_of(12), PRIOR, METHODS["paganin-tv"], light=LightOptions("smooth"))
