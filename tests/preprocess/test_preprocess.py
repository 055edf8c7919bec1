"""Flat fields, defective pixels, principal components, and the weights that total variation finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.frames import block_means
from holosplat.preprocess import (
    EigenFlats,
    PixelRepair,
    TotalVariationWeights,
    defective_pixels,
    eigen_flats,
    relative_intensity,
    significant,
    unlit,
)
from holosplat.preprocess.eigen_flats import _effective
from holosplat.preprocess.pixels import mean_frame

H, W = 53, 70


def waves(count: int, seed: int = 0) -> np.ndarray:
    """Orthogonal patterns [count, H, W] of mean square 1 and of several pitches."""
    y, x = (np.arange(n) + 0.5 for n in (H, W))
    pairs = [(1, 0), (0, 2), (3, 1), (2, 5), (6, 4), (9, 7)]
    cosines = [np.cos(np.pi * a * y / H)[:, None] * np.cos(np.pi * b * x / W) for a, b in pairs[:count]]
    return np.stack([c / np.sqrt((c**2).mean()) for c in cosines])


def flats(deviations: np.ndarray, frames: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Flats [F, H, W] of mean 100 with components `waves`, and their weights [F, K]."""
    rng = np.random.default_rng(seed)
    weights = deviations * rng.standard_normal((frames, len(deviations)))
    light = 100 + np.tensordot(weights, waves(len(deviations)), 1)
    return light + noise * rng.standard_normal(light.shape), weights


def components(of: np.ndarray, **options: int) -> EigenFlats:
    return eigen_flats(lambda rows: of[:, rows], of.mean((1, 2)), (H, W), **options)


# --- plain


def test_relative_intensity_undoes_gain_and_offset():
    rng = np.random.default_rng(0)
    truth, gain, dark = rng.uniform(0.5, 1.5, (3, H, W))
    assert relative_intensity(truth * gain + dark, dark, gain) == pytest.approx(truth)
    assert unlit(np.array([1.0, 0.0, -1.0, np.nan])).tolist() == [False, True, True, True]


def test_means_are_taken_one_by_one():
    frames = np.random.default_rng(0).uniform(0, 9, (5, 4, 3))
    assert mean_frame(iter(frames), (4, 3)) == pytest.approx(frames.mean(0))
    assert mean_frame([], (4, 3)).tolist() == np.zeros((4, 3)).tolist()


# --- pixels


def test_defects_are_found_and_good_pixels_left():
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:H, :W]
    dark = 100 + 2 * rng.standard_normal((H, W))
    noise = 2 + 0.3 * rng.standard_normal((H, W))
    flat = dark + 900 * np.exp(-((x - 20) ** 2 + y**2) / 3000) * (1 + 0.05 * rng.standard_normal((H, W)))
    assert not defective_pixels(dark, noise, flat).any()
    wrong = np.zeros((H, W), dtype=bool)
    for (i, j), change in {
        (0, 0): "dead",
        (20, 30): "hot",
        (20, 31): "dead",
        (52, 69): "noisy",
        (5, 8): "bright",
    }.items():
        wrong[i, j] = True
        if change == "dead":
            flat[i, j] = dark[i, j]
        elif change == "hot":
            dark[i, j], flat[i, j] = 3000, 3600
        elif change == "noisy":
            noise[i, j] = 60
        else:
            flat[i, j] = dark[i, j] + 4 * (flat[i, j] - dark[i, j])
    assert np.array_equal(defective_pixels(dark, noise, flat), wrong)


def test_repair_takes_the_nearest_good_neighbours():
    mask = np.zeros((6, 7), dtype=bool)
    mask[0, 0] = mask[2:5, 2:5] = True
    y, x = np.mgrid[:6, :7].astype(float)
    plane = 3 * y + 5 * x
    repair = PixelRepair(mask)
    broken = np.where(mask, np.nan, plane)
    broken[mask] = 1e9
    fixed = repair(broken)
    assert np.array_equal(fixed[~mask], plane[~mask])
    assert fixed[0, 0] == pytest.approx(plane[[0, 1, 1], [1, 0, 1]].mean())
    assert fixed[3, 3] == pytest.approx(plane[3, 3])  # of the ring around the patch: linear images are kept
    assert repair.values(broken) == pytest.approx(fixed[mask])
    assert len(repair) == 10
    with pytest.raises(InputError, match="every pixel is defective"):
        PixelRepair(np.ones((2, 3), dtype=bool))


# --- principal components


def test_components_and_their_number_are_found():
    deviations = np.array([6.0, 4.0, 2.0, 1.0])
    drawn, _ = flats(deviations, 80, 1.0)
    found = components(drawn)
    assert len(found) == 4
    overlap = np.einsum("kij,lij->kl", found.components, waves(4)) / (H * W)
    assert np.linalg.svd(overlap, compute_uv=False).min() > 0.99
    gram = np.einsum("kij,lij->kl", found.components, found.components) / (H * W)
    assert gram == pytest.approx(np.eye(4), abs=1e-9)
    assert found.deviations == pytest.approx(deviations, rel=0.35)
    assert found.mean == pytest.approx(drawn.mean(0), rel=2e-3)
    assert len(components(drawn, most=2)) == 2
    assert found.light(np.array([1.0, 0, 0, -2.0])) == pytest.approx(
        found.mean + found.components[0] - 2 * found.components[3]
    )


def test_flats_of_unequal_brightness_are_scaled_and_weighed():
    """Photon noise goes as the root of brightness; it makes no component."""
    rng = np.random.default_rng(4)
    energy = rng.gamma(12, 1 / 12, 60)
    drawn = rng.poisson(400 * energy[:, None, None] * np.ones((H, W))).astype(float)
    found = components(drawn)
    assert len(found) == 0
    assert found.mean == pytest.approx(np.full((H, W), 400.0), rel=0.1)


@pytest.mark.parametrize(("frames", "pixels"), [(20, 300), (60, 4000), (100, 120)])
def test_noise_has_no_components(frames, pixels):
    """Of random frames, few have an eigenvalue that counts (two standard deviations of Tracy and Widom: 3 %)."""
    rng = np.random.default_rng(frames)
    kept = []
    for _ in range(30):
        noise = rng.standard_normal((frames, pixels))
        noise -= noise.mean(0)
        kept.append(significant(np.clip(np.linalg.eigvalsh(noise @ noise.T)[:0:-1], 0, None), pixels))
    assert np.mean(np.array(kept) > 0) <= 0.15


def test_noise_that_neighbours_share_makes_fewer_pixels_and_no_component():
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((70, 40, 60))
    shared = noise + np.roll(noise, 1, 1) + np.roll(noise, 1, 2)
    shared = (shared - shared.mean(0)).reshape(70, -1)
    values = np.linalg.eigvalsh(shared @ shared.T)[:0:-1]
    # For correlations ρ, n_eff = N / Σ ρ²: here 1 + 6 (1/3)².
    assert _effective(values) == pytest.approx(2400 / (1 + 6 / 9), rel=0.1)
    assert significant(values, 2400) <= 1


def test_two_flats_are_the_least():
    with pytest.raises(InputError, match="need two or more"):
        eigen_flats(lambda rows: np.ones((1, 3, 4))[:, rows], np.ones(1), (3, 4))
    assert len(components(np.full((3, H, W), 7.0))) == 0


# --- weights


def fringes(seed: int, strength: float) -> np.ndarray:
    """An object [H, W] of ringing spots on 1."""
    y, x = np.mgrid[:H, :W]
    rng = np.random.default_rng(seed)
    image = np.ones((H, W))
    for i, j in rng.uniform(0.2, 0.8, (4, 2)) * (H, W):
        r2 = (y - i) ** 2 + (x - j) ** 2
        image += strength * np.cos(r2 / 8) * np.exp(-r2 / 60)
    return image


def test_known_weights_are_recovered():
    """Without noise and with a weak object, the weights of a frame come back; nothing else has so little variation."""
    deviations = np.array([8.0, 5.0, 4.0, 3.0])
    truth = EigenFlats(np.full((H, W), 100.0), waves(4), deviations, np.ones(9))
    find = TotalVariationWeights(truth, 1)
    for seed in range(3):
        weights = deviations * np.random.default_rng(seed).uniform(-2, 2, 4)
        empty = find(0.3 * truth.light(weights))
        assert empty == pytest.approx(weights, abs=1e-3 * 8)
        found = find(0.3 * truth.light(weights) * fringes(seed, 0.05))
        assert np.abs(found - weights).max() < 0.3
        assert np.abs(find(0.3 * truth.light(weights) * fringes(seed, 0.05)) - found).max() == 0


def test_strong_objects_fool_least_squares_more_than_total_variation():
    """A shadow with sharp edges overlaps the components; its edges stay whatever the weights are."""
    deviations = np.array([8.0, 5.0, 4.0, 3.0])
    truth = EigenFlats(np.full((H, W), 100.0), waves(4), deviations, np.ones(9))
    find = TotalVariationWeights(truth, 1)
    weights = np.array([5.0, -6.0, 3.0, 2.0])
    shadow = np.ones((H, W))
    shadow[10:30, 15:45] = 0.6
    frame = truth.light(weights) * shadow
    by_squares = find._projected(block_means(frame, 1)) * deviations
    assert np.abs(find(frame) - weights).max() < 0.2 * np.abs(by_squares - weights).max()


def test_the_gradient_of_the_variation_is_its_derivative():
    drawn, _ = flats(np.array([6.0, 4.0, 2.0]), 30, 1.0)
    find = TotalVariationWeights(components(drawn), 2)
    frame = block_means(drawn[0] * fringes(1, 0.3), 2)
    at = np.array([0.3, -0.7, 1.1])
    _, gradient = find._variation(frame, at, 0.01)
    numeric = [
        (find._variation(frame, at + e, 0.01)[0] - find._variation(frame, at - e, 0.01)[0]) / 2e-5
        for e in 1e-5 * np.eye(3)
    ]
    assert gradient == pytest.approx(numeric, rel=1e-5)


def test_binning_is_as_coarse_as_the_weights_let_it():
    few = EigenFlats(np.ones((H, W)), waves(2), np.ones(2), np.ones(9))
    assert TotalVariationWeights(few).binning == 8
    many = EigenFlats(np.ones((H, W)), np.repeat(waves(6), 4, 0), np.ones(24), np.ones(40))
    assert TotalVariationWeights(many).binning == 4
    two_rows = replace(few, mean=few.mean[:2], components=few.components[:, :2])
    assert TotalVariationWeights(two_rows).binning == 1, "rows that a larger bin would leave empty"
    none = EigenFlats(np.ones((H, W)), np.empty((0, H, W)), np.empty(0), np.ones(9))
    assert TotalVariationWeights(none)(np.ones((H, W))).shape == (0,)
    with pytest.raises(InputError, match="binning must leave at least"):
        TotalVariationWeights(few, 40)
    with pytest.raises(InputError, match="binning must be at least 1"):
        TotalVariationWeights(few, 0)
