"""benchmarks/changing.py: the truth of its series, what runs are told, and its table."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import holosplat as hs

ROOT = Path(__file__).resolve().parents[2]


def test_a_series_has_its_truth_and_its_events(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    script = importlib.import_module("changing")
    truth = script.Truth.of("merging-drops", 48, 1)
    grid = hs.Grid.of_views(truth.exposures.views[:4])
    volumes = [truth.at(share).scene.voxelise(grid) for share in truth.times]
    told = truth.events(volumes, grid)
    assert [k for k, text in enumerate(told) if text] == [3]  # they touch at 0.35 of the course, within a voxel before
    assert "merger of body" in told
    assert script.judged(volumes[-1], truth.at(1.0), grid)[:3] == pytest.approx((0, 1, 1))
    assert script.judged(volumes[-1], truth.at(0.0), grid)[0] > 0.5
    assert truth.prior == hs.MaterialPrior.known(truth.substances.contrast)
    assert script.Truth.of("expanding-shock", 32, 1).prior.kind == "ratio"


def test_the_table_tells_the_worst_time_and_events_within_a_time(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    tables = importlib.import_module("tables.moving")
    empty = {
        "holes": "",
        "true_events": "",
        "events": "",
        "radius": "",
        "true_radius": "",
        "seconds": "2",
        "seed": "101",
    }
    row = empty | {"series": "drops", "use": "reporting", "verdict": "good", "dice": "0.99"}
    rows = [row | {"error": "0.1", "total": "1.01", "true_events": "merger of body"}]
    rows += [row | {"error": "0.2", "total": "0.97", "events": "merger of body; split of body"}]
    rows += [row | {"error": "0.9", "total": "2", "use": "development"}]
    monkeypatch.setattr(tables, "read", lambda name: rows)
    line = tables.changing().splitlines()[-1]
    assert line == "| drops, 101 | 2 | 0.200 | 0.990 | 0.970 |  | 2 of 2 | 1 of 1, 1 others |  | 4 s |"
