"""Still light: what all frames have in common beside their matter, found by those for training and divided out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.cli import holosplat, refused, worked
from holosplat.checks import InputError
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.optics.patterns import smooth_modes
from holosplat.projectors.voxels import SliceProjector
from holosplat.units import wavenumber
from holosplat.workflows.run_illumination import FixedPatternOptions, flatfield_corrected

SHAPE, COUNT, PIXEL = (5, 31), 15, 2e-5
MATERIAL = hs.DeltaBeta(1e-6, 1e-9)
PRIOR = hs.MaterialPrior.known(MATERIAL)
HELD_OUT = np.arange(COUNT) % 5 == 2


def light(order: int) -> np.ndarray:
    """Some light [H, W] of geometric mean 1; order 0: another factor in each pixel."""
    if order == 0:
        logarithm = 0.02 * np.random.default_rng(3).standard_normal(SHAPE)
        return np.exp(logarithm - logarithm.mean())
    modes = smooth_modes(SHAPE, order)[1:].numpy()
    return np.exp(np.tensordot(np.linspace(0.06, -0.05, len(modes)), modes, axes=1))


def a_scan(factor: np.ndarray) -> hs.Scan:
    """Frames in contact of two discs that turn, some held out, times a factor [H, W]."""
    views = hs.Views.evenly_spaced(COUNT, SHAPE, 1.0)
    grid = hs.Grid.of_views(views)
    x, _, z = np.meshgrid(*grid.axes(), indexing="ij")
    inside = ((x + 5) ** 2 + (z - 3) ** 2 < 36) | ((x - 7) ** 2 + (z + 4) ** 2 < 16)
    projector = SliceProjector(grid, views)
    solid = torch.from_numpy(np.asarray(inside, dtype=np.float32).transpose(2, 1, 0).copy())
    lines = projector.lines_out(projector.project(projector.volume_in(solid))).numpy() * PIXEL
    exposures = hs.Exposures.of(replace(views, pitch=PIXEL), 20.0, 0.0)
    frames = np.exp(-2 * wavenumber(20.0) * MATERIAL.beta * lines)
    return hs.Scan(frames * factor, exposures, HELD_OUT)


@pytest.mark.parametrize(("order", "left"), [(2, 0.02), (0, 0.35)])
def test_held_out_frames_lose_the_light_of_those_for_training(order, left):
    """What is left of light, as a share of it; pixel by pixel, errors of the volume are in it, too."""
    clean, shone = a_scan(np.ones(SHAPE)), a_scan(light(order))
    found = flatfield_corrected(shone, PRIOR, FixedPatternOptions(order, inside=14 * PIXEL))

    def unlike(scan: hs.Scan) -> float:
        return float(np.log(scan.test().frames / clean.test().frames).std())

    assert unlike(found) < left * unlike(shone)
    np.testing.assert_array_equal(found.is_test, HELD_OUT)
    assert "divided out" in found.provenance["still_light"]


def test_held_out_frames_say_nothing_of_the_light():
    shone = a_scan(light(2))
    frames = shone.frames.copy()
    frames[HELD_OUT] = 0.5
    other = replace(shone, frames=frames)
    one, two = (flatfield_corrected(scan, PRIOR, FixedPatternOptions(2)).train().frames for scan in (shone, other))
    np.testing.assert_array_equal(one, two)


def test_one_frame_has_no_still_light():
    with pytest.raises(InputError, match="at least 2 frames"):
        flatfield_corrected(a_scan(light(2))[[0]], PRIOR, FixedPatternOptions(2))
    with pytest.raises(InputError, match="order must not be negative"):
        FixedPatternOptions(-1)


def test_the_command_reads_frames_when_they_are_asked_for_and_says_what_it_found(tmp_path: Path):
    write_scan(tmp_path / "scan.nxs", a_scan(light(2)))
    source, out = tmp_path / "scan.nxs", tmp_path / "even.nxs"
    done = worked(holosplat("convert", source, out, "--to", "nxtomo", "--still-light", 2, "--delta-beta", 1000))
    assert "still light: " in done.err
    clean = a_scan(np.ones(SHAPE)).frames
    found = np.log(read_scan(out).frames / clean).std()
    assert found < 0.5 * np.log(a_scan(light(2)).frames / clean).std()
    refused(
        holosplat("convert", source, tmp_path / "other.nxs", "--to", "nxtomo", "--inside", 1e-4),
        "--inside needs --still-light",
    )
