"""Fits of a few steps: smooth volumes that would begin again with weaker priors, in vain, for a few steps explain no
frames; and the likelihood of δ/β.

tests/methods/test_volume.py holds that priors are weakened, and that a fit that was stopped goes on with them, and
tests/methods/test_uncertain.py what the likelihood finds.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from functools import partial

import pytest

from holosplat.baselines import HolographicTV
from holosplat.methods import levels, smooth_fit
from holosplat.methods.profile import ProfileOptions
from holosplat.methods.uncertain import likeliest_ratio

QUICK = ProfileOptions(
    iterations=10, start=HolographicTV(retrieval=15, iterations=30, corrections=0, noisy=1.0, refine=1, upper=0.0)
)
"""Volumes of few steps, whose likelihood says what that of the usual ones does of small frames without noise."""


@contextlib.contextmanager
def in_one_go() -> Iterator[None]:
    """Within, smooth volumes take their frames for explained, and keep the prior that they have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth_fit, "EXPLAINED", math.inf)
        patch.setattr(smooth_fit, "WEAKER", math.inf)
        yield


@contextlib.contextmanager
def in_few_steps() -> Iterator[None]:
    """Within, the likeliest δ/β of frames is that of `QUICK` volumes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(levels, "likeliest_ratio", partial(likeliest_ratio, options=QUICK))
        yield
