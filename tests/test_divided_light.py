"""What is not known of light that frames were divided by goes with them, however they are cut, joined and kept."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.divided_light import DividedLight
from holosplat.geometry import Views
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.matter import MaterialPrior
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.optics.background import Background, LightOptions
from holosplat.optics.patterns import smooth_modes
from holosplat.scan import Exposures, Scan
from holosplat.workflows.join import join
from holosplat.workflows.run_illumination import light_of

SHAPE, HALF_WAVES, COUNT = (31, 44), 3, 3
MODES = (HALF_WAVES + 1) ** 2


def light() -> DividedLight:
    """Of three frames, each with another covariance."""
    roots = 0.01 * np.random.default_rng(5).standard_normal((COUNT, MODES, 2))
    covariances = roots @ roots.transpose(0, 2, 1)
    variances = np.full((COUNT, MODES), 1e-4)
    return DividedLight(covariances, variances, np.full(COUNT, 1e-5), SHAPE)


def scan(known: DividedLight | None) -> Scan:
    """Three frames of noise that were divided by that light."""
    frames = 1 + 0.003 * np.random.default_rng(1).standard_normal((COUNT, *SHAPE))
    exposures = Exposures.of(Views.evenly_spaced(COUNT, SHAPE, 1e-6), 20.0, 0.1)
    return Scan(frames.astype(np.float32), exposures, np.arange(COUNT) == 1, light=known)


def doubts(of: Scan) -> np.ndarray:
    """The variance [N, H, W] of the light in every pixel."""
    assert of.light is not None
    known = Background.handed(of.light, of.views.shape)
    modes = known.modes().double().flatten(1)
    return torch.einsum("kp,vkl,lp->vp", modes, known.covariances, modes).reshape(-1, *of.views.shape).numpy()


def whole() -> np.ndarray:
    """The same of whole frames, by the definition."""
    modes = smooth_modes(SHAPE, HALF_WAVES).double().flatten(1).numpy()
    return np.einsum("kp,vkl,lp->vp", modes, light().covariances, modes).reshape(COUNT, *SHAPE)


def near(one: np.ndarray, other: np.ndarray) -> bool:
    """To a few per cent: modes of a part have no slope at its border, where the light has one."""
    return bool(np.abs(one - other).mean() < 0.04 * other.mean())


def test_doubt_lies_where_frames_are_after_choosing_cropping_and_binning():
    full = scan(light())
    assert doubts(full) == pytest.approx(whole(), rel=1e-6)
    assert doubts(full[[2, 0]]) == pytest.approx(whole()[[2, 0]], rel=1e-6)
    part = full.cropped(slice(4, 25), slice(7, 40))
    assert near(doubts(part), whole()[:, 4:25, 7:40])
    coarse = full.binned(2)
    means = whole()[:, :30].reshape(COUNT, 15, 2, 22, 2).mean(axis=(2, 4))
    assert near(doubts(coarse), means)
    assert coarse.light is not None
    assert Background.handed(coarse.light, coarse.views.shape).powers.numpy() == pytest.approx(1e-5 / 4)
    assert near(doubts(full.cropped(slice(4, 24), slice(8, 40)).binned(2)), means[:, 2:12, 4:20])
    assert near(doubts(coarse.cropped(slice(2, 12), slice(4, 20))), means[:, 2:12, 4:20])
    assert full.in_memory().as_static().with_split(full.is_test).with_views(full.views).light is full.light


def test_files_and_beams_that_are_joined_keep_it(tmp_path):
    for n in range(2):
        write_scan(tmp_path / f"{n}.nxs", scan(light()))
    write_scan(tmp_path / "none.nxs", scan(None))
    read = read_scan(tmp_path / "0.nxs")
    assert doubts(read) == pytest.approx(whole(), rel=1e-4)
    join([tmp_path / "0.nxs", tmp_path / "1.nxs"], tmp_path / "two.nxs", flips=("rows", "none"))
    found = doubts(read_scan(tmp_path / "two.nxs"))
    assert found[:3] == pytest.approx(whole()[:, ::-1], rel=1e-3, abs=1e-9)
    assert found[3:] == pytest.approx(whole(), rel=1e-3, abs=1e-9)
    join([tmp_path / "0.nxs", tmp_path / "none.nxs"], tmp_path / "half.nxs")
    assert read_scan(tmp_path / "half.nxs").light is None
    with h5py.File(tmp_path / "0.nxs", "a") as file:
        del file["entry/process/light/powers"]
    with pytest.raises(InputError, match="must be what holosplat correct wrote"):
        read_scan(tmp_path / "0.nxs")


def test_a_reconstruction_may_change_the_light_within_its_doubt():
    task = Task(scan(light()), MaterialPrior.of_ratio(100.0))
    known, certain = prepared(task), prepared(replace(task, scan=scan(None)))
    assert certain.uneven is None
    assert known.uneven is not None
    assert known.scan is task.scan  # was divided before
    assert known.light_in_words.startswith("divided out before")
    more = (known.noise.power() - certain.noise.power()).sum(dim=(1, 2))
    assert bool((more > 0).all())
    assert prepared(replace(task, light=LightOptions("even"))).uneven is None
    beside = light_of(task.scan, LightOptions("smooth"))
    assert beside is not None
    assert torch.equal(beside.factor(), torch.ones(COUNT, *SHAPE, dtype=torch.float64))


def test_light_that_does_not_fit_is_refused():
    with pytest.raises(InputError, match="light of as many"):
        scan(light()[[0, 1]])
    with pytest.raises(InputError, match="square number"):
        DividedLight(np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros(1), SHAPE)
    with pytest.raises(InputError, match="one raster"):
        DividedLight.joined([light(), light().cropped(1, 0)])
