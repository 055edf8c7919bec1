"""Runs that are not judged: verdict and total are a third of what a tiny run takes.

tests/workflows (verdict, totals, run folders) and the commands judge what every kind of method makes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import pytest

from holosplat.workflows.totals import TotalMatter
from holosplat.workflows.verdict import POWERS, Verdict

POWER = dict.fromkeys(POWERS, np.ones((1, 1)))
VERDICT = Verdict(True, "Not judged.", (), np.array([[1e-6, np.inf]]), **POWER, tested={})
TOTAL = TotalMatter("δ", None, None, 0.0, "total δ: not told")


@contextlib.contextmanager
def unjudged() -> Iterator[None]:
    """Within, every run has `VERDICT` and `TOTAL`; all else of it is as ever."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("holosplat.workflows.reconstruct.judge_run", lambda *run: VERDICT)
        patch.setattr("holosplat.workflows.reconstruct.total_of_run", lambda *run: TOTAL)
        yield
