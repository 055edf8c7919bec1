"""The plan of a series: which scans, which windows, what its file holds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from helpers.series import SETTINGS, known, planned
from holosplat.checks import InputError
from holosplat.io.reading import Part, Reading, Told
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto
from holosplat.motion.track import TrackOptions
from holosplat.optics.background import LightOptions
from holosplat.series.folder import SeriesFolder
from holosplat.series.plan import Cut, SeriesPlan, Settings, Source, listed, plan_series, prior_of

CELL = HAEMOGLOBIN.delta_beta(20.0)


def of_times(*counts: int, act: str = "reconstruct", window: int = 3, overlap: int = 0) -> SeriesPlan:
    sources = [Source(Path(f"/{k}"), tuple(map(float, range(n))), "", known(20.0)) for k, n in enumerate(counts)]
    return SeriesPlan(tuple(sources), Settings(act), Reading(), Cut(window, overlap))  # type: ignore[arg-type]


def windows(plan: SeriesPlan) -> list[tuple[list[int], int]]:
    return [([m.number for m in window.moments], window.early) for window in plan.windows()]


def test_windows_hold_every_time_once_beside_what_overlaps():
    assert windows(of_times(7)) == [([0, 1, 2], 0), ([3, 4, 5], 0), ([6], 0)]
    overlapping = of_times(2, 1, 4, overlap=2)  # of several scans
    assert windows(overlapping) == [([0, 1, 2], 0), ([1, 2, 3, 4, 5], 2), ([4, 5, 6], 2)]
    assert [m.number for window in overlapping.windows() for m in window.own] == list(range(7))
    assert [(m.source, m.frame) for m in overlapping.moments()][1:4] == [(0, 1), (1, 0), (2, 0)]


def test_windows_of_track_end_with_their_scan():
    assert windows(of_times(4, 3, act="track", overlap=1)) == [([0, 1, 2], 0), ([2, 3], 1), ([4, 5, 6], 0)]


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        Settings(method=Auto(), matter=None, light=LightOptions("smooth", ((0, 2, 0, 3),)), seed=3, reports=True),
        Settings("track", motion=TrackOptions(rounds=2).with_effort(0.5)),
    ],
    ids=["gaussians", "auto", "track"],
)
def test_a_plan_is_read_as_it_was_written(files, tmp_path, settings):
    reading = Reading(Told(axis_column=3.0), Part(bin=2))
    plan = plan_series([files.scan], settings, known, reading, Cut(2, 1))
    folder = SeriesFolder(tmp_path / "series")
    folder.create(plan)
    assert folder.plan() == plan


def test_priors_are_read_as_they_were_written():
    two = MaterialPrior.known(CELL, DeltaBeta(0.3 * CELL.delta, 0.1 * CELL.beta))
    for prior in (known(20.0), two, MaterialPrior.of_ratio(-300.0), MaterialPrior.unknown()):
        assert prior_of(json.loads(json.dumps(prior.as_dict()))) == prior


def test_a_damaged_plan_is_refused(files, tmp_path):
    folder = planned(tmp_path / "series", files.scan)
    table = json.loads(folder.file.read_text())
    for change, said in (({"format": "x"}, "its format is 'x'"), ({"scans": 3}, ""), ({"settings": {"a": 1}}, "a is")):
        folder.file.write_text(json.dumps(table | change))
        with pytest.raises(InputError, match=f"the plan of a series.*{said}"):
            folder.plan()


def test_scans_of_a_folder_are_in_the_order_of_their_numbers(files, tmp_path):
    """scan9 comes before scan10; what is no scan, hidden or a link is passed over."""
    (files.each / ".hidden.nxs").write_bytes(b"")
    (files.each / "notes.txt").write_text("x")
    assert [path.name for path in listed([files.each])] == ["scan9.nxs", "scan10.nxs", "scan11.nxs"]
    assert listed([files.scan, files.each])[0] == files.scan
    (tmp_path / "empty").mkdir()
    for path, said in ((tmp_path / "empty", "holds none"), (tmp_path / "none", "no such path")):
        with pytest.raises(InputError, match=said):
            listed([path])


def test_what_a_series_cannot_be(files):
    for reading, settings, said in (
        (Reading(part=Part(time_frame=1)), SETTINGS, "takes all times"),
        (Reading(part=Part(time_frames="0:2")), Settings("track"), "leave --time-frames"),
        (Reading(part=Part(views="0:4")), Settings("track"), "motion is found in 3 times or more"),
    ):
        with pytest.raises(InputError, match=said):
            plan_series([files.scan], settings, known, reading, Cut())
    with pytest.raises(InputError, match="overlap must be at most the window, 2"):
        Cut(2, 3)
