"""Levels or continuous matter, decided once for the same frames: it takes most of a run in a few steps."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator

import pytest

from holosplat.methods import Task
from holosplat.methods.levels import STAGE, Decision, LevelTest, decide_matter
from holosplat.workflows.provenance import scan_hash


@contextlib.contextmanager
def decided_once() -> Iterator[dict[tuple[object, ...], Decision]]:
    """Within, runs take the decision of an earlier run on the same scan, prior and options; gives those made.

    tests/methods/test_levels.py holds what decides.
    """
    made: dict[tuple[object, ...], Decision] = {}

    def decide(task: Task, options: LevelTest) -> Decision:
        key = (scan_hash(task.scan), task.prior, options, task.light, task.uneven is None)
        if key in made:
            task.on_progress(STAGE, 0.0)
        else:
            made[key] = decide_matter(task, options)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("holosplat.methods.solve"), "decide_matter", decide)
        yield made
