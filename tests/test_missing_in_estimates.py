"""Pixels without a value have no weight in estimates of noise, light and material, in alignment and for networks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from helpers.misaligned_balls import MATERIAL
from helpers.misaligned_balls import scan_of as misaligned
from holosplat.align import find_axis
from holosplat.align.derivatives import Normal, Predicted
from holosplat.align.phantom import Linear, solved
from holosplat.align.poses import PoseOptions, PosePrior
from holosplat.align.views import align_still
from holosplat.baselines.material import estimate_delta
from holosplat.beamline.misalignment import Misalignment
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.learning.start import seen_in
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior
from holosplat.methods.method import Task, quiet
from holosplat.optics.air import find_air
from holosplat.optics.background import Light, LightOptions
from holosplat.optics.noise import noise_levels, sure_noise
from holosplat.scan import Exposures, Scan
from holosplat.specimens import random_cells
from holosplat.specimens.scene import MeshScene

WATER = parse_material("water").delta_beta(12.0)
SIDE, VIEWS, NOISE = 48, 16, 0.005


@cache
def scans() -> tuple[Scan, Scan, Scan]:
    """Noisy frames of cells; the same with pixels spoilt that are missing; and with these taken for measured ones."""
    views = Views.evenly_spaced(VIEWS, (32, SIDE), 1e-6)
    scene = MeshScene.of_one_material(random_cells(2, (18e-6, 16e-6, 18e-6), 2), WATER)
    made = simulate(scene, Exposures.of(views, 12.0, 0.05), is_test=np.zeros(VIEWS, bool))
    noise = NOISE * np.random.default_rng(0).standard_normal(made.frames.shape)
    whole = Scan((made.frames + noise).astype(np.float32), made.exposures, made.is_test)
    mask = np.zeros(made.frames.shape, bool)
    mask[:, :, 16:19] = mask[::2, 10:14, 26:32] = mask[:, 2:7, :7] = True
    spoilt = np.where(mask, np.float32(1.4), whole.frames)
    return whole, Scan(spoilt, whole.exposures, whole.is_test, missing=mask), whole_of(spoilt, whole)


def whole_of(frames: np.ndarray, scan: Scan) -> Scan:
    return Scan(frames, scan.exposures, scan.is_test)


def light_of(scan: Scan) -> float:
    found = Light.of(scan.measured, LightOptions("smooth"))
    return float((found.factor() - 1).square().mean().sqrt())


@pytest.mark.parametrize(
    ("estimate", "share"),
    [
        (light_of, 0.3),
        (lambda scan: estimate_delta(scan, WATER.ratio, quiet), 0.2),
    ],
    ids=["light", "delta"],
)
def test_estimates_are_those_of_the_other_pixels(estimate, share):
    whole, sees, counts = (estimate(scan) for scan in scans())
    assert sees == pytest.approx(whole, rel=share)
    assert counts != pytest.approx(whole, rel=2 * share)


def test_missing_pixels_are_no_air_and_do_not_hide_it():
    """Filled pixels are quieter than noise: by these all others would be fringes."""
    rng = np.random.default_rng(1)
    frames = torch.from_numpy(1 + 0.05 * rng.standard_normal((2, 40, 60)))
    frames[:, 12:28, 20:40] = 0.6
    missing = torch.zeros(frames.shape, dtype=torch.bool)
    missing[:, :, 3:15] = True
    filled = frames.masked_fill(missing, 1.0)
    seen, counted = find_air(frames.masked_fill(missing, torch.nan)), find_air(filled)
    assert not (seen & missing).any()
    whole = find_air(frames)
    for part in (slice(0, 3), slice(45, 60)):  # on both sides of the gap
        shares = [float(each[:, :, part].double().mean()) for each in (seen, whole, counted)]
        assert shares[0] > 0.8 * shares[1] > 0.5
        assert shares[2] < 0.3 * shares[1]


def test_noise_is_that_of_pixels_that_have_a_value():
    frames = torch.from_numpy(1 + 0.05 * np.random.default_rng(1).standard_normal((3, 128, 128)))
    spoilt = frames.clone()
    spoilt[:, :32] = 1.0
    known = spoilt.clone()
    known[:, :32] = torch.nan
    for estimate in (noise_levels, sure_noise):
        torch.testing.assert_close(estimate(known), estimate(frames), rtol=0.1, atol=0)
    assert float(noise_levels(spoilt).max()) < 0.5 * 0.05
    noise = [Task(scan, MaterialPrior.known(WATER)).noise.white for scan in scans()[:2]]
    torch.testing.assert_close(noise[1], noise[0], rtol=0.1, atol=0)


def test_networks_see_what_the_other_pixels_say():
    whole, sees, counts = (seen_in(scan, WATER) for scan in scans())
    for n in range(2):  # contrast and thickness
        errors = [float((seen[n] - whole[n]).norm() / whole[n].norm()) for seen in (sees, counts)]
        assert errors[0] < 0.6
        assert errors[0] < 0.3 * errors[1]


def test_the_axis_is_found_without_missing_pixels():
    from align.test_axis import HALF, scan_of  # frames of balls about an axis

    scan = scan_of(HALF, 2.2, noise=0.002)
    mask = np.zeros(scan.frames.shape, bool)
    mask[:, :, 40:43] = mask[::3, :, 20:24] = mask[10:30, 15:25, 25:33] = True
    mask[:, 8:12] = True  # slices that no view sees
    levels = np.random.default_rng(2).uniform(0.5, 0.95, (len(scan), 1, 1))
    spoilt = np.where(mask, levels, scan.frames).astype(np.float32)
    found, counted = (
        find_axis(Scan(spoilt, scan.exposures, scan.is_test, missing=each)).offset for each in (mask, None)
    )
    assert found.value == pytest.approx(2.2, abs=0.1)
    assert abs(counted.value - 2.2) > 1


def test_views_are_found_without_missing_pixels():
    scan, true = misaligned(Misalignment(1.0, 0.0, 0.0, seed=1), count=6, test_every=9)
    mask = np.zeros(scan.frames.shape, bool)
    mask[::2, :, 8:12] = mask[1::2, 20:24, :] = True
    spoilt = Scan(np.where(mask, 1.3, scan.frames).astype(np.float32), scan.exposures, scan.is_test, missing=mask)
    options = PoseOptions(
        rounds=1, edges=0, steps=4, first=10, retrieval=12, uncertain=PosePrior(angle=0, roll=0, flux=0)
    )
    found = align_still(spoilt, MaterialPrior.known(MATERIAL), options)
    away = (found.exposures.views.shifts - true.views.shifts) / scan.views.pixel_size
    assert float(np.sqrt(np.square(away - away.mean(0)).mean())) < 0.35


def test_steps_of_poses_do_not_depend_on_missing_pixels():
    draw = torch.Generator().manual_seed(0)
    measured, frames = (torch.randn(2, 9, 11, generator=draw) for _ in range(2))
    slopes = torch.randn(2, 8, 9, 11, generator=draw)
    missing = torch.zeros(measured.shape, dtype=torch.bool)
    missing[:, 2:4, 5:] = True
    spoilt = slopes.masked_fill(missing[:, None], 9.0)
    known = measured.masked_fill(missing, torch.nan)
    one, other = (Normal.of(known, Predicted(frames, each), 1.0) for each in (slopes, spoilt))
    torch.testing.assert_close(one.information, other.information)
    torch.testing.assert_close(one.slope, other.slope)
    now, expected = (
        (torch.zeros(2, 8).double(), torch.zeros(1).double()),
        (torch.ones(8).double(), torch.ones(1).double()),
    )
    all_of = torch.randn(1, 2, 9, 11, generator=draw).double()
    steps = [
        solved(known, Linear(frames.double(), each.double(), all_of.masked_fill(missing, bad)), now, expected, 1.0)
        for each, bad in ((slopes, 0.0), (spoilt, 7.0))
    ]
    torch.testing.assert_close(steps[0].of_views, steps[1].of_views)
    torch.testing.assert_close(steps[0].of_all, steps[1].of_all)


def test_reversed_beams_keep_their_missing_pixels():
    from holosplat.align.find import _flipped

    mask = np.zeros((2, 3, 4), bool)
    mask[:, 0, 0] = True
    assert _flipped(mask, ["x", ""])[0, 0, 3]
    assert _flipped(mask, ["x", ""])[1, 0, 0]


def test_a_scan_without_missing_pixels_is_measured_as_it_is():
    whole, sees, _ = scans()
    assert torch.equal(whole.measured, torch.from_numpy(whole.frames))
    assert sees.missing is not None
    assert torch.equal(sees.measured.isnan(), torch.from_numpy(sees.missing))
    moved = replace(sees, frames=sees.frames + 1)
    assert float(moved.left(torch.ones(())).abs().max()) < 2
