"""Events of bodies and holes between times: on volumes of known topology, and a series of two drops that merge."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from helpers.cli import holosplat, worked
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.inference import Decision
from holosplat.matter import Matter
from holosplat.methods.contrast import BOTH, STAGE
from holosplat.representations import VoxelGrid
from holosplat.series.collect import collect
from holosplat.series.events import PARTS, History, Parts
from holosplat.series.folder import SeriesFolder, read_row, write_row
from holosplat.series.one_time import Before, is_without_bodies
from holosplat.workflows.run_folder import RunFolder

GRID = Grid.centred((31, 25, 37), 0.5e-6, (1e-6, 0.0, 0.0))
DELTA = 4e-7


def parts(*balls: tuple[float, float, float, float], hole: float = 0.0) -> Parts:
    """Of balls (x, y, z, radius) in voxels from the middle; hole: radius of one in the first of them."""
    import torch

    z, y, x = np.meshgrid(*(np.arange(n) - n // 2 for n in GRID.shape), indexing="ij")
    full = np.zeros(GRID.shape, dtype=bool)
    for cx, cy, cz, radius in balls:
        full |= (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 < radius**2
    if hole:
        cx, cy, cz, _ = balls[0]
        full &= (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 >= hole**2
    values = torch.from_numpy(full[None].astype(np.float32))
    return Parts.of(VoxelGrid(values, GRID, Matter.one(DELTA, 1e-9)), GRID)


def told(history: History) -> list[tuple]:
    return [(e.kind, e.of, e.first, e.before, e.after) for e in history.events]


def test_two_bodies_merge_and_part_again():
    apart, near = [(-9, 0, 0, 5), (9, 0, 0, 5)], [(-4, 0, 0, 5), (4, 0, 0, 5)]
    history = History.of([parts(*apart), parts(*apart), parts(*near), parts(*near), parts(*apart)])
    assert told(history) == [("merger", "body", 1, (0, 1), (2,)), ("split", "body", 3, (2,), (3, 4))]
    assert [track.parents for track in history.tracks] == [(), (), (0, 1), (2,), (2,)]
    assert [(track.first, track.last) for track in history.tracks] == [(0, 1), (0, 1), (2, 3), (4, 4), (4, 4)]
    assert history.events[0].place == pytest.approx((1e-6, 0, 0), abs=1e-9)
    ball = 4 / 3 * np.pi * (5 * 0.5e-6) ** 3
    assert history.tracks[0].volumes[0] == pytest.approx(ball, rel=0.05)
    assert history.lines([0.0, 1.0, 2.0, 3.0, 4.0])[0] == "merger between 1 and 2 s: bodies 0 and 1 → 2"


def test_bodies_appear_and_vanish_and_a_hole_collapses():
    history = History.of([parts((-8, 0, 0, 7), hole=3), parts((-8, 0, 0, 7), (10, 0, 0, 5)), parts((-8, 0, 0, 7))])
    assert sorted(told(history)) == [
        ("appearance", "body", 0, (), (1,)),
        ("collapse", "hole", 0, (2,), ()),
        ("disappearance", "body", 1, (1,), ()),
    ]


def test_a_body_that_leaps_by_less_than_its_radius_goes_on():
    """And small parts are noise: neither bodies nor holes."""
    history = History.of([parts((k, 0, 0, 5), (-13, 5, -9, 1.5)) for k in (-12, -8, 2, 6, 10)])
    assert told(history) == [("disappearance", "body", 1, (0,), ()), ("appearance", "body", 1, (), (1,))]
    assert not told(History.of([parts((k, 0, 0, 7), hole=1.2) for k in (-3, 0, 3)]))
    assert History.of([]) == History((), ())
    assert not told(History.of([parts(), parts()]))


def test_parts_go_through_a_file(tmp_path):
    one = parts((-8, 0, 0, 7), (9, 0, 0, 4), hole=3)
    one.write(tmp_path / PARTS)
    other = Parts.read(tmp_path / PARTS)
    assert other.grid == one.grid
    assert np.array_equal(other.bodies, one.bodies)
    assert np.array_equal(other.holes, one.holes)
    (tmp_path / PARTS).write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"parts\.npz"):
        Parts.read(tmp_path / PARTS)


def test_a_series_writes_its_events(done, tmp_path):
    """Two cells that move on: two tracks, no event; the page has a section of events where there are some."""
    shutil.copytree(done.path, tmp_path / "series")
    folder = SeriesFolder(tmp_path / "series")
    collect(folder, fronts=True)
    assert len(folder.fronts.read_text().splitlines()) == 6
    tracks = list(csv.DictReader(folder.tracks.read_text().splitlines()))
    assert [(row["of"], row["first"], row["last"], row["parents"]) for row in tracks] == [("body", "0", "4", "")] * 2
    assert folder.events.read_text().startswith("first,last,first_s,last_s,event,of,before,after")
    assert 'id="events"' not in folder.page.read_text()
    path = folder.run(1, 3) / PARTS
    seen = Parts.read(path)
    Parts(np.where(seen.bodies == 2, 0, seen.bodies), seen.holes, seen.grid).write(path)
    collect(folder)
    events = list(csv.DictReader(folder.events.read_text().splitlines()))
    assert [(row["event"], row["first_s"], row["last_s"]) for row in events] == [
        ("disappearance", "1", "1.5"),
        ("appearance", "1.5", "2"),
    ]
    assert "disappearance between 1 and 1.5 s" in folder.page.read_text()


def test_continuous_matter_on_both_sides_has_no_events(done, tmp_path):
    """A shock of five times had twenty. Its fronts are told all the same."""
    shutil.copytree(done.path, tmp_path / "series")
    folder = SeriesFolder(tmp_path / "series")
    for number in range(5):
        run = RunFolder(folder.run(number // 2, number))
        summary = {**run.read_summary(), "decisions": [Decision(STAGE, BOTH, "views set aside").as_dict()]}
        run.summary.write_text(json.dumps(summary))
        write_row(folder.row(number // 2, number), replace(read_row(folder.row(number // 2, number)), kind="voxels"))
    found = collect(folder, fronts=True)
    assert found.no_events.startswith("5 of 5 times have no events of bodies: continuous matter on both sides")
    assert len(folder.events.read_text().splitlines()) == len(folder.tracks.read_text().splitlines()) == 1
    assert len(folder.fronts.read_text().splitlines()) == 6
    assert found.no_events in folder.page.read_text()
    assert found.no_events in worked(holosplat("series", "collect", folder.path)).err
    assert is_without_bodies(Before(run, replace(read_row(folder.row(2, 4)), kind="voxels")))
    assert not is_without_bodies(Before(run, replace(read_row(folder.row(2, 4)), kind="surfaces")))
