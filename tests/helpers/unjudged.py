"""Runs that are not judged, and runs that compare no hypotheses about light: a third of what a tiny run takes, each.

tests/workflows (verdict, totals, run folders) and the commands judge what every kind of method makes; tests/methods and
tests/workflows/test_run_light.py decide about light.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from holosplat.methods import illumination
from holosplat.methods.cross_validation import FirstVolumes
from holosplat.methods.illumination import Prepared, decided
from holosplat.methods.trials import Hypothesis
from holosplat.optics.background import LightOptions
from holosplat.workflows.totals import TotalMatter
from holosplat.workflows.verdict import POWERS, Verdict

POWER = dict.fromkeys(POWERS, np.ones((1, 1)))
VERDICT = Verdict(True, "Not judged.", (), np.array([[1e-6, np.inf]]), **POWER, tested={})
TOTAL = TotalMatter("δ", None, None, 0.0, "total δ: not told")


@contextlib.contextmanager
def in_plain_light() -> Iterator[None]:
    """Within, runs that are told nothing of light and noise take both for plain."""

    def plainly(first: FirstVolumes, options: LightOptions, told: Hypothesis, *how: Any) -> Prepared:
        return decided(first, options, told, *how) if told else ((), ())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(illumination, "decided", plainly)
        yield


@contextlib.contextmanager
def unjudged() -> Iterator[None]:
    """Within, every run has `VERDICT` and `TOTAL`; all else of it is as ever."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("holosplat.workflows.reconstruct.judge_run", lambda *run: VERDICT)
        patch.setattr("holosplat.workflows.reconstruct.total_of_run", lambda *run: TOTAL)
        yield
