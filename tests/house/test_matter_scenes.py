"""benchmarks/matter_scenes.py: what runs are told, and how they are judged; its tables."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import holosplat as hs
from holosplat_bench.specimens.matter import MATTER

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("matter_scenes")


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("tables.matter")


def test_the_truth_is_judged_right_and_an_empty_volume_wrong(script):
    _, substances, drawn, exposures = script.planned("jet", "small", 1)
    grid = hs.Grid.of_views(exposures.views)
    truth, bubbles = (one.voxelise(grid) for one in (drawn.scene, drawn.regions["bubbles"]))
    *scores, right = script.judged(truth, drawn, grid)
    assert scores == pytest.approx([0, 1, 1])
    full = replace(truth, delta=truth.delta + substances.contrast.delta * bubbles.delta)
    error, _, total, wrong = script.judged(full, drawn, grid)
    assert error > 0.05
    assert total > 1
    assert right > 0.8
    assert wrong < 0.3  # air beside the jet, where a bubble is near its edge
    error, overlap, total, _ = script.judged(replace(truth, delta=0 * truth.delta), drawn, grid)
    assert (error, overlap, total) == (1, 0, 0)
    assert script.judged(None, drawn, grid)[:2] == (np.inf, 0)


def test_bubbles_are_no_holes_of_the_material(script):
    _, _, drawn, exposures = script.planned("bubbles", "small", 1)
    grid = hs.Grid.of_views(exposures.views)
    assert script.judged(drawn.scene.voxelise(grid), drawn, grid) == (0, 1, 1, "")


@pytest.mark.parametrize(
    ("name", "materials"), [("jet", 1), ("cuvette", 2), ("channel", 2), ("shock", 0), ("shock, no bubble", 0)]
)
def test_runs_get_the_materials_of_the_scene(script, name, materials):
    kind, substances, drawn, _ = script.planned(name, "small", 1)
    made = script.Scene(None, substances, drawn, kind)
    if name.startswith("shock"):
        assert ("bubbles" in drawn.regions) is (name == "shock")
        assert made.told("told").kind == "ratio"
    else:
        assert made.told("told").materials[0] == substances.contrast
        assert len(made.told("told").materials) == materials
        assert len(made.told("Paganin, TV").materials) == 1
    assert made.told("nothing told") == hs.MaterialPrior.unknown()


def test_tables_hold_each_kind_by_each_run(tables, monkeypatch):
    row = {"size": "small", "seed": "101", "run": "told", "error": "0.0269", "dice": "0.99", "total": "1.01"}
    rows = [row | {"kind": "jet"}, row | {"kind": "jet", "run": "Paganin, TV", "error": "inf"}]
    rows += [row | {"kind": "star", "size": "large", "error": error} for error in ("0.1", "0.2", "0.15")]
    monkeypatch.setattr(tables, "read", lambda name: rows)
    assert tables.scenes().splitlines()[2:] == [
        "| `jet` | – | 0.027 / 0.990 / 1.01 | refused |",
        "| `star` | 0.200 / 0.990 / 1.01 | – | – |",
    ]
    assert list(MATTER) == tables.KINDS
