"""A measured cell (HL60, its phase in 140 directions) by default: where corrections were rules, its error was 8.9."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import holosplat as hs
from holosplat.methods.levels import CONTINUOUS

pytestmark = pytest.mark.usefixtures("unjudged_runs")

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared/data/real"


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the measured cell in shared/data/real")
@pytest.mark.parametrize("distance", ["HL60", "HL60, far"])
def test_a_measured_cell_comes_out_right_by_default(distance, monkeypatch):
    """Phase of held-out views, with a fifth of the steps; distance and views of a seed that no rule was made on."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    made = importlib.import_module("family_scenes").scene(distance, 77, DATA)
    done = hs.reconstruct(made.scan, made.prior, importlib.import_module("families").METHOD)
    assert {each.name: each.choice for each in done.choice.decisions}["matter"] == CONTINUOUS
    assert made.error(done) < 0.04
