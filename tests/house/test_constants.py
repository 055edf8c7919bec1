"""docs/design/constants.md lists every constant with a number of the rooms that lead from frames to matter."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "holosplat"
PAGE = ROOT / "docs" / "design" / "constants.md"
ROOMS = ("align", "baselines", "bodies", "fit", "inference", "methods", "model", "motion", "optics", "preprocess")
ROOMS += ("representations",)
FILES = ("matter.py", "materials.py")


def constants(text: str) -> set[str]:
    """Names in capitals that a module assigns something with a number in it."""
    found: set[str] = set()
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        numbers = [
            part.value
            for part in ast.walk(node.value)
            if isinstance(part, ast.Constant) and type(part.value) in (int, float)
        ]
        names = {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}
        if numbers and all(re.fullmatch(r"[A-Z][A-Z0-9_]*", name) for name in names):
            found |= names
    return found


def in_the_source() -> set[tuple[str, str]]:
    """(file, name) of every constant in the rooms."""
    files = [path for room in ROOMS for path in (SOURCE / room).rglob("*.py")] + [SOURCE / name for name in FILES]
    named = ((path.relative_to(SOURCE).as_posix(), constants(path.read_text(encoding="utf-8"))) for path in files)
    return {(path, name) for path, names in named for name in names}


def on_the_page() -> list[tuple[str, str]]:
    """(file, name) of every entry."""
    rows = [line.split("|") for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    return [(row[1].strip(" `"), name) for row in rows for name in re.findall(r"`([^`]+)`", row[2])]


def test_the_page_lists_the_constants():
    """A new constant that tunes is better a field of options; else it gets a line on the page."""
    listed, there = on_the_page(), in_the_source()
    assert sorted(there - set(listed)) == []
    assert sorted(set(listed) - there) == []
    assert len(listed) == len(set(listed))


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("A = 1", {"A"}),
        ("A, B = 1, 2.0", {"A", "B"}),
        ("A: float = 3", {"A"}),
        ("A = f(x=2)", {"A"}),
        ("A = True", set()),
        ('A = "text"', set()),
        ("a = 1", set()),
        ("def f():\n    A = 1", set()),
    ],
)
def test_constants_are_found(line, names):
    assert constants(line) == names
