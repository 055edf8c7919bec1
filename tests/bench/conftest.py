"""A recorder of what a method is given."""

from __future__ import annotations

import pytest

from helpers.bench_shop import Recorder


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()
