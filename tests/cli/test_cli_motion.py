"""`reconstruct --motion`: one option says how matter changes between times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from holosplat.checks import InputError
from holosplat.cli import track as of_bodies
from holosplat.cli.commands import Asked, CarriedFlags, reconstruct
from holosplat.cli.options import MethodOptions
from holosplat.cli.view import LiveFlags
from holosplat.io.reading import Part, Reading


@pytest.mark.parametrize(
    ("motion", "time_frame"), [(None, None), ("still", "still"), ("each", "each"), ("flow", "all"), ("bodies", None)]
)
def test_motion_takes_the_times_that_it_needs(motion, time_frame):
    assert CarriedFlags(motion).applied(Reading()).part.time_frame == time_frame


def test_one_time_and_a_motion_exclude_each_other():
    with pytest.raises(InputError, match="--motion flow takes all times, but --time-frame is 3; leave one"):
        CarriedFlags("flow").applied(Reading(part=Part(time_frame=3)))
    assert CarriedFlags().applied(Reading(part=Part(time_frame=3))).part.time_frame == 3


def test_bodies_are_tracked(monkeypatch):
    asked, given = Asked(motion=CarriedFlags("bodies")), []
    monkeypatch.setattr(of_bodies, "track", lambda *where, **how: given.append((where, how)))
    reconstruct(Path("scan.nxs"), Path("run"), asked, seed=3)
    (where, how), *others = given
    assert not others
    assert where == (Path("scan.nxs"), Path("run"), asked.matter)
    assert (how["seed"], how["resume"], how["reading"]) == (3, False, Reading())


@pytest.mark.parametrize(
    ("change", "live", "name"),
    [
        ({"how": MethodOptions(method="voxels")}, LiveFlags(), "--method"),
        ({"how": MethodOptions(matter="levels")}, LiveFlags(), "--matter"),
        ({}, LiveFlags(view=True), "them, or choose a time"),
    ],
)
def test_bodies_refuse_what_they_cannot_do(change, live, name):
    asked = replace(Asked(motion=CarriedFlags("bodies")), **change)
    with pytest.raises(InputError, match=f"leave {name}"):
        reconstruct(Path("scan.nxs"), Path("run"), asked, live=live)
