"""The scan that small fits explain."""

from __future__ import annotations

import pytest

from helpers.fit_balls import a_scan
from holosplat.scan import Scan


@pytest.fixture(scope="module")
def scan() -> Scan:
    return a_scan()
