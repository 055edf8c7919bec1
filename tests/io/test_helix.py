"""Helical scans: frames that move along the axis while the object turns, as parts of taller frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.cli import holosplat, worked
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.io.formats import read, read_as
from holosplat.io.larger_frames import heightened, of_parts
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Reading
from holosplat.metrics import volume_scores
from holosplat.optics.retrieval import paganin, tikhonov
from holosplat.scan import Exposures, Scan

PIXEL = 1e-6
WATER = hs.materials.parse_material("water").delta_beta(20.0)


def helix(count: int, shape: tuple[int, int], rows: float, turns: float = 1.0) -> Views:
    """Views over so many turns, of which the last is seen `rows` lower than the first."""
    part = np.linspace(0, 1, count)
    views = Views.from_angles(360 * turns * part, shape, PIXEL)
    return replace(views, shifts=PIXEL * np.stack([np.full(count, 0.3), rows * (part - 0.4)], 1))


def scan_of(views: Views, frames: np.ndarray | None = None, missing: np.ndarray | None = None) -> Scan:
    """Even frames, or those given."""
    frames = np.ones((len(views), *views.shape)) if frames is None else frames
    return Scan(frames, Exposures.of(views, 20.0, 0.02), np.zeros(len(views), dtype=bool), missing=missing)


@pytest.fixture(scope="module")
def scene() -> hs.MeshScene:
    cells = hs.specimens.random_cells(5, box=(14e-6, 34e-6, 14e-6), seed=2)
    return hs.MeshScene.of_one_material(cells, WATER)


def test_frames_are_parts_of_taller_ones_at_their_place(scene):
    """What the taller views show, cut to a frame, is what the view of the frame shows, to rounding."""
    views = helix(7, (15, 22), 23.4)
    frames = np.random.default_rng(0).random((7, 15, 22)).astype(np.float32)
    missing = frames > 0.95
    scan = scan_of(views, frames, missing)
    tall = heightened(scan)
    assert tall.views.shape == (15 + 23, 22)
    assert np.abs(tall.views.shifts[:, 1] - tall.views.shifts[:, 1].mean()).max() <= PIXEL
    assert tall.missing is not None
    first = [int(np.flatnonzero(~gaps.all(1))[0]) for gaps in tall.missing]
    assert first[0] == 0
    assert first[-1] == 23
    for v, row in enumerate(first):
        inside = slice(row, row + 15)
        assert np.array_equal(tall.frames[v, inside], frames[v])
        assert np.array_equal(tall.missing[v, inside], missing[v])
        assert tall.missing[v].sum() == missing[v].sum() + 23 * 22
        assert np.array_equal(tall.frames[v, :row], np.broadcast_to(frames[v, 0], (row, 22)))
        whole, part = (scene.project(one.views[[v]])[1].numpy() for one in (tall, scan))
        np.testing.assert_allclose(whole[:, inside], part, rtol=0, atol=1e-9 * part.max())
    again = of_parts(tall.exposures, tall, scan).views
    assert again.shape == views.shape
    np.testing.assert_allclose(again.shifts, views.shifts, rtol=0, atol=1e-9 * PIXEL)
    assert tall.provenance["heightened"] == "a helix"


TILTED = Views.from_rotations(rotation_tilted([0.0, 60.0, 120.0], [10.0, 20.0, 30.0]), (9, 12), PIXEL)


@pytest.mark.parametrize(
    "views",
    [
        helix(6, (15, 22), 14.9),  # the middle row is in all frames
        replace(TILTED, shifts=PIXEL * np.array([[0.0, -20.0], [0.0, 0.0], [0.0, 20.0]])),
        replace(helix(6, (15, 22), 30.0), sources=np.full(6, 1e-3)),
    ],
    ids=["short", "tilted", "cone"],
)
def test_other_scans_stay_as_they_are(views):
    scan = scan_of(views)
    assert heightened(scan) is scan
    assert of_parts(scan.exposures, scan, scan).views.shifts.tolist() == views.shifts.tolist()


def test_a_series_stays_as_it_is():
    scan = scan_of(helix(6, (15, 22), 30.0))
    series = scan.taken(replace(scan.exposures, time=np.repeat([0.0, 1.0, 2.0], 2)))
    assert heightened(series) is series


@pytest.mark.parametrize("method", [paganin, tikhonov])
def test_phase_retrieval_takes_rows_without_values_for_a_smaller_frame(method, scene):
    """As if each frame were alone: what is beyond it does not pull what is at its edges down to nothing."""
    views = helix(4, (17, 24), 20.0)
    scan = hs.simulate(scene, Exposures.of(views, 20.0, 0.02), is_test=np.zeros(4, dtype=bool))
    tall = heightened(scan)
    alone = method(torch.from_numpy(scan.frames), scan.exposures, *WATER)
    found = method(torch.from_numpy(tall.frames), tall.exposures, *WATER, missing=tall.gaps)
    assert tall.missing is not None
    for v, gaps in enumerate(tall.missing):
        first, last = np.flatnonzero(~gaps.all(1))[[0, -1]]
        part = found[v, first : last + 1]
        assert torch.allclose(part, alone[v], rtol=1e-4, atol=1e-4 * float(alone.abs().max()))
        assert torch.equal(found[v, :first], part[:1].expand(int(first), -1))
        assert torch.equal(found[v, last + 1 :], part[-1:].expand(len(gaps) - int(last) - 1, -1))


@pytest.mark.usefixtures("plain_light", "unjudged_runs")
def test_a_helix_is_reconstructed_in_all_rows_that_it_sees(scene):
    """Beside a planar scan of as many photons; and a volume as tall as one frame lacks most of the cells."""
    grid, errors = Grid.centred((24, 44, 24), PIXEL), {}
    turning = helix(32, (20, 24), 26.0, turns=1.5)
    turning = replace(turning, shifts=turning.shifts - turning.shifts.mean(0))
    for name, views in {"planar": Views.evenly_spaced(14, (46, 24), PIXEL), "helix": turning, "low": turning}.items():
        scan = hs.simulate(
            scene,
            Exposures.of(views, 20.0, 0.02),
            photons_per_pixel=2e4,
            seed=1,
            is_test=np.zeros(len(views), dtype=bool),
        )
        found = hs.reconstruct(
            scan if name == "low" else heightened(scan), hs.MaterialPrior.known(WATER), hs.Surfaces().with_effort(0.3)
        )
        errors[name] = volume_scores(found.object.voxelise(grid), scene.voxelise(grid)).relative_error_delta
    assert max(errors["planar"], errors["helix"]) < min(0.1, 0.5 * errors["low"]), errors


def test_a_file_is_read_as_taller_frames_and_aligned_as_its_own(tmp_path: Path, scene):
    views = helix(20, (24, 24), 25.0, turns=1.2)
    away = PIXEL * np.random.default_rng(3).normal(size=(20, 2))
    moved = replace(views, shifts=views.shifts + away)
    scan = hs.simulate(scene, Exposures.of(moved, 20.0, 0.02), is_test=np.zeros(20, dtype=bool))
    write_scan(tmp_path / "helix.nxs", scan.taken(replace(scan.exposures, views=views)))
    assert read_as(tmp_path / "helix.nxs", Reading()).views.shape == (24 + 25, 24)
    said = holosplat("info", tmp_path / "helix.nxs").out
    assert "20 projections of 49 × 24 pixels" in said
    assert "half a turn on" not in said  # no two of these are opposite (tests/planning/test_seen.py has such)
    done = holosplat(
        "align", tmp_path / "helix.nxs", "--material", "water", "--uncertain-angle", 0, "--uncertain-roll", 0,
        "--out", tmp_path / "found.nxs",
    )  # fmt: skip
    worked(done)
    found = read(tmp_path / "found.nxs")
    assert found.views.shape == (24, 24)
    assert np.array_equal(found.frames, scan.frames)
    left, gauge = found.views.shifts - moved.shifts, views.rotations[:, :2]  # the object may be moved
    near = np.abs(left).max(1) < 2 * PIXEL
    assert near.sum() >= 19  # one view of these is lost
    move = np.linalg.lstsq(gauge[near].reshape(-1, 3), left[near].reshape(-1), rcond=None)[0]
    assert np.abs(left - gauge @ move)[near].max() < 0.05 * PIXEL < 0.1 * away.std()
