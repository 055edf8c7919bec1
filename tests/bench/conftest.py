"""What tests of the benchmark share: a recorder of what a method is given, and the frames of the contract."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import pytest

import holosplat as hs
from helpers.bench_shop import Recorder
from helpers.contract import PHOTOGRAPHS, two_balls
from helpers.once import Once, once
from helpers.unjudged import in_plain_light
from holosplat_bench.suite.methods import METHODS


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture(scope="session", autouse=True)
def _no_search_for_garbage() -> Iterator[None]:
    """The benchmark looks for garbage before each method, for its memory; here that is a third of a row."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("holosplat_bench.suite.run.gc", SimpleNamespace(collect=lambda: None))
        yield


@pytest.fixture(scope="module")
def scan() -> hs.Scan:
    """The frames of the contract of methods."""
    return two_balls()


@pytest.fixture(scope="module")
def decided(request) -> Iterator[None]:
    """All methods but those of photographs ask the same of the same frames: what their matter is, and what a first
    volume shows."""
    memory = Once()
    with once(memory), in_plain_light():
        yield
    asking = [name for name in METHODS if name not in PHOTOGRAPHS]
    here = [item.name for item in request.session.items if item.path == request.path]
    asked = any(test.endswith(f"{name}]") for test in here for name in asking)
    assert asked <= len(memory.made) < 2 * len(METHODS)  # fits that decide ask of fewer frames, too
