"""The words of the guide: how many, in sentences how long, and without the constructions that readers stumble over.

The guide is the README, docs/*.md and docs/howto, without the lab notebook (docs/notebook) and the design. The same
rules hold for the docstrings of the rooms in `PLAIN_ROOMS`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
GUIDE = [README, *sorted(DOCS.glob("*.md")), *sorted((DOCS / "howto").glob("*.md"))]

README_WORDS = 900
PAGE_WORDS = 1500
GUIDE_WORDS = 40_000
MEAN_SENTENCE = 15.0
LONGEST_SENTENCE = 45
BANNED = (
    r"as the frames ask",
    r"asks? the frames",
    r"what suits",
    r"frames? (?:say|says|tell|tells|ask|asks|know|knows|speak|speaks)\b",
    r"(?:is|are|was|were|be|not) told\b",
    r"what is (?:said|told|known|left|asked) (?:of|beside|for)",
    r"(?:is|are) said(?:[.,;]| to be)",
    r"the rather the more",
    r"as they like",
    r"gone on from",
    r"(?:is|are) begun\b",
    r"never looked at before",
    r"looked at once",
    r"was wanted",
    r"as ever\b",
    r"in doubt\b",
    r"but for (?:a|the|what)\b",
    r"for want of",
    r"is no more\b",
    r"next to (?:no|nothing)\b",
    r"in the mean\b",
    r"unasked",
    r"(?:comes|come) by itself",
    r"one is in\b",
    r"takes? it as it is",
    r"of one's own",
    r"where need be",
    r"goes? before\b",
    r"that is no\b",
    r"hands on\b",
    r"foretold\b",
    r"taken up\b",
    r"there (?:is|are) not\b",
    r"lies? there\b",
    r"is wanted\b",
    r"what \w+ has become\b",
    r"and else\b",
    r"told apart\b",
    r"gone on with\b",
)
"""Regular expressions, of constructions that were replaced; the list only grows."""

SOURCE = ROOT / "src" / "holosplat"
PLAIN_ROOMS = (
    *("align", "beamline", "bodies", "learning", "metrics", "model", "motion", "optics", "planning", "preprocess"),
    *("projectors", "report", "representations", "series", "show", "specimens", "fit", "workflows"),
    *("../holosplat_bench/training", "../holosplat_bench/opponents/fields"),
)
"""Rooms whose docstrings have none of the constructions; the list only grows."""
BANNED_FIRST = (
    r"What (?:is|are|was|were) (?:said|told|known|found|left|asked|expected|assumed|minimised)\b",
    r"What (?:\w+ ){0,2}(?:frames?|rows?|beams?|networks?|pages?) (?:\w+ )?(?:say|see|show|tell)",
    r"What .* unless",
    r"Where .* (?:is|are|lies?|lie)(?: really are)?[.:,]",
    r"How .* unless",
    r"Nothing\b",
    r"What (?:\w+ ){1,3}(?:leaves?|gives?|makes?)\b",
    r"What (?:\w+ ){1,2}has become\b",
)
"""First lines of docstrings that name no thing and no act; the list only grows."""
MEAN_DOCSTRING_SENTENCE = 16.0


def docstrings(text: str) -> Iterator[str]:
    """The docstrings of a module, of what it defines, and of its constants and fields."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def awkward(docstring: str) -> list[str]:
    """The banned constructions of a docstring."""
    text = " ".join(docstring.split())
    found = [at for rule in BANNED for at in re.finditer(rf"(?i)\b{rule}", text)]
    first = docstring.strip().split("\n")[0]
    return [text[max(0, at.start() - 40) : at.end() + 40] for at in found] + [
        first for rule in BANNED_FIRST if re.match(rule, first)
    ]


def prose(text: str) -> str:
    """A page without code, tables, marks and headings."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    lines = [line for line in text.splitlines() if not re.match(r"\s*\||#|    |!\[", line)]
    text = re.sub(r"\]\([^)]*\)", "]", "\n".join(lines))
    return re.sub(r"`[^`]*`", "CODE", text)


def sentences(text: str) -> list[list[str]]:
    """The words of each sentence; an item of a list ends one, and so does a blank line."""
    parts = re.split(r"(?<=[.!?])\**\s+|\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", prose(text))
    return [words for part in parts if (words := re.findall(r"[\w’'/-]*[^\W\d_][\w’'/-]*", part)) and len(words) > 1]


def name_of(page: Path) -> str:
    """Where a page lies in the repository."""
    return page.relative_to(ROOT).as_posix()


def test_the_guide_is_short():
    words = {name_of(page): len(page.read_text("utf-8").split()) for page in GUIDE}
    assert words["README.md"] <= README_WORDS
    assert {name: count for name, count in words.items() if count > PAGE_WORDS} == {}
    assert sum(words.values()) < GUIDE_WORDS


def test_sentences_of_the_guide_are_short():
    found = [sentence for page in GUIDE for sentence in sentences(page.read_text("utf-8"))]
    assert sum(map(len, found)) / len(found) <= MEAN_SENTENCE
    assert [" ".join(sentence) for sentence in found if len(sentence) > LONGEST_SENTENCE] == []


@pytest.mark.parametrize("page", GUIDE, ids=name_of)
def test_banned_constructions_are_absent(page):
    text = " ".join(prose(page.read_text("utf-8")).split())
    places = [at for rule in BANNED for at in re.finditer(rf"(?i)\b{rule}", text)]
    found = [text[max(0, at.start() - 40) : at.end() + 40] for at in places]
    assert found == []


def test_sentences_are_counted():
    text = (
        "# A b\n\nOne two. Three *four* five:\n\n- six `--seven 8` nine;\n- ten eleven\n\n| a | b |\n\n```\nx y\n```\n"
    )
    assert [len(sentence) for sentence in sentences(text)] == [2, 3, 3, 2]


@pytest.mark.parametrize("room", PLAIN_ROOMS)
def test_docstrings_of_plain_rooms_are_plain(room):
    files = sorted((SOURCE / room).rglob("*.py"))
    assert files
    found = {
        path.name: awkward(each) for path in files for each in docstrings(path.read_text("utf-8")) if awkward(each)
    }
    assert found == {}


def test_sentences_of_docstrings_are_short():
    texts = [each for path in SOURCE.rglob("*.py") for each in docstrings(path.read_text("utf-8"))]
    found = [sentence for text in texts for sentence in sentences(text.partition("Examples:")[0])]
    assert sum(map(len, found)) / len(found) <= MEAN_DOCSTRING_SENTENCE


@pytest.mark.parametrize(
    ("docstring", "count"),
    [
        ("What frames say of\n    the light.", 2),
        ("What is known of it.", 2),
        ("The options unless they are told.", 1),
        ("What a volume leaves of the frames.", 1),
        ("The scenes are foretold, and else read.", 2),
        ("Estimates of the light from frames.", 0),
    ],
)
def test_awkward_docstrings_are_seen(docstring, count):
    assert len(awkward(docstring)) == count
