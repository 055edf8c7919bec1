"""Bodies in two beams as red cells and as bodies of any shape: which are kept."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from helpers.kept import Kept
from helpers.moving_ellipsoids import MATERIAL, scan, true_paths
from holosplat.checks import InputError
from holosplat.fit import run as engine
from holosplat.inference import Decision, Score
from holosplat.learning.start import Card, Trained
from holosplat.motion import body_tracker, track
from holosplat.motion.track import NAME, compared_kinds, follow, unexplained
from holosplat.motion.track_linking import TrackOptions


class Run:
    """A following that only says how far it went."""

    def __init__(self, name: str, left: float, fails: bool = False) -> None:
        self.name, self.left, self.fails, self.asked = name, left, fails, list[str]()
        self.decisions = list[Decision]()
        self.stage, self.seen, self.counts, self.guess = "sightings", [[name]], [1], name

    def until(self, stage: str) -> None:
        self.asked.append(stage)
        if self.fails:
            raise InputError("no body was found.")

    def followed(self, said: str = ""):
        return self.name + said


@pytest.mark.parametrize(
    ("cells", "other", "kept", "looked"),
    [
        (0.30, 0.2, "other", ["halves", "done"]),
        (0.30, 0.296, "cells", ["halves"]),
        (None, 0.2, "other", ["done"]),
    ],
    ids=["any shape leaves clearly less", "no shape leaves clearly less", "no cells"],
)
def test_what_leaves_less_is_kept(monkeypatch, cells, other, kept, looked):
    spread = 1 + 0.05 * np.random.default_rng(0).normal(size=(40, 3))
    monkeypatch.setattr(track, "unexplained", lambda run: Score(run.left**2 * spread))
    runs = Run("cells", cells or 0.0, cells is None), Run("other", other)
    said = compared_kinds(*runs)  # type: ignore[arg-type]
    assert said.startswith(kept)
    assert runs[0].seen == [["other"]]
    assert runs[0].guess == "other"
    assert runs[1].asked == looked
    made = [one for run in runs for one in run.decisions]
    assert [(one.name, one.by) for one in made] == ([(NAME, "training frames")] if cells else [])
    assert ("no red cells" in said) == (cells is None)


def two_beams():
    frames = scan()
    return frames[np.flatnonzero(np.arange(len(frames)) % 4 % 2 == 0)]


def test_true_bodies_leave_the_noise():
    """At the finest scale; and bodies in wrong places leave much more at all."""
    run = SimpleNamespace(train=two_beams().train(), bodies=true_paths(), oversample=2)
    right = unexplained(run)  # type: ignore[arg-type]
    assert right.powers[:, 0].mean() == pytest.approx(1 / 5000, rel=0.2)
    run.bodies = true_paths().with_parameters({"coefficients": true_paths().coefficients + 2.0})
    gain, error = right.gain_over(unexplained(run))  # type: ignore[arg-type]
    assert gain > max(0.3, 4 * error)


def short() -> TrackOptions:
    usual = replace(TrackOptions(), rounds=0, twins=False, intervals=False).with_effort(0.02)
    return replace(usual, paths=replace(usual.paths, pieces=1))


@pytest.fixture
def guessed(monkeypatch):
    """Each time sees the true bodies, and a network that knows red cells alone is said to have guessed them."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", -1.0)
    at = lambda frames, material, options, network: [  # noqa: E731
        body_tracker.Detection(mesh, False) for mesh in true_paths().bodies(float(frames.instants[0]))
    ]
    monkeypatch.setattr(body_tracker, "sightings", at)
    trained = Trained(object(), Card(trained_on={"kinds": ["red-cells"]}))  # type: ignore[arg-type]
    monkeypatch.setattr("holosplat.learning.start.LearnedStart.network", property(lambda self: trained))
    monkeypatch.setattr(body_tracker.BodyTracker, "network", lambda self: trained.network)
    for name in ("PATIENCE", "TRIES", "STEPS", "LAST_STEPS"):
        monkeypatch.setattr(f"holosplat.bodies.neighbourhood_search.{name}", 1)
    return trained


def test_both_are_followed_and_a_run_goes_on_in_either_part(guessed):
    whole = follow(two_beams(), MATERIAL, short(), journal=(kept := Kept()))
    (decision,) = (one for one in whole.decisions if one.name == NAME)
    assert (whole.body is None) == (decision.choice == "any shape")
    assert "cells" in kept.states[-1]
    both = [k for k, state in enumerate(kept.states) if "cells" in state]
    for number in (both[0] - 1, both[4 * len(both) // 5], both[-1], len(kept.states) - 1):
        again = follow(two_beams(), MATERIAL, short(), journal=Kept(kept.states[: number + 1]))
        assert torch.equal(again.bodies.coefficients, whole.bodies.coefficients)
        assert [one.line for one in again.decisions] == [one.line for one in whole.decisions]


def test_nobody_asks_for_cells_elsewhere(guessed, monkeypatch):
    monkeypatch.setattr("holosplat.motion.track.compared_kinds", lambda *runs: pytest.fail("cells were asked for"))
    follow(scan(), MATERIAL, short())  # four beams
    follow(two_beams(), MATERIAL, replace(short(), cells=False))
    card = Card(trained_on={"kinds": ["capsules"]})
    monkeypatch.setattr(
        "holosplat.learning.start.LearnedStart.network", property(lambda self: replace(guessed, card=card))
    )
    follow(two_beams(), MATERIAL, short())


def test_a_journal_of_several():
    kept, stages = Kept(), {"any": {"next": "stiff"}, "cells": {"next": "soft"}}
    whole = engine.Run(kept)
    for name, state in stages.items():
        part = whole.part(name)
        part.state = lambda state=state: state
        part.keep()
    again = {name: engine.Run(kept).part(name).saved for name in stages}
    assert {name: {"next": saved["next"]} for name, saved in again.items()} == stages
    assert engine.Run(Kept()).part("any").saved == {}
    with pytest.raises(InputError, match="checkpoint"):
        follow(two_beams(), MATERIAL, short(), journal=Kept(["no table"]))  # type: ignore[arg-type]
