"""Empty arguments, such as a variable of a shell that is not set, are refused; they are not the folder one is in."""

from __future__ import annotations

import pytest

from helpers.cli import everything_in, holosplat, known, refused

REMEDY = "must not be empty, but it is; give it a value, or leave it out instead."


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The folder one is in, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("out", [("--out", ""), ("--out=",)])
def test_grow(here, out):
    refused(holosplat("grow", "--cells", 1, "--snapshots", 2, *out), f"holosplat: --out {REMEDY}")
    assert everything_in(here) == set()


@pytest.mark.parametrize("out", [("--out", ""), ("--out=",)])
def test_reconstruct(shop, here, out):
    refused(holosplat("reconstruct", shop.scan, *known(shop), *out), f"holosplat: --out {REMEDY}")
    refused(holosplat("reconstruct", "", *known(shop), "--out", "run"), f"the argument behind reconstruct {REMEDY}")
    assert everything_in(here) == set()


def test_check(here):
    refused(holosplat("check", ""), f"holosplat: the argument behind check {REMEDY}")


def test_no_command(here):
    refused(holosplat(""), f"holosplat: the argument behind holosplat {REMEDY}")


def test_one_of_several_values(shop, here):
    refused(holosplat("simulate", shop.cells[0], "", "--out", "a.nxs"), f"the argument behind {shop.cells[0]} {REMEDY}")


@pytest.mark.parametrize("value", ["fit.schedule.steps=", "="])
def test_values_that_end_with_an_equals_sign_are_for_others_to_judge(shop, here, value):
    said = holosplat("reconstruct", shop.scan, *known(shop), "--out", "run", "--set", value)
    assert said.code == 2
    assert "must not be empty, but it is; give" not in said.err
