"""The files of a release agree on the version and keep their forms: CHANGELOG.md, CITATION.cff, pyproject.toml."""

from __future__ import annotations

import re
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import yaml

from holosplat import __version__

ROOT = Path(__file__).resolve().parents[2]
SECTIONS = ("Added", "Changed", "Deprecated", "Removed", "Fixed", "Security")
LICENSE = "BSD-3-Clause"


def project() -> dict[str, Any]:
    """The table `project` of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def changelog_complaints(text: str) -> list[str]:
    """Where the text leaves the form of Keep a Changelog 1.1.0."""
    complaints = [] if text.startswith("# Changelog\n") else ["the title is not `# Changelog`"]
    headings = re.findall(r"^(#{2,}) (.*)$", text, re.MULTILINE)
    versions = []
    for level, title in headings:
        if level == "##":
            match = re.fullmatch(r"\[(\d+)\.(\d+)\.(\d+)\] - (\d{4}-\d\d-\d\d)", title)
            if title == "[Unreleased]":
                continue
            if match is None:
                complaints.append(f"`{title}` is not `[X.Y.Z] - YYYY-MM-DD`")
                continue
            date.fromisoformat(match[4])
            versions.append(tuple(int(part) for part in match.groups()[:3]))
        elif level != "###" or title not in SECTIONS:
            complaints.append(f"`{title}` is not one of {', '.join(SECTIONS)}")
    if versions != sorted(set(versions), reverse=True):
        complaints.append("the versions do not descend")
    return complaints


def citation_complaints(cff: Any) -> list[str]:
    """Where the file leaves the schema of the Citation File Format 1.2.0: missing keys, wrong types, unknown keys."""
    complaints = [f"{key} is missing" for key in ("cff-version", "message", "title", "authors") if key not in cff]
    texts = ("cff-version", "message", "title", "type", "abstract", "version", "license")
    complaints += [f"{key} is not text" for key in texts if key in cff and not isinstance(cff[key], str)]
    complaints += [f"{key} is unknown" for key in cff if key not in (*texts, "authors", "keywords", "date-released")]
    if cff.get("type", "software") not in ("software", "dataset"):
        complaints.append("type is neither software nor dataset")
    for author in cff.get("authors") or ["none"]:
        if not isinstance(author, dict) or not ("name" in author or "family-names" in author):
            complaints.append(f"author {author!r} has no name")
    if not all(isinstance(word, str) for word in cff.get("keywords", [])):
        complaints.append("keywords are not all text")
    return complaints


def test_the_versions_agree():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    newest = re.search(r"^## \[(\d+\.\d+\.\d+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert project()["version"] == __version__
    assert citation["version"] == __version__
    assert newest is not None
    assert newest[1] == __version__


def test_the_license_agrees():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["license"] == project()["license"] == LICENSE


def test_the_changelog_keeps_its_form():
    assert changelog_complaints((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "text",
    [
        "# Changes\n\n## [1.0.0] - 2026-01-01\n",
        "# Changelog\n\n## 1.0.0\n",
        "# Changelog\n\n## [1.0.0] - 2026-01-01\n\n### News\n",
        "# Changelog\n\n## [1.0.0] - 2026-01-01\n\n## [1.1.0] - 2026-02-01\n",
    ],
)
def test_a_changelog_out_of_form_is_seen(text):
    assert len(changelog_complaints(text)) == 1


def test_the_citation_keeps_its_schema():
    assert citation_complaints(yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))) == []


GOOD = {"cff-version": "1.2.0", "message": "cite", "title": "t", "authors": [{"name": "a"}]}


@pytest.mark.parametrize(
    "wrong",
    [{"title": 1}, {"authors": []}, {"authors": [{"email": "a@b.c"}]}, {"type": "book"}, {"licence": "MIT"}],
)
def test_a_citation_out_of_schema_is_seen(wrong):
    assert citation_complaints(GOOD) == []
    assert len(citation_complaints(GOOD | wrong)) == 1
