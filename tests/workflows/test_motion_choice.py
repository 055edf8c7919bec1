"""`--motion auto`: what of all times is taken together must predict times that were set aside better than they do."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.cli import PIXEL, QUICK, refused
from helpers.cli import holosplat as command
from helpers.series import CELL, SHAPE, known, moving
from holosplat.checks import InputError
from holosplat.cli import commands
from holosplat.cli.commands import Asked, CarriedFlags
from holosplat.inference import Decision
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Reading
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.workflows import motion_choice
from holosplat.workflows.motion_choice import choose_motion, decide

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
    assert [each.loses for each in decision.compared] == [True, True, True]


def truth() -> MeshScene:
    """The cells near the middle of their way."""
    cells = random_cells(2, (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL), 1, 10 * PIXEL)
    return MeshScene.of_one_material(cells, CELL).moved(2.5 * PIXEL * np.array([0.2, 0.0, 0.1]))


def test_matter_that_changes_is_taken_time_by_time(monkeypatch):
    """Other cells at every second time; without flow and bodies, which take long."""
    monkeypatch.setattr(motion_choice, "reconstruct_moving", lambda *args, **how: None)
    monkeypatch.setattr(motion_choice, "track", lambda part, *args, **how: missing(part))
    decision = choose_motion(moving(6, (1, 4, 1, 4, 1, 4)), known(20.0), QUICK, matter="levels")
    assert decision.choice == "each"
    assert decision.compared[0].loses
    assert [each.name for each in decision.compared] == ["still", "flow", "bodies"]


def test_few_times_and_few_frames_are_refused(scan):
    with pytest.raises(InputError, match="needs 6 of them or more, but the scan has 4"):
        choose_motion(moving(4), known(20.0))
    single = scan[np.flatnonzero(np.tile(np.arange(4) == 0, TIMES))]
    with pytest.raises(InputError, match="a time has one training frame"):
        choose_motion(single, known(20.0))


def test_the_command_takes_the_motion_that_was_chosen(scan, tmp_path, monkeypatch, capsys):
    write_scan(tmp_path / "scan.nxs", scan)
    found = Decision("motion", "bodies", "times set aside")
    monkeypatch.setattr(motion_choice, "choose_motion", lambda *args, **how: found)
    asked = commands._with_motion(tmp_path / "scan.nxs", Asked(motion=CarriedFlags("auto")), Reading(), 0)
    assert asked.motion.motion == "bodies"
    assert found.line in capsys.readouterr().err
    said = ["reconstruct", tmp_path / "scan.nxs", "--motion", "auto", "--out", tmp_path / "out"]
    refused(command(*said, "--resume"), "--motion auto decides anew")
    refused(command(*said, "--time-frame", 1), "--motion auto takes all times")
    refused(command(*said, "--refine", "shifts"), "--refine is of one time")
