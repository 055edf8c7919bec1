"""What a time hands on to the next one beside its state."""

from __future__ import annotations

import json
import shutil

import pytest

from helpers.series import SETTINGS, known, moving
from holosplat.inference import Decision
from holosplat.methods.contrast import BOTH, SPHERICAL, STAGE
from holosplat.series import one_time
from holosplat.series.folder import read_row
from holosplat.series.one_time import Before, Shot, reconstruct_time
from holosplat.workflows.run_folder import RunFolder


class Asked(Exception):
    """Raised in place of a reconstruction."""


@pytest.mark.parametrize("sides", [BOTH, SPHERICAL])
def test_a_warm_time_is_told_the_sides_that_the_one_before_decided(sides, done, tmp_path, monkeypatch):
    before = RunFolder(tmp_path / "before")
    shutil.copytree(done.run(0, 0), before.path)
    summary = {**before.read_summary(), "decisions": [Decision(STAGE, sides, "views set aside").as_dict()]}
    before.summary.write_text(json.dumps(summary))
    row, priors = read_row(done.row(0, 0)), []

    def asked(scan, prior, *_, **__):
        priors.append(prior)
        raise Asked

    monkeypatch.setattr(one_time, "reconstruct", asked)
    shot = Shot(moving(2).at_instant(1), known(20.0), {}, row)
    with pytest.raises(Asked):
        reconstruct_time(shot, SETTINGS, RunFolder(tmp_path / "next"), Before(before, row))
    assert priors[0].two_sided
    assert priors[0].spherical == (sides == SPHERICAL)
