"""Mistakes in the metadata of scans: which are tried, found on held-out frames, and named as causes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, reduce

import numpy as np
import pytest

import holosplat as hs
from holosplat.checks import InputError
from holosplat.inference import Decision
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS
from holosplat.methods.uncertain import Determined
from holosplat.optics.background import LightOptions
from holosplat.tables import paths
from holosplat.workflows import certainty
from holosplat.workflows.certainty import MISTAKES, NULL, Again, compare_causes, drawn_frames
from holosplat.workflows.next_step import STEPS
from holosplat.workflows.rehearsal import rehearse

WATER = hs.materials.parse_material("water").delta_beta(20.0)
PRIOR, PIXEL, SHAPE = hs.MaterialPrior.known(WATER), 1e-6, (20, 23)


@cache
def scan_of(count: int, photons: float = 20000.0) -> hs.Scan:
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(2, (16e-6, 16e-6, 16e-6), 5, 9e-6), WATER)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(count, SHAPE, PIXEL), 20.0, 0.03)
    return hs.simulate(scene, exposures, photons_per_pixel=photons, seed=3)


def done_by(name: str, scan: hs.Scan, prior: MaterialPrior = PRIOR, kind: type[Again] = Again) -> Again:
    """What reconstructs frames as a run of `scan` by the method of this name did."""
    return kind(prior, METHODS[name], 0, hs.reconstruct(scan, prior, METHODS[name]))


@pytest.fixture(scope="module")
def few() -> Again:
    """Linear retrieval of four views, three of them for training."""
    return done_by("ctf-tv", scan_of(4))


def test_every_mistake_has_a_command():
    assert {key for key, _ in MISTAKES.values()} <= STEPS.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["auto", "volume", "voxels", "surfaces"])
def test_matter_beyond_the_field_is_tried_in_every_volume_of_a_method(name, few):
    scan, method = scan_of(4), METHODS[name]
    _, how = MISTAKES["matter beyond the field"][1](scan, replace(few, method=method))
    changed = paths_and_values(how["method"])
    beside = {path for path in changed if path.endswith("volume.beside")}
    assert len(beside) == (2 if name == "auto" else 1)
    assert {path for path, value in paths_and_values(method).items() if changed[path] != value} == beside
    assert {changed[path] for path in beside} == {0.5}
    with pytest.raises(InputError, match="the method per-view has no matter beyond the field"):
        MISTAKES["matter beyond the field"][1](scan, replace(few, method=METHODS["tikhonov-tv"]))


def paths_and_values(method):
    return {path: reduce(getattr, path.split("."), method) for path in paths(method) if not path.endswith("kind")}


@pytest.mark.usefixtures("unjudged_runs")
def test_mistakes_are_found_on_held_out_frames_and_none_where_there_is_none(monkeypatch):
    scan = scan_of(12)
    few = ("other sign of δ", "twice the angles", "matter beyond the field")
    monkeypatch.setattr(certainty, "MISTAKES", {name: MISTAKES[name] for name in few})
    again = done_by("paganin-tv", scan)
    halved, _ = MISTAKES["half the angles"][1](scan, again)
    found = compare_causes(halved, again)
    assert found.choice == "angles"
    assert [each.name for each in found.compared] == ["other sign of δ", "twice the angles"]
    assert compare_causes(scan, again).choice == NULL
    other = MaterialPrior.known(DeltaBeta(-WATER.delta, -WATER.beta))
    assert compare_causes(scan, replace(again, prior=other)).choice == "sign"
    assert compare_causes(scan[np.arange(3)], again).choice == NULL


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize("pixels", [3.0, -3.0, 0.0])
def test_an_axis_elsewhere_is_named(pixels, monkeypatch):
    names = ("axis to the left", "axis to the right")
    monkeypatch.setattr(certainty, "MISTAKES", {name: MISTAKES[name] for name in names})
    told = moved(scan_of(12), pixels)
    again = done_by("paganin-tv", told)
    found = compare_causes(told, again, drawn_frames(again.done, told, told.exposures, 0))
    assert found.choice == ("shift_x" if pixels else NULL)


def moved(scan: hs.Scan, pixels: float) -> hs.Scan:
    views = replace(scan.views, shifts=scan.views.shifts + np.array([pixels * PIXEL, 0.0]))
    return replace(scan, exposures=replace(scan.exposures, views=views))


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize("told", [True, False])
def test_what_frames_do_not_tell_is_not_tried(told, monkeypatch):
    class Asked(Again):
        def __call__(self, scan, further=0, uncertain=None, **changed):
            found = super().__call__(scan, further, **changed)
            value = Determined("distance", 0.03, 0.01, 0.09, (0.01, 0.09), told)
            return replace(found, constants=(value,) if uncertain else ())

    monkeypatch.setattr(certainty, "MISTAKES", {"distance": MISTAKES["distance"]})
    scan = scan_of(12)
    found = compare_causes(scan, done_by("paganin-tv", scan, kind=Asked))
    assert [each.name for each in found.compared] == ["distance"] * told


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize("refused", ["a fold", "all folds", "the null"])
def test_reconstructions_that_are_refused_decide_nothing(refused, monkeypatch):
    """A mistake that cannot be put right in one part of the frames is compared in the others; frames in which nothing
    is found are no fault of the command."""

    class Refusing(Again):
        def __call__(self, scan, further=0, right=False, **changed):
            first = bool(scan.is_test[3])
            if right and (refused == "all folds" or (refused == "a fold" and not first)):
                raise InputError("no.")
            if not right and refused == "the null":
                raise InputError("the start found no matter.")
            return super().__call__(scan, further, **changed)

    monkeypatch.setattr(certainty, "MISTAKES", {"light": ("light", lambda scan, again: (scan, {"right": True}))})
    scan = replace(scan_of(8), is_test=np.zeros(8, dtype=bool))
    found = compare_causes(scan, done_by("paganin-tv", scan, kind=Refusing))
    assert found.choice == ("light" if refused == "the null" else NULL)
    assert len(found.compared) == (refused != "all folds")


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize(
    ("held_out", "parts"), [(False, {(3, 7), (2, 6), (1, 5), (0, 4)}), (True, {(3, 7)})], ids=["none", "a quarter"]
)
def test_frames_are_held_out_in_turn_where_a_run_has_none(held_out, parts, monkeypatch):
    aside = set()

    class Seen(Again):
        def __call__(self, scan, further=0, **changed):
            aside.add(tuple(np.flatnonzero(scan.is_test)))
            return super().__call__(scan, further, **changed)

    def select(name, candidates, score, folds, by):
        assert folds == len(parts)
        [score(each, fold) for each in candidates for fold in range(folds)]
        return Decision(name, NULL, by)

    monkeypatch.setattr(certainty, "MISTAKES", {"other sign of δ": MISTAKES["other sign of δ"]})
    monkeypatch.setattr(certainty, "select", select)
    scan = scan_of(8)
    scan = scan if held_out else replace(scan, is_test=np.zeros(8, dtype=bool))
    compare_causes(scan, done_by("paganin-tv", scan, kind=Seen))
    assert aside == parts


class Long(Again):
    """Takes the distance for twice as long, unless told that it is `right`."""

    def __call__(self, scan, further=0, right=False, **changed):
        far = scan.exposures.distance * (1 if right else 2)
        return super().__call__(replace(scan, exposures=replace(scan.exposures, distance=far)), further, **changed)


@pytest.mark.slow
@pytest.mark.usefixtures("unjudged_runs")
def test_what_mends_rehearsals_too_is_no_mistake(monkeypatch):
    """A method that is wrong by itself is mended on simulated frames, too, whose metadata are right; half the angles
    are mended on the measured ones alone."""
    scan = scan_of(12)
    again = done_by("paganin-tv", scan, kind=Long)
    monkeypatch.setattr(certainty, "MISTAKES", {"distance": ("distance", lambda scan, again: (scan, {"right": True}))})
    assert compare_causes(scan, again).choice == "distance"
    found = compare_causes(scan, again, drawn_frames(again.done, scan, scan.exposures, 0))
    assert found.choice == NULL
    assert "in rehearsals, too: distance" in found.line
    monkeypatch.setattr(certainty, "MISTAKES", {"twice the angles": MISTAKES["twice the angles"]})
    halved, _ = MISTAKES["half the angles"][1](scan, again)
    plain = done_by("paganin-tv", halved)
    assert compare_causes(halved, plain, drawn_frames(plain.done, halved, halved.exposures, 0)).choice == "angles"


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["", "half the angles"])
def test_the_verdict_separates_right_and_wrong_scans(wrong, few, monkeypatch):
    """By the shipped factors; the cause is compared by one mistake, beside the right one."""
    tried = ("other sign of δ", "twice the angles")
    scan, method = scan_of(12, 50000.0), METHODS["holographic-tv"]
    if wrong:
        scan, _ = MISTAKES[wrong][1](scan, few)
    monkeypatch.setattr(certainty, "MISTAKES", {name: MISTAKES[name] for name in tried})
    shown = rehearse(hs.reconstruct(scan, PRIOR, method), scan, PRIOR, method, times=2)
    assert (shown.word == "wrong") == bool(wrong)
    if wrong:
        assert shown.cause is not None
        assert shown.cause.choice == "angles"


def test_smooth_light_without_air_is_refused():
    with pytest.raises(hs.InputError, match="shows no air"):
        hs.reconstruct(scan_of(12), PRIOR, METHODS["paganin-tv"], light=LightOptions("smooth"))
