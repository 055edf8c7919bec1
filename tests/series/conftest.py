"""What the tests of series share: the scan of a tiny one, and a file of each of its times."""

from __future__ import annotations

import pytest

from helpers.once import once
from helpers.series import TIMES, Files, moving, planned
from helpers.unjudged import in_plain_light, unjudged
from holosplat.io.nxtomo import write_scan
from holosplat.series.folder import SeriesFolder
from holosplat.series.run import Counts, counted, run_left, states


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> Files:
    path = tmp_path_factory.mktemp("series")
    made, scan = Files(path, path / "moving.nxs", path / "each"), moving(TIMES)
    write_scan(made.scan, scan)
    made.each.mkdir()
    for k in range(3):
        write_scan(made.each / f"scan{9 + k}.nxs", scan.at_instant(k))
    return made


@pytest.fixture(scope="session")
def done(files, memory, tmp_path_factory) -> SeriesFolder:
    """A series of three tasks that are done; nobody changes it."""
    folder = planned(tmp_path_factory.mktemp("done") / "series", files.scan)
    assert counted(states(folder)) == Counts(0, 0, 0, 3)
    with unjudged(), once(memory), in_plain_light():
        assert run_left(folder) == Counts(3, 0, 0, 0)
    return folder


@pytest.fixture(autouse=True)
def _unjudged(unjudged_runs: None) -> None:
    """Verdicts and totals are tested in tests/workflows."""


@pytest.fixture(scope="module", autouse=True)
def _once(plain_light: None) -> None:
    """All runs share what they begin with, and take light for plain where nothing is told."""
