"""Fits of a few steps, which explain no frames: a smooth volume would begin again with weaker priors, in vain.

tests/methods/test_volume.py holds that priors are weakened, and that a fit that was stopped goes on with them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import pytest

from holosplat.methods import smooth_fit


@contextlib.contextmanager
def in_one_go() -> Iterator[None]:
    """Within, smooth volumes take their frames for explained, and keep the prior that they have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth_fit, "EXPLAINED", math.inf)
        patch.setattr(smooth_fit, "WEAKER", math.inf)
        yield
