"""`--motion auto`: what of all times is taken together must predict times that were set aside better than they do."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.cli import PIXEL, QUICK, refused, worked
from helpers.cli import holosplat as command
from helpers.series import CELL, SHAPE, known, moving
from holosplat.checks import InputError
from holosplat.inference import Decision
from holosplat.io.nxtomo import write_scan
from holosplat.io.volumes import read_volume
from holosplat.methods import Auto
from holosplat.optics.background import LightOptions
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.tables import read_rows, to_table
from holosplat.workflows import motion_choice
from holosplat.workflows.motion_choice import MOTION, begun_motion, choose_motion, decide

TIMES = 6


@pytest.fixture(scope="module")
def scan():
    return moving(TIMES)


def ball(x: float) -> MeshScene:
    return MeshScene.of_one_material([Ball(np.array([x, 0.0, 0.0]), 6e-6).mesh()], CELL)


def missing(part):
    raise InputError("no body is seen.")


def test_times_are_set_aside_and_a_frame_of_each(scan):
    """Ways see the frames of the other times; a time by itself all of its frames but one."""
    seen, single = [], []

    def of_all(part):
        seen.append(part)
        return ball(0.0)

    def alone(part):
        single.append(part)
        return ball(0.0)

    decision = decide(scan.train(), alone, {"still": of_all})
    assert decision.choice == "each"  # the null wins ties
    (others,) = seen
    assert others.instants == pytest.approx([0.0, 1.5, 2.5])
    assert len(others) == 9
    assert len(single) == 3
    assert all(len(part) == 2 for part in single)


def test_what_predicts_better_is_taken_and_what_is_not_there_is_not(scan):
    right, wrong = truth(), ball(5e-6)
    assert decide(scan.train(), lambda part: wrong, {"still": lambda part: right}).choice == "still"
    ways = {"still": lambda part: wrong, "flow": lambda part: None, "bodies": missing}
    decision = decide(scan.train(), lambda part: right, ways)
    assert decision.choice == "each"
    assert [(each.name, each.loses) for each in decision.compared] == [("still", True)]
    assert "times set aside; without flow, for nothing moves; without bodies, for no body is seen" in decision.line
    assert Decision.from_dict(decision.as_dict()).line == decision.line


def truth() -> MeshScene:
    """The cells near the middle of their way."""
    cells = random_cells(2, (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL), 1, 10 * PIXEL)
    return MeshScene.of_one_material(cells, CELL).moved(2.5 * PIXEL * np.array([0.2, 0.0, 0.1]))


def test_matter_that_changes_is_taken_time_by_time():
    """Other cells at every second time; without flow and bodies, which take long."""
    even = LightOptions("even", noise="white")
    decision = choose_motion(moving(6, (1, 4, 1, 4, 1, 4)), known(20.0), QUICK, light=even, matter="levels")
    assert decision.choice == "each"
    assert decision.compared[0].loses


WAYS = {"reconstruct": "still", "reconstruct_moving": "flow", "track": "bodies"}
"""What finds each way."""


def stand_ins(monkeypatch, best: str) -> None:
    """Each way says that it is half done; `best` finds the truth, others a ball beside it."""

    def of(way):
        def find(*scan, **how):
            how["on_progress"]("fit", 0.5, {})
            found = SimpleNamespace(object=truth() if way == best else ball(5e-6))
            return SimpleNamespace(reconstruction=found) if way == "flow" else found

        return find

    for name, way in WAYS.items():
        monkeypatch.setattr(motion_choice, name, of(way))


@pytest.mark.parametrize("best", ["flow", "bodies"])
@pytest.mark.parametrize(
    ("method", "matter", "tried"),
    [
        (Auto(), None, ["still", "flow", "bodies"]),
        (Auto(), "continuous", ["still", "flow"]),
        (Auto(), "levels", ["still"]),
        (QUICK, None, ["still"]),
    ],
)
def test_what_the_options_forbid_is_not_chosen(monkeypatch, scan, best, method, matter, tried):
    """Though it would predict best: --motion flow and bodies refuse these methods and kinds of matter."""
    stand_ins(monkeypatch, best)
    decision = choose_motion(scan, known(20.0), method, matter=matter)
    assert [each.name for each in decision.compared] == tried
    assert decision.choice == (best if best in tried else "each")


def test_few_times_and_few_frames_are_refused(scan):
    with pytest.raises(InputError, match="needs 6 of them or more, but the scan has 4"):
        choose_motion(moving(4), known(20.0))
    single = scan[np.flatnonzero(np.tile(np.arange(4) == 0, TIMES))]
    with pytest.raises(InputError, match="a time has one training frame"):
        choose_motion(single, known(20.0))


@pytest.fixture
def asked(scan, tmp_path):
    """A command that decides, with quick options."""
    write_scan(tmp_path / "scan.nxs", scan)
    (tmp_path / "quick.json").write_text(json.dumps({"method": to_table(QUICK)}), encoding="utf-8")
    said = ["reconstruct", tmp_path / "scan.nxs", "--motion", "auto", "--material", "haemoglobin", "--matter", "levels"]
    said += ["--decide", "light=even", "noise=white"]
    return [*said, "--config", tmp_path / "quick.json", "--out", tmp_path / "out"]


@pytest.mark.usefixtures("unjudged_runs", "undrawn_reports")
@pytest.mark.parametrize("motion", ["still", "each"])
def test_the_command_takes_what_was_chosen_says_of_each_time_and_goes_on(asked, motion, tmp_path, monkeypatch):
    """Which is kept with the folder, so that a run goes on without a decision, and stands on its page."""
    found = Decision(MOTION, motion, "times set aside")
    monkeypatch.setattr(motion_choice, "choose_motion", lambda *args, **how: found)
    first = worked(command(*asked))
    assert found.line in first.err
    assert begun_motion(tmp_path / "out") == found
    assert f"of {TIMES} times are " in first.out
    table, page = ("times.csv", "report.html") if motion == "still" else ("series.csv", "series.html")
    rows = read_rows(tmp_path / "out" / table, "")
    assert [int(row["number"]) for row in rows] == list(range(TIMES))
    assert {row["explained"] for row in rows} <= {"0", "1"}
    text = (tmp_path / "out" / page).read_text(encoding="utf-8")
    assert "times set aside" in text
    if motion == "still":
        assert f"of {TIMES} times are not explained" in text
        (said,) = re.findall("Times: [^<]*", text)
        assert ".." not in said
        assert ".;" not in said
    else:
        worked(command("export", tmp_path / "out", "--volume", tmp_path / "v.h5", "--time-frame", "all"))
        last = tmp_path / "out" / "tasks" / "0000" / f"t{TIMES - 1:04d}"
        worked(command("export", last, "--volume", tmp_path / "last.h5"))
        one, other = (read_volume(tmp_path / name).delta for name in (f"v_t{TIMES - 1:04d}.h5", "last.h5"))
        np.testing.assert_array_equal(one, other)
        assert f"a series of {TIMES} times" in worked(command("info", tmp_path / "out")).out
        refused(
            command("evaluate", tmp_path / "out"),
            "whose run folders are in tasks/, as tasks/0000/t0000: name one",
        )
    monkeypatch.setattr(motion_choice, "choose_motion", missing)  # nobody asks it again
    again = worked(command(*asked, "--resume"))
    assert found.line in again.err


def test_what_was_begun_without_a_decision_does_not_go_on_with_one(asked, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.json").write_text("{}", encoding="utf-8")
    refused(command(*asked, "--resume"), "was begun without it; name the --motion of that")
    assert begun_motion(tmp_path / "out") is None


def test_what_is_of_one_time_is_refused_before_the_decision(asked, monkeypatch):
    monkeypatch.setattr(motion_choice, "choose_motion", lambda *args, **how: pytest.fail("it was made"))
    refused(command(*asked, "--fading", 0.3), "--fading is of matter that a flow carries")
    refused(command(*asked, "--time-frame", 1), "--motion auto takes all times")
    refused(command(*asked, "--refine", "shifts"), "--refine is of one time")
    refused(command(*asked, "--strict"), "--view and --strict are of one time")


def test_progress_says_what_is_tried(monkeypatch, scan):
    heard = set[str]()
    stand_ins(monkeypatch, "still")
    choose_motion(scan, known(20.0), on_progress=lambda stage, *_: heard.add(stage))
    assert heard == {f"motion, {way}: fit" for way in ("still", "flow", "bodies", "a time by itself")}


@pytest.mark.parametrize(
    "decided", [3, {MOTION: 3}, {MOTION: {"choice": "each"}}, {MOTION: Decision(MOTION, "spin", "").as_dict()}]
)
def test_a_damaged_decision_is_refused_in_a_sentence(tmp_path, decided):
    (tmp_path / "provenance.json").write_text(json.dumps({"records": [{"decided": decided}]}), encoding="utf-8")
    with pytest.raises(InputError, match=r"provenance\.json must be as it was written"):
        begun_motion(tmp_path)
