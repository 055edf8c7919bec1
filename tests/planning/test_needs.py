"""What a job takes, before it starts: of the sizes of its arrays, held against what there is."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from helpers.cli import holosplat
from holosplat.beamline.simulate import Simulation
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.methods import METHODS, Auto, Gaussians
from holosplat.planning import needs
from holosplat.planning.acts import of_simulation
from holosplat.planning.needs import (
    Costs,
    Needs,
    Sizes,
    of_choice,
    of_fit,
    of_ratio,
    of_reconstruction,
    require_room,
)
from holosplat.planning.scan_facts import smaller
from holosplat.scan import Exposures

DATA = Path(__file__).resolve().parents[2] / "docs/data"
TABLE = DATA / "needs.csv"


def exposures(shape: tuple[int, int], views: int, pixel: float) -> Exposures:
    return Exposures.of(Views.evenly_spaced(views, shape, pixel), 20.0, 0.1)


@pytest.mark.parametrize("row", list(csv.DictReader(TABLE.open())), ids=lambda row: f"{row['method']}{row['rows']}")
def test_what_is_said_is_near_what_was_measured(row):
    """Within a factor of 1.5 above, and 0.8 below, of an estimate, or of the range that frames decide in."""
    frames = exposures((int(row["rows"]), int(row["columns"])), int(row["views"]), float(row["pixel"]))
    if row["method"] == "simulate":
        said = of_simulation(frames, Simulation().samples(frames), len(frames))
    else:
        said = of_reconstruction(Sizes.of(frames), METHODS[row["method"]])
    measured = float(row["measured_mb"])
    assert said.memory / 1e6 / measured > 0.8
    assert (said.least_memory or said.memory) / 1e6 / measured < 1.5


def test_sizes_are_those_of_the_waves():
    """8.6 µm at 20 keV and 0.1 m: six samples along a pixel; binned twice, pixels are larger and as few fewer."""
    frames = exposures((48, 65), 5, 8.6e-6)
    sizes, half = Sizes.of(frames), Sizes.of(frames, 2)
    assert (sizes.samples, sizes.pixels, sizes.voxels) == (6, 5 * 48 * 65, 48 * 65 * 65)
    assert (half.rows, half.columns, half.samples) == (24, 32, 8)
    rows, columns = (n + 2 * m for n, m in zip((48, 65), sizes.margin))
    assert sizes.waves(1) == 5 * rows * columns * 49
    assert sizes.joined(48 * 65 * 65 // 8).rows == 24


@pytest.mark.parametrize("name", list(METHODS))
def test_more_of_everything_takes_more(name):
    """Of every method on the command line, in memory, on the disk and in time."""
    small, views, large = (
        of_reconstruction(Sizes.of(exposures(*each)), METHODS[name])
        for each in (((300, 310), 4, 1.6e-6), ((300, 310), 40, 1.6e-6), ((400, 410), 4, 1.6e-6))
    )
    for other in (views, large):
        assert other.memory > small.memory
        assert other.disk > small.disk
        assert other.seconds >= small.seconds
    assert views.seconds > small.seconds or large.seconds > small.seconds or name == "neural-field"


def test_fewer_views_a_step_and_a_random_start_take_less():
    sizes, plain = Sizes.of(exposures((200, 210), 40, 3.2e-6)), Gaussians()
    batched = replace(plain, fit=replace(plain.fit, schedule=replace(plain.fit.schedule, views_per_step=2)))
    of = [of_fit(sizes, method).memory for method in (plain, batched, replace(batched, start="random"))]
    assert of[0] >= of[1] > of[2]


def test_gaussians_that_fill_surfaces_of_large_frames_have_finer_waves():
    """512 × 512 pixels: as measured on cells in a fiftieth of the field (docs/data/sizes.csv), within a half."""
    sizes, method = Sizes.of(exposures((512, 512), 12, 0.8e-6)), METHODS["gaussians"]
    assert isinstance(method, Gaussians)
    said = of_reconstruction(sizes, method)
    assert said.memory > Costs.waves * sizes.waves(1)
    assert 0.8 < said.memory / 2.8e9 < 1.5
    without = replace(method, coarse=replace(method.coarse, columns=0))
    assert of_reconstruction(sizes, without).disk < said.disk / 3
    larger = Sizes.of(exposures((1024, 1024), 12, 0.4e-6))
    assert of_reconstruction(larger, method).memory > 1.5 * of_reconstruction(larger, without).memory


def test_auto_takes_what_the_larger_of_its_methods_takes():
    sizes = Sizes.of(exposures((250, 250), 4, 1.6e-6))
    levels, continuous, unknown = (of_reconstruction(sizes, Auto(), kind) for kind in ("levels", "continuous", None))
    assert unknown.memory == max(levels.memory, continuous.memory)
    assert unknown.least_memory == min(levels.least_memory, continuous.memory)
    assert unknown.seconds == min(levels.seconds, continuous.seconds)
    assert unknown.most_seconds == max(levels.most_seconds, continuous.most_seconds)
    alone, told = of_fit(sizes, Auto(), "levels"), of_reconstruction(sizes, Auto(), "levels", ratio_told=False)
    assert levels.most_seconds == alone.most_seconds + of_choice(sizes, Auto())  # light is decided, too
    assert told.most_seconds == levels.most_seconds + of_ratio(sizes)
    assert told.seconds == levels.seconds
    assert levels != continuous


def test_fits_that_decide_take_longer_in_more_folds_and_none_with_few_views():
    few, four, many = (of_choice(Sizes.of(exposures((48, 60), views, 1e-6)), Auto()) for views in (2, 4, 60))
    assert few == 0
    assert 0 < four < many


def test_bodies_that_coarse_pixels_show_take_less_than_those_that_they_do_not():
    """A single view of 128 × 128 pixels whose surfaces did not explain it took 1.6 GB; 24 views that they did, 0.9."""
    single, cells = (
        of_reconstruction(Sizes.of(exposures((128, 128), views, 3.2e-6)), Auto(), "levels") for views in (1, 18)
    )
    assert single.memory > 1.5e9
    assert cells.least_memory < 0.9e9
    assert single.most_seconds > 2 * single.seconds
    assert "to 1.6 GB of memory" in cells.line()


def test_nothing_is_said_of_methods_of_ones_own():
    @dataclass(frozen=True)
    class Own:
        kind: ClassVar[str] = "own"

    assert of_reconstruction(Sizes.of(exposures((20, 30), 2, 1e-6)), Own()) is None


@pytest.fixture
def little(monkeypatch) -> None:
    """A machine with a gigabyte of memory and 100 MB of disk free."""
    monkeypatch.setattr(needs, "free_memory", lambda: 1e9)
    monkeypatch.setattr(needs, "free_disk", lambda path: 1e8)


@pytest.mark.parametrize(("memory", "disk", "fits"), [(1.2e9, 9e7, True), (1.4e9, 9e7, False), (1e9, 1.1e8, False)])
def test_a_job_has_to_fit_in_memory_and_disk(little, tmp_path, memory, disk, fits):
    if fits:
        require_room(Needs(memory, disk), tmp_path)
        return
    with pytest.raises(
        InputError, match=r"the job takes about .* but 1\.4 GB of memory and 100 MB of disk are free; take"
    ):
        require_room(Needs(memory, disk), tmp_path)


def test_what_would_fit_is_said(little, tmp_path):
    """The first of larger voxels in the start, larger pixels, and both; not pixels that leave too few columns."""
    frames = exposures((48, 64), 5, 8.6e-6)
    whole = of_reconstruction(Sizes.of(frames), Gaussians(), "levels")
    with pytest.raises(InputError, match=r"free; --set volume\.refine=1 takes \d+ MB and \d+ MB\.") as said:
        require_room(whole, tmp_path, smaller(frames, Gaussians(), "levels"))
    assert str(said.value).startswith("the job takes about 3")
    ways = [how for how, _ in smaller(exposures((20, 30), 2, 1e-6), Auto(), None)]
    assert ways == [f"{flag}gaussians.volume.refine=1" if "set" in flag else flag for flag in WAYS]
    assert [how for how, _ in smaller(exposures((20, 30), 2, 1e-6), METHODS["tikhonov-tv"], None)] == ["--bin 2"] * 2


WAYS = ("--set ", "--bin 2", "--bin 2 --set ")


def test_words_of_sizes_and_times():
    assert (
        Needs(3.14e9, 2e7, 40).line()
        == "takes about 3.1 GB of memory, 20 MB on the disk, and about 40 s of processor time"
    )
    assert (
        Needs(4e8, 1e3, 600).line()
        == "takes about 400 MB of memory, 1 MB on the disk, and about 10 min of processor time"
    )
    assert Needs(4e8, 1e6, 7200).line().endswith("about 2.0 h of processor time")
    assert Needs(4e8, 1e6).line().endswith("on the disk")


def test_commands_say_and_refuse_before_they_begin(monkeypatch, tmp_path):
    out = tmp_path / "a.nxs"
    command = ("simulate", "--specimen", "tissue", "--detector", 13, 17, "--views", 2, "--out", out)
    done = holosplat(*command)
    assert "the simulation takes about 441 MB of memory, 1 MB on the disk\n" in done.err
    monkeypatch.setattr(needs, "free_memory", lambda: -4e8)
    for refused in (
        holosplat(*command[:-1], tmp_path / "b.nxs"),
        holosplat("reconstruct", out, "--out", tmp_path / "run", "--material", "water"),
    ):
        assert refused.code == 2
        assert "of memory and" in refused.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.nxs"]


def test_many_views_of_few_rows_take_the_memory_of_one_slice_matrix():
    """A tooth of 181 views of 2 × 320 pixels: 1.1 GB were measured up to its first surfaces, and 8.8 GB were said."""
    contact = replace(exposures((2, 320), 181, 1e-5), distance=np.zeros(181))
    assert 1.07e9 < of_reconstruction(Sizes.of(contact), Auto()).memory < 1.8e9


@pytest.mark.parametrize("row", list(csv.DictReader((DATA / "needs_runs.csv").open())), ids=lambda row: row["scan"])
def test_whole_runs_took_what_was_said_of_them(row):
    """Time and memory no more than a factor of 1.5 beyond the range that was said."""
    for unit in ("s", "mb"):
        least, most, measured = (float(row[f"{which}_{unit}"]) for which in ("least", "most", "measured"))
        assert least / 1.5 <= measured <= 1.5 * most
