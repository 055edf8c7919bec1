"""The words of the guide: how many, in sentences how long, and without the constructions that readers stumble over.

The guide is the README, docs/*.md and docs/howto, without the lab notebook (docs/notebook) and the design.
"""

from __future__ import annotations

import re
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
)
"""Regular expressions, of constructions that were replaced; the list only grows."""


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
