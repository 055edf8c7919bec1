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
from holosplat.learning.weights import Card, Trained
from holosplat.motion import body_tracker, model_comparison
from holosplat.motion.model_comparison import Parts, cells_or_any, residual
from holosplat.motion.track import TrackOptions, follow


class Run:
    """A following that only says how far it went."""

    def __init__(self, name: str, left: float, fails: bool = False) -> None:
        self.name, self.left, self.fails, self.asked = name, left, fails, list[str]()
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
        (0.30, 0.29, "cells", ["halves"]),
        (None, 0.2, "other", ["done"]),
    ],
    ids=["any shape leaves clearly less", "no shape leaves clearly less", "no cells"],
)
def test_what_leaves_less_is_kept(monkeypatch, cells, other, kept, looked):
    monkeypatch.setattr(model_comparison, "residual", lambda run: run.left)
    runs = Run("cells", cells or 0.0, cells is None), Run("other", other)
    said = cells_or_any(*runs)  # type: ignore[arg-type]
    assert said.startswith(kept)
    assert runs[0].seen == [["other"]]
    assert runs[0].guess == "other"
    assert runs[1].asked == looked
    assert "red cells" in said


def two_beams():
    frames = scan()
    return frames[np.flatnonzero(np.arange(len(frames)) % 4 % 2 == 0)]


def test_true_bodies_leave_the_noise():
    train = two_beams().train()
    run = SimpleNamespace(train=train, bodies=true_paths(), oversample=2)
    noise = 5000.0**-0.5
    contrast = float(np.sqrt(np.mean((train.frames - 1.0) ** 2)))
    assert residual(run) == pytest.approx(noise / contrast, rel=0.1)  # type: ignore[arg-type]
    run.bodies = true_paths().with_parameters({"coefficients": true_paths().coefficients + 2.0})
    assert residual(run) > 2 * noise / contrast  # type: ignore[arg-type]


def short() -> TrackOptions:
    usual = replace(TrackOptions(), rounds=0, twins=False, intervals=False).with_effort(0.02)
    return replace(usual, paths=replace(usual.paths, pieces=1))


@pytest.fixture
def guessed(monkeypatch):
    """Each time sees the true bodies, and a network that knows red cells alone is said to have guessed them."""
    monkeypatch.setattr(body_tracker, "CHECKPOINT_SECONDS", -1.0)
    at = lambda frames, material, options, network: [  # noqa: E731
        body_tracker.Sighting(mesh, False) for mesh in true_paths().bodies(float(frames.instants[0]))
    ]
    monkeypatch.setattr(body_tracker, "sightings", at)
    trained = Trained(object(), Card(trained_on={"kinds": ["red-cells"]}))  # type: ignore[arg-type]
    monkeypatch.setattr("holosplat.learning.start.LearnedStart.network", property(lambda self: trained))
    monkeypatch.setattr(body_tracker.Following, "network", lambda self: trained.network)
    monkeypatch.setattr("holosplat.bodies.neighbourhood_search.PATIENCE", 1)
    return trained


def test_both_are_followed_and_a_run_goes_on_in_either_part(guessed):
    whole = follow(two_beams(), MATERIAL, short(), journal=(kept := Kept()))
    assert "as bodies of any shape" in whole.begun
    assert (whole.body is None) == whole.begun.endswith("such")
    assert "cells" in kept.states[-1]
    both = [k for k, state in enumerate(kept.states) if "cells" in state]
    for number in (both[0] - 1, both[4 * len(both) // 5], both[-1], len(kept.states) - 1):
        again = follow(two_beams(), MATERIAL, short(), journal=Kept(kept.states[: number + 1]))
        assert torch.equal(again.bodies.coefficients, whole.bodies.coefficients)
        assert again.begun == whole.begun


def test_nobody_asks_for_cells_elsewhere(guessed, monkeypatch):
    monkeypatch.setattr("holosplat.motion.track.cells_or_any", lambda *runs: pytest.fail("cells were asked for"))
    follow(scan(), MATERIAL, short())  # four beams
    follow(two_beams(), MATERIAL, replace(short(), cells=False))
    card = Card(trained_on={"kinds": ["capsules"]})
    monkeypatch.setattr(
        "holosplat.learning.start.LearnedStart.network", property(lambda self: replace(guessed, card=card))
    )
    follow(two_beams(), MATERIAL, short())


def test_a_journal_of_parts():
    kept = Kept()
    parts = Parts(kept)
    parts.of("any").save({"next": "stiff"})
    parts.of("cells").save({"next": "soft"})
    again = Parts(kept)
    assert again.of("any").load() == {"next": "stiff"}
    assert again.of("cells").load() == {"next": "soft"}
    assert Parts(Kept()).of("any").load() is None
    with pytest.raises(InputError, match="checkpoint"):
        Parts(Kept(["no table"]))  # type: ignore[list-item]
