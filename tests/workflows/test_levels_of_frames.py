"""`correct` keeps the absorption of samples, and says how bright their air is and what frames were divided by."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.cli import holosplat, refused, worked
from holosplat.io.formats import read

SHAPE, N, DARK, LIGHT = (48, 56), 10, 100, 8000
COLUMN = np.arange(SHAPE[1]) - 0.5 * (SHAPE[1] - 1)
ROD = np.exp(-0.9 * np.sqrt(np.clip(1 - (COLUMN / 14) ** 2, 0, None))) * np.ones(SHAPE)
FILLED = np.full(SHAPE, 0.4)
SMOOTH = np.exp(-0.8 - 0.3 * np.sqrt(1 - (COLUMN / 60) ** 2)) * np.ones(SHAPE)


def raw(path: Path, sample: np.ndarray, flats: tuple[float, ...], beam: float = 1.0, changes: float = 0.0) -> Path:
    """Counts behind an absorber, with flats of these brightnesses; changes: of the flats' shape, another in each."""
    rng, ramp = np.random.default_rng(0), np.sin(COLUMN / 9)
    shapes = [1 + 0.1 * ramp + changes * rng.normal() * np.cos(COLUMN / 5) for _ in flats]
    lit = [LIGHT * flat * shape * np.ones(SHAPE) for flat, shape in zip(flats, shapes)]
    frames = [sample * beam * LIGHT * (1 + 0.1 * ramp) for _ in range(N)]
    with h5py.File(path, "w") as file:
        file["counts"], file["flats"] = (rng.poisson(np.array(each)) + DARK for each in (frames, lit))
        file["darks"] = np.rint(rng.normal(DARK, 2, (3, *SHAPE)))
        file["angles_deg"] = 18.0 * np.arange(N)
        file["energy_kev"], file["distance"], file["pixel_size"] = 20.0, 0.0, 3.2e-6
    return path


@pytest.mark.parametrize(
    ("flats", "beam", "changes"),
    [((1, 1, 1.1), 1.0, 0.0), ((1, 1), 1.0, 0.0), ((1, 1, 1), 0.8, 0.0), ((1, 1.3, 0.8, 1.1), 1.0, 0.0)]
    + [((1,) * 8, 1.0, 0.02)],
)
def test_air_is_one_beside_an_absorber(tmp_path, flats, beam, changes):
    done = worked(
        holosplat("correct", raw(tmp_path / "raw.h5", ROD, flats, beam, changes), "--out", tmp_path / "a.nxs")
    )
    found = read(tmp_path / "a.nxs").frames.mean(axis=0)
    assert found[:, :6].mean() == pytest.approx(1, abs=0.01)
    assert found[:, 27:29].mean() == pytest.approx(np.exp(-0.9), abs=0.02)
    assert re.search(r"air is (1\.00|0\.99)", done.err)
    assert ("warning: air" in done.err) == (beam < 0.9)


def test_a_mean_that_hides_absorption_is_said(tmp_path):
    source = raw(tmp_path / "raw.h5", ROD, (1, 1, 1))
    done = worked(holosplat("correct", source, "--normalise", "mean", "--out", tmp_path / "a.nxs"))
    assert "warning: air is 1." in done.err
    assert "divided by its own mean" in done.err


@pytest.mark.parametrize("sample", [FILLED, SMOOTH])
@pytest.mark.parametrize("changes", [0.0, 0.02])
def test_matter_that_fills_the_frames_keeps_its_absorption(tmp_path, sample, changes):
    source = raw(tmp_path / "b.h5", sample, (1,) * 8, changes=changes)
    done = worked(holosplat("correct", source, "--out", tmp_path / "b.nxs"))
    found = read(tmp_path / "b.nxs").frames.mean(axis=(0, 1))
    np.testing.assert_allclose(found, sample[0], rtol=0.03)
    assert "light was not normalised" in done.err


def test_corrected_frames_are_not_written_over(tmp_path):
    (tmp_path / "a.nxs").write_text("mine")
    refused(
        holosplat("correct", raw(tmp_path / "raw.h5", ROD, (1,)), "--out", tmp_path / "a.nxs"), "must be new or empty"
    )
    assert (tmp_path / "a.nxs").read_text() == "mine"
