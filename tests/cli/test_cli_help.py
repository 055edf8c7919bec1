"""`--help` shows what is essential in plain groups, `--help-all` all options."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from helpers.cli import holosplat, worked
from holosplat.cli.entry import COMMANDS, GROUPS, command
from holosplat.cli.help import ESSENTIAL, acts_of, options_of, parser_of

MOST_LINES = 90
ACTS = {"series": ("plan", "run", "status", "collect"), "bench": ("run", "report", "thesis"), "data": ("list", "fetch")}
CALLS = [call for name in COMMANDS for call in [name, *(f"{name} {act}" for act in ACTS.get(name, ()))]]


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    """A terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")


def options(call):
    """The options of a command, or of an act of one."""
    name, *act = call.split()
    parser = parser_of(command(name), name)
    return options_of(acts_of(parser)[act[0]] if act else parser)


@pytest.mark.parametrize("call", CALLS)
def test_help_is_two_screens_of_plain_text(call):
    short, long = (worked(holosplat(*call.split(), flag)).out for flag in ("--help", "--help-all"))
    assert short.count("\n") < MOST_LINES
    assert not [line for line in short.splitlines() if len(line) > 80 and "{" not in line]
    for said in (short, long):
        assert f"holosplat {call}" in said
        assert not re.search(r"\{None|None\}|\(default: (None|False|True)?\)|reading\.|options\b.*─", said)
        assert not re.search(r"\(default:[^()]*\)[^()]{0,3}\(default:", " ".join(said.split()))
    for option in options(call):
        assert re.search(rf"^  (\[?{re.escape(option.called)})", long, re.MULTILINE), option.called
        assert not option.required or option.called in short
    assert ("--help-all" in short) == (short != long)


def test_reconstruct_needs_two_screens():
    """It was 228 lines."""
    assert worked(holosplat("reconstruct", "--help")).out.count("\n") < MOST_LINES


@pytest.mark.parametrize("call", ESSENTIAL)
def test_essential_options_exist(call):
    """Once each, and some are left for --help-all."""
    known = {option.name for option in options(call)}
    assert set(ESSENTIAL[call]) < known
    assert max(Counter(ESSENTIAL[call]).values()) == 1


def test_every_command_is_in_one_group():
    assert Counter(name for names in GROUPS.values() for name in names) == Counter(list(COMMANDS.own))
    said = worked(holosplat("--help")).out
    assert said == worked(holosplat("-h")).out == worked(holosplat("--help-all")).out
    assert said.count("\n") < MOST_LINES
    assert all(f"\n{heading}\n" in said for heading in GROUPS)
    assert "holosplat --version" in said


def test_help_stands_behind_other_words_too():
    wanted = worked(holosplat("reconstruct", "--help")).out
    assert worked(holosplat("reconstruct", "scan.nxs", "--out", "run", "-h")).out == wanted


def test_none_is_no_value(tmp_path):
    outcome = holosplat("reconstruct", "scan.nxs", "--out", tmp_path / "run", "--density", "None")
    assert outcome.code == 2
    assert "--density" in outcome.err
