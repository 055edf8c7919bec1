"""Measured data of other groups, where they are at hand: what the air of corrected frames and a phase must be."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

import holosplat as hs
from helpers.cli import holosplat, worked
from holosplat.io.nxtomo import read_scan

SHARED = Path(__file__).resolve().parents[3] / "shared/data/real"
pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason="the measured data is not here")

KNOWN = ("--energy-kev", 20, "--distance", 0, "--pixel-size", 42.92e-6, "--axis-column", 42.625)


@pytest.fixture(scope="module")
def capsule(tmp_path_factory) -> Path:
    """The raw frames of the capsule, every tenth, with one flat and one dark, as a data-exchange file."""
    path, raw = tmp_path_factory.mktemp("capsule") / "capsule.h5", np.load(SHARED / "savu_24737_bin2.npz")
    with h5py.File(path, "w") as file:
        file["exchange/data"] = raw["counts"][::10]
        file["exchange/data_white"], file["exchange/data_dark"] = raw["flat"][None], raw["dark"][None]
        file.create_dataset("exchange/theta", data=raw["angles_deg"][::10]).attrs["units"] = "deg"
    return path


def air_of(frames: np.ndarray) -> np.ndarray:
    """Means [V, 2] of the air left and right of the capsule's dome."""
    return np.stack([frames[:, :28, :8].mean((1, 2)), frames[:, :28, -8:].mean((1, 2))], axis=1)


def test_the_air_of_the_capsule_is_one_and_the_method_is_said(capsule, tmp_path):
    """Undivided it drifts about 0.71 of the flat, another on either side; the one flat is too few for the dynamic
    method, which is said."""
    plain, out = tmp_path / "plain.nxs", tmp_path / "dome.nxs"
    worked(holosplat("correct", capsule, *KNOWN, "--normalise", "none", "--out", plain))
    raw = air_of(read_scan(plain).frames)
    assert 0.6 < raw.min() < raw.max() < 0.85
    assert np.abs(raw / raw.mean() - 1).max() > 0.02
    done = worked(holosplat("correct", capsule, *KNOWN, "--sense", "anticlockwise", "--out", out))
    for words in (
        "mean flat field",
        "normalised: air",
        "method plain, for the dynamic one needs three flats",
    ):
        assert words in done.err
    found = read_scan(out)
    np.testing.assert_allclose(air_of(found.frames), 1, atol=0.012)  # the edge of the beam moves into one frame
    assert np.median(np.abs(air_of(found.frames) - 1)) < 0.003
    np.testing.assert_allclose(air_of(found.frames[:, :, 2:]), 1, atol=0.01)
    assert found.provenance["corrected"] == "plain"
    assert set(found.exposures.distance) == {0.0}


def test_the_dome_of_the_capsule_absorbs_some_per_cent(capsule, tmp_path):
    """Dividing by the air must not take the dome for light: its middle is 3 to 10 % darker than the air."""
    out = tmp_path / "dome.nxs"
    worked(holosplat("correct", capsule, *KNOWN, "--crop", "0:28,:", "--out", out))
    middle = read_scan(out).frames[:, 14:26, 34:46].mean((1, 2))
    assert float((1 - middle).min()) > 0.03
    assert float((1 - middle).max()) < 0.10


def test_the_spider_hair_has_a_phase_and_its_air_none():
    """Other programs find a least phase of -1.14 and -1.20 rad. Pixels are averaged two by two here, for speed, which
    takes a tenth away from the narrow tip."""
    frame = tifffile.imread(SHARED / "spider_hair_hologram.tiff").astype(np.float32)
    where = hs.Exposures.of(hs.Views.from_angles([0.0], frame.shape, 104.7e-9), 11.0, 78.88e-3)
    scan = hs.Scan(frame[None], where, np.array([False])).binned(2)
    found = hs.retrieve(scan.frames, scan.exposures, hs.DeltaBeta(1e-6, 1e-9))
    assert found.light.background is not None
    assert float(found.light.background.factor().mean()) == pytest.approx(1.02, abs=0.01)
    phase = found.phase[0].numpy()
    air = np.concatenate([phase[:50], phase[-50:]])
    assert float(np.quantile(phase - np.median(air), 1e-4)) == pytest.approx(-1.05, abs=0.15)
    assert float(air.std()) < 0.05
