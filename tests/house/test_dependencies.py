"""Dependencies are pinned within their bounds, and continuous integration runs targets that are there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
UNPINNED = ("bench",)
"""Extras that no target of the Makefile installs."""


def pins(text: str) -> dict[str, str]:
    """Name → version of every line of a file of constraints."""
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}


def complaints(project: dict, pinned: dict[str, str]) -> list[str]:
    """Dependencies of a project table that have no pin, or one below their bound."""
    extras = project.get("optional-dependencies", {})
    named = [*project["dependencies"], *(d for extra, ds in extras.items() if extra not in UNPINNED for d in ds)]
    found = []
    for requirement in map(Requirement, named):
        version = pinned.get(canonicalize_name(requirement.name))
        if version is None:
            found.append(f"{requirement.name} is not pinned")
        elif not requirement.specifier.contains(version):
            found.append(f"{requirement.name} is pinned to {version}, which is not {requirement.specifier}")
    return found


def test_every_dependency_is_pinned_within_its_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert complaints(project, pins(text)) == []
    names = list(pins(text))
    assert names == sorted(names), "constraints.txt is in the order of names"


@pytest.mark.parametrize(
    ("pinned", "said"),
    [
        ({"numpy": "2.0"}, "torch is not pinned"),
        ({"numpy": "2.0", "torch": "2.3"}, "torch is pinned to 2.3, which is not >=2.4"),
        ({"numpy": "2.0", "torch": "2.4"}, None),
    ],
)
def test_missing_and_low_pins_are_seen(pinned, said):
    project = {"dependencies": ["numpy>=1.26"], "optional-dependencies": {"dev": ["torch>=2.4"], "bench": ["x"]}}
    assert complaints(project, pinned) == ([said] if said else [])


def test_continuous_integration_runs_targets_that_are_there():
    """Lint and types, tests, docs: each of them, in this order."""
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    run = re.findall(r"^make (?:--jobs \d )?(\w+)\b", script, re.MULTILINE)
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert run == ["check", "test", "docs"]
    assert set(run) <= set(targets)
    assert "set -euo pipefail" in script
