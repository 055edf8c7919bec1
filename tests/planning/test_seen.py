"""What frames say of what a run takes: windows about their matter, and noise, beside what was measured."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.methods import METHODS, Auto
from holosplat.model import measure
from holosplat.optics.propagation import poisson
from holosplat.planning import scan_facts as looking
from holosplat.planning.needs import UNSEEN, Needs, Seen, Sizes, of_reconstruction
from holosplat.planning.scan_facts import opposite_likeness, seen_of
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import evans_fung_cell
from holosplat_bench.suite.case import load_case

DATA = Path(__file__).resolve().parents[2] / "docs/data"
ONE_BODY = [
    row
    for row in csv.DictReader((DATA / "sizes.csv").open(encoding="utf-8"))
    if row["bodies"] == "1" and row["commit"] == "7c8f85e"
]
"""Runs in windows."""
WHOLE = [
    row
    for row in csv.DictReader((DATA / "sizes.csv").open(encoding="utf-8"))
    if row["bodies"] == "24" and row["method"] == "auto"
]
IN_NOISE = [
    row
    for row in csv.DictReader((DATA / "few_photons.csv").open(encoding="utf-8"))
    if row["commit"] in ("cc24a9cf77", "3f273ac89f") and float(row["noise"]) > Auto().gaussians.volume.noisy
]
GIB = 2**30


def scan_of_one(pixels: int, pitch: float) -> Scan:
    """A cell of 64 µm in twelve frames, and one that is held out."""
    cell = evans_fung_cell(64e-6)
    surface = SurfaceMesh(
        torch.tensor(cell.vertices / pitch), torch.tensor(cell.faces), pitch, Matter.one(7.4e-7, 2.6e-10)
    )
    exposures = Exposures.of(Views.evenly_spaced(13, (pixels, pixels), pitch), 20.0, 0.1)
    with torch.no_grad():
        frames = measure(surface, exposures).numpy()
    return Scan(frames, exposures, np.arange(13) == 12)


@pytest.mark.parametrize("row", ONE_BODY, ids=lambda row: row["pixels"])
def test_runs_in_windows_take_what_was_measured(row):
    """Memory within a factor of 1.5 above and 0.8 below, and time within one of 1.5."""
    scan = scan_of_one(int(row["pixels"]), 1e-6 * float(row["pitch_um"]))
    whole = Sizes.of(scan.train().exposures)

    said = of_reconstruction(whole, Auto(), "levels", seen_of(scan, Auto()))

    assert 0.8 < said.memory / GIB / float(row["peak_gib"]) < 1.5
    assert 1 / 1.5 < said.seconds / float(row["cpu_seconds"]) < 1.5
    assert said.seconds < 0.6 * of_reconstruction(whole, Auto(), "levels").seconds
    assert said.most_seconds >= said.seconds  # where surfaces of coarse pixels show too little


@pytest.mark.parametrize("row", WHOLE, ids=lambda row: row["pixels"])
def test_runs_on_whole_frames_take_what_was_measured(row):
    """Processor time within a factor of 1.5, of 24 bodies."""
    shape = (int(row["pixels"]), int(row["pixels"]))
    exposures = Exposures.of(Views.evenly_spaced(12, shape, 1e-6 * float(row["pitch_um"])), 20.0, 0.1)
    said = of_reconstruction(Sizes.of(exposures), Auto(), "levels")
    assert 1 / 1.5 < said.seconds / float(row["cpu_seconds"]) < 1.5


@pytest.mark.parametrize("row", IN_NOISE, ids=lambda row: f"{row['scene']}-{row['seed']}")
def test_runs_in_noise_take_a_time_within_what_is_said(row):
    case = load_case(row["scene"].partition("@")[0])
    sizes = Sizes.of(case.exposures[~case.is_test])

    said = of_reconstruction(sizes, Auto(), "levels", Seen(noisy=True))

    assert said.seconds / 1.5 < float(row["seconds"]) < 1.5 * said.most_seconds


def test_what_is_not_known_of_matter_takes_what_either_kind_takes():
    """A run whose matter was not told took five times what was said, for noise was told of bodies alone."""
    sizes = Sizes.of(scan_of_one(96, 3.2e-6).train().exposures)
    levels, continuous, either = (
        of_reconstruction(sizes, Auto(), kind, Seen(noisy=True)) for kind in ("levels", "continuous", None)
    )
    assert levels.most_seconds > levels.seconds > of_reconstruction(sizes, Auto(), "levels").seconds
    assert either.seconds == min(levels.seconds, continuous.seconds)
    assert either.most_seconds == max(levels.most_seconds, continuous.most_seconds)
    assert either.memory == max(levels.memory, continuous.memory)


def test_noise_is_seen_where_surfaces_begin_as_in_noise():
    scan = scan_of_one(48, 3.2e-6)
    noisy = replace(scan, frames=poisson(scan.frames, 300.0, 0))

    assert seen_of(scan, Auto()) == UNSEEN
    assert seen_of(noisy, Auto()) == Seen(noisy=True)
    assert seen_of(noisy, METHODS["tikhonov-tv"]) == UNSEEN


def test_what_works_on_whole_frames_and_what_is_too_much_is_not_looked_at(monkeypatch):
    scan = scan_of_one(256, 1.6e-6)
    assert seen_of(scan, Auto()).windows is not None
    assert seen_of(scan, Auto(), whole=True).windows is None
    monkeypatch.setattr(looking, "MOST_PIXELS", 10 * 256 * 256)
    assert seen_of(scan, Auto()) == UNSEEN


def test_only_surfaces_take_turns():
    sizes = Sizes.of(scan_of_one(48, 3.2e-6).exposures)
    for method, kind in ((METHODS["gaussians"], "levels"), (Auto(), "continuous")):
        said = of_reconstruction(sizes, method, kind, Seen(noisy=True))  # type: ignore[arg-type]
        plain = of_reconstruction(sizes, method, kind)  # type: ignore[arg-type]
        assert said == replace(plain, most_seconds=said.most_seconds)
        assert said.most_seconds <= plain.most_seconds  # trial fits have no rounds of agreement in noise


def test_there_is_something_to_compare_with():
    """Rows of the tables are chosen by their commit, and a table measured anew has another one."""
    assert min(map(len, (ONE_BODY, WHOLE, IN_NOISE))) >= 3


def test_a_range_is_said_in_words():
    assert Needs(4e8, 1e6, 20, 80).line().endswith("and about 20 to 80 s of processor time")
    assert Needs(4e8, 1e6, 20, 21).line().endswith("and about 20 s of processor time")
    assert Needs(4e8, 1e6, 20, 190).times(2).line().endswith("and about 40 s to 6 min of processor time")


@pytest.mark.parametrize("column", [11.5, 7.5, 13.25])
def test_frames_half_a_turn_apart_are_mirrored_about_the_right_axis(column):
    """Of a bump 3 columns from the axis; none of three views without such a pair, or of other heights."""
    columns, rows = np.arange(24), np.arange(20)[:, None]
    bumps = [1 - 0.2 * np.exp(-((columns - column - off) ** 2 + (rows - 9) ** 2) / 12) for off in (3, 1, -3)]
    frames = np.stack(bumps).astype(np.float32)
    views = Views.from_angles([0, 90, 180], (20, 24), 1e-6)
    assert opposite_likeness(views.about_column(column), frames) == pytest.approx(1, abs=0.01)
    beside = opposite_likeness(views.about_column(column + 3), frames)
    assert beside is not None
    assert beside < 0.6
    assert opposite_likeness(Views.from_angles([0, 60, 120], (20, 24), 1e-6), frames) is None
    risen = replace(views, shifts=np.array([[0, 0], [0, 5e-6], [0, 10e-6]]))
    assert opposite_likeness(risen.about_column(column), frames) is None  # of a helix: frames of other heights
