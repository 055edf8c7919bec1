"""What commands other than `reconstruct` and `simulate` take: by what they count, near what was measured."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from holosplat.align import PoseOptions
from holosplat.geometry import Views
from holosplat.learning.network import Size
from holosplat.methods import METHODS, SurfaceOptions
from holosplat.motion.flow_reconstruction import FlowOptions
from holosplat.motion.track_linking import TrackOptions
from holosplat.planning import acts
from holosplat.planning.needs import Needs, Sizes, of_fit, of_reconstruction
from holosplat.planning.scan_facts import coarser
from holosplat.scan import Exposures
from holosplat_bench.suite.methods import of_benchmark, of_methods
from holosplat_bench.training.needs import of_dataset, of_training
from holosplat_bench.training.options import TrainOptions
from holosplat_bench.training.train import trainer_of

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs/data/needs_acts.csv"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script that measures them."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("needs_acts")


def measured_rows() -> list[object]:
    """Those of the table."""
    with TABLE.open() as file:
        return [pytest.param(row, id="{act} {sizes}".format_map(row)) for row in csv.DictReader(file)]


@pytest.mark.parametrize("row", measured_rows())
def test_what_is_said_is_near_what_was_measured(script, row):
    """Within a factor of 1.3 above and below."""
    said = script.ACTS[row["act"]][1](json.loads(row["sizes"])).memory / 1e6
    assert 1 / 1.3 < said / float(row["measured_mb"]) < 1.3


def test_every_act_is_measured(script):
    with TABLE.open() as file:
        assert {row["act"] for row in csv.DictReader(file)} == set(script.ACTS)


def series(shape: tuple[int, int], views: int, times: int) -> Exposures:
    exposures = Exposures.of(Views.evenly_spaced(views, shape, 1.6e-6), 20.0, 0.1)
    return exposures.repeated(1e-3 * np.arange(times))


FRAMES: dict[str, Callable[[Exposures], Needs | None]] = {
    "track": lambda seen: acts.of_track(seen, TrackOptions()),
    "forecast": lambda seen: acts.of_forecast(seen, 16),
    "matter in motion": lambda seen: acts.of_motion(seen, FlowOptions()),
    "pinn": lambda seen: of_fit(Sizes.of(seen), METHODS["pinn"]),
    "each time": lambda seen: acts.of_each_time(seen, METHODS["gaussians"], "levels"),
    "align": lambda seen: acts.of_alignment(seen, PoseOptions()),
    "surface": lambda seen: acts.of_surfaces(acts.one_time(seen), SurfaceOptions()),
}


@pytest.mark.parametrize("name", list(FRAMES))
def test_larger_frames_of_more_times_take_more(name):
    of, still = FRAMES[name], name == "surface"
    small, late, large = (of(series(*each)) for each in (((231, 240), 4, 3), ((231, 240), 4, 30), ((300, 310), 4, 3)))
    assert small is not None
    assert late is not None
    assert large is not None
    assert large.memory > small.memory
    assert large.disk > small.disk
    assert large.seconds > small.seconds
    assert (late.disk > small.disk, late.seconds > small.seconds) == (not still, not still)
    assert late.memory >= small.memory


def test_each_time_takes_the_memory_of_one_and_the_room_of_all():
    seen = series((101, 120), 5, 7)
    one = of_fit(Sizes.of(acts.one_time(seen)), METHODS["volume"])
    every = acts.of_each_time(seen, METHODS["volume"], None)
    assert one is not None
    assert every == Needs(one.memory, 7 * one.disk, 7 * one.seconds)
    with_report = of_reconstruction(Sizes.of(acts.one_time(seen)), METHODS["volume"])
    assert with_report is not None
    assert with_report.memory >= one.memory


def test_pages_are_written_whole_and_slabs_are_not():
    """Memory of slabs does not grow with the volume; the room on the disk is that of two channels of float32."""
    for suffix, whole in ((".tif", True), (".tiff", True), (".h5", False)):
        small, large = (acts.of_export(shape, suffix) for shape in ((311, 300, 320), (700, 710, 720)))
        assert large.disk == 8 * 700 * 710 * 720
        assert (large.memory > 2 * small.memory) == whole
    assert acts.of_export((400, 410, 420), ".zarr").memory > acts.of_export((400, 410, 420), ".h5").memory


def test_cells_in_flow_take_room_for_every_mesh_and_pairs_of_their_nodes():
    few, many, fine = (acts.of_growth(*each, 1e-6) for each in ((3, 362, 10), (6, 362, 10), (3, 1962, 10)))
    assert many.memory == few.memory < fine.memory
    assert many.disk - few.disk == 3 * 362 * 10 * acts.Room.node
    assert many.seconds > few.seconds


def test_scenes_take_as_many_times_the_memory_as_there_are_processes():
    simulated = Needs(5e8, 0.0)
    one, four = (of_dataset(simulated, (48, 61), 5, 100, jobs) for jobs in (1, 4))
    assert four.memory > 4 * one.memory
    assert four.disk == one.disk
    assert four.seconds == pytest.approx(one.seconds / 4)


def test_a_wider_network_and_more_views_take_more():
    sizes = ((64, 81), 3)
    plain = of_training(*sizes, Size(), 100)
    wide = of_training(*sizes, Size(volume=(32, 80, 160)), 100)
    more = of_training((64, 81), 6, Size(), 100)
    assert wide.memory > plain.memory < more.memory
    for network in ("onix", "pixelnerf"):
        few, many = (trainer_of(network).needs((64, 81), views, TrainOptions(network=network)) for views in (3, 6))
        assert few.memory < many.memory
        assert few.memory != plain.memory


def test_a_benchmark_takes_the_memory_of_its_largest_case_and_the_time_of_all():
    planned, is_test = series((64, 71), 8, 1), np.arange(8) % 4 == 3
    methods = [METHODS["tikhonov-tv"], METHODS["gaussians"]]
    small, both = (of_methods(planned, is_test, 4, methods[:k]) for k in (1, 2))
    assert both.seconds > small.seconds
    total = of_benchmark([small, both, replace(small, memory=3e9)])
    assert total.memory == 3e9
    assert total.disk == pytest.approx(2 * small.disk + both.disk)
    assert total.seconds == pytest.approx(2 * small.seconds + both.seconds)


def test_larger_pixels_are_tried_while_there_are_columns():
    tried = list(coarser(series((64, 45), 3, 2), FRAMES["align"]))
    assert [how for how, _ in tried] == ["--bin 2", "--bin 3", "--bin 4"]
    memories = [needs.memory for _, needs in tried]
    assert memories == sorted(memories, reverse=True)
