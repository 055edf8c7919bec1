"""Families of scenes (benchmarks/families.py): each seed is a fresh draw, and decisions are set beside hindsight."""

from __future__ import annotations

import importlib
import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import holosplat as hs
from holosplat_bench.suite.families import Room
from holosplat_bench.suite.methods import METHODS

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
MATERIAL = hs.DeltaBeta(1e-7, 1e-10)


@pytest.fixture
def families(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/families.py."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("families")


@pytest.fixture
def scenes(families) -> ModuleType:
    """benchmarks/family_scenes.py."""
    return importlib.import_module("family_scenes")


def row(families, light="as measured", matter="levels", error=0.1, told="no", **more):
    known = {"family": "foam", "seed": 1, "use": "development", "result": "", "others": ""}
    known |= {"decisions": "", "frames": "", "facts": "", "machine": "", "commit": "", "seconds": 0.0}
    return families.Row(
        **(known | {"light": light, "matter": matter, "error": error, "told": told, "decision_seconds": 0.0} | more)
    )


def test_every_family_finds_room_for_its_matter(scenes):
    assert len(scenes.SIMULATED) + len(scenes.MEASURED_FAMILIES) >= 16
    room = Room(15e-6, 50e-6, 45e-6, 50e-6)
    views = hs.Views.from_angles([0.0], (50, 56), 1e-6)
    for name, family in scenes.SIMULATED.items():
        thick = []
        for seed in (1, 2):
            matter = family.placed(np.random.default_rng(seed), room)(MATERIAL)
            thick.append(np.asarray(matter.project(views)[0]))
        assert thick[0].max() > 0, name
        assert not np.array_equal(*thick) or name == "head", name


def test_a_seed_gives_the_same_scene_again_and_another_another(scenes):
    first, again, other = (scenes.scene("fixed pattern", seed, None) for seed in (1, 1, 2))
    assert np.array_equal(first.scan.frames, again.scan.frames)
    assert first.scan.frames.shape != other.scan.frames.shape
    assert re.match(r"[a-z ]+, Fresnel number .* told(, offset [\d.]+)?, pattern 0\.0", first.facts)


def test_a_family_without_its_data_is_skipped_with_a_sentence(scenes, tmp_path):
    assert "hl60_qlsi_A140.tar.lzma is not in" in scenes.scene("HL60", 1, tmp_path)
    assert "is skipped" in scenes.scene("spider hair", 1, None)


def test_what_is_told_is_not_decided(families, scenes, monkeypatch):
    monkeypatch.setattr(families, "METHOD", METHODS["holographic-tv"].options)
    made = scenes.scene("fixed pattern", 1, None)
    done = families.run("fixed pattern", 1, made, ("fixed pattern", "levels"))
    assert (done.light, done.told, done.use) == ("fixed pattern", "yes", "development")
    assert "light and noise" not in done.decisions
    plain = families.run("fixed pattern", 101, made, families.NULLS)
    assert plain.error != done.error
    assert plain.use == "reporting"


def test_one_decision_is_changed_at_a_time(families):
    default = row(families, "uneven light", "continuous", others="fixed pattern; uneven light; continuous")
    assert families.others(default) == [
        ("as measured", "levels"),
        ("as measured", "continuous"),
        ("fixed pattern", "continuous"),
        ("uneven light", "levels"),
    ]
    assert families.others(row(families)) == []
    assert families.others(row(families, families.REFUSED)) == [families.NULLS]


def test_rows_that_are_there_are_not_made_again(families, tmp_path, monkeypatch):
    made = []

    def run(name, seed, scene, told):
        made.append(told)
        light, matter = told or ("uneven light", "levels")
        return row(families, light, matter, told="yes" if told else "no", others="uneven light; continuous")

    monkeypatch.setattr(families, "run", run)
    monkeypatch.setattr(families, "scene", lambda *given: object())
    path = tmp_path / "rows.csv"
    families.make("foam", 1, None, path, True)
    assert made == [None, families.NULLS]
    families.make("foam", 1, None, path, False)
    families.make("foam", 1, None, path, False)
    assert made == [None, families.NULLS, ("uneven light", "continuous")]
    assert len(families.rows_of(path)) == 3


def test_regret_is_against_the_null_and_hindsight(families):
    default = row(families, "uneven light", error=0.3, others="uneven light; grain")
    null, best = row(families, error=0.2, told="yes"), row(families, "grain", error=0.1, told="yes")
    other = [replace(one, family="HL60") for one in (replace(default, error=0.1, others=""), null)]
    lacking = [replace(one, family="red cells", others="grain") for one in other]
    lines = {line[0]: line[1:] for line in families.table_of_rules([default, null, best, *other, *lacking])}
    assert lines["scenes with all runs"] == ["1", "1", "–"]
    assert lines["worst regret"] == ["0.0%", "200.0%", "under 50%"]
    assert lines["worst against null"] == ["-50.0%", "+50.0%", "under 10%"]
    assert lines["families that lose more than 10 % to the null"] == ["0", "1", "0"]
    scenes = families.table_of_scenes([default, null, best, *other])
    assert [line[0] for line in scenes] == ["foam", "HL60"]
    refused = [replace(default, light=families.REFUSED, error=float("inf")), null]
    refusals = {line[0]: line[1:] for line in families.table_of_rules(refused)}
    assert refusals["worst regret"][1] == "inf%"
