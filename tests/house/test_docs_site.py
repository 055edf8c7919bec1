"""The documentation: its links lead somewhere in the repository and on the site, and its pages are made as they should.

`make docs` builds the site itself, where every warning is an error.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import holosplat
from helpers.docs_site import loaded

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


site = loaded("pages")
gallery = loaded("gallery")


# --- links --------------------------------------------------------------------------------------------------


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings: lower case, no punctuation, hyphens for blanks."""
    titles = re.findall(r"^#{1,6} (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def broken_links(page: Path, text: str) -> list[str]:
    """Links of a Markdown page in the repository that lead to no file, or to no heading of it."""
    broken = []
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", re.sub(r"`[^`]*`", "", text)):
        if re.match(r"[a-z]+:", target):
            continue
        there = (page.parent / target).resolve() if target else page
        found = there.exists() and (
            not anchor or anchor in anchors(text if there == page else there.read_text("utf-8"))
        )
        if not found:
            broken.append(f"{target}#{anchor}" if anchor else target)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    assert broken_links(page, page.read_text(encoding="utf-8")) == []


def test_broken_links_are_seen():
    page = ROOT / "README.md"
    assert broken_links(page, "[a](docs/no.md) [b](docs/method.md#no) [c](docs/method.md#the-start)") == [
        "docs/no.md",
        "docs/method.md#no",
    ]


GONE = ROOT / "docs" / "design" / "model_and_problem.md"
"""A page that also names files of earlier versions."""


def missing_files(text: str) -> list[str]:
    """Source files that a page names, such as `fit/loop.py`, and that are not in the repository.

    A path counts from the repository, the package or any folder in it.
    """
    named = {
        name for span in re.findall(r"`([^`\n]+)`", text) for name in re.findall(r"[\w./-]+\.(?:py|cpp|hpp)\b", span)
    }
    rooms = ("src", "native", "tests", "docs", "examples", "benchmarks", "packaging")
    there = [path.as_posix() for room in rooms for path in (ROOT / room).rglob("*.[ch]*")]
    there += [path.as_posix() for room in rooms for path in (ROOT / room).rglob("*.py")]
    made = set(re.findall(r"(?:This is all of|, say)\s+`([\w/.]+)`", text))  # by the reader
    return sorted(name for name in named - made if not any(path.endswith(f"/{name}") for path in there))


@pytest.mark.parametrize("page", [p for p in PAGES if p != GONE], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_named_files_exist(page):
    assert missing_files(page.read_text(encoding="utf-8")) == []


def test_missing_files_are_seen():
    assert missing_files("See `fit/loop.py`, `fit/misfit.py` and `python benchmarks/none.py --csv FILE`.") == [
        "benchmarks/none.py",
        "fit/misfit.py",
    ]


def unknown_names(text: str) -> list[str]:
    """Names such as `hs.io.read_scan` in a page that the package has not."""
    unknown = []
    for name in sorted(set(re.findall(r"\bhs((?:\.[A-Za-z_]+)+)", text))):
        thing: object = holosplat
        for part in name.split(".")[1:]:
            thing = getattr(thing, part, None)
        if thing is None:
            unknown.append(f"hs{name}")
    return unknown


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_names_of_the_package_exist(page):
    assert unknown_names(page.read_text(encoding="utf-8")) == []


def test_unknown_names_are_seen():
    assert unknown_names("`hs.io.read_scan(path)`, `hs.no_such`, `hs.io.no_such`") == ["hs.io.no_such", "hs.no_such"]


@pytest.mark.parametrize(
    ("page", "link", "turned"),
    [
        ("index.md", "docs/method.md#two-materials", "method.md#two-materials"),
        ("index.md", "docs/images/hero.png", "images/hero.png"),
        ("index.md", "CONTRIBUTING.md", "contributing.md"),
        ("index.md", "examples/01_a.py", "gallery/01_a.md"),
        ("viewing.md", "notebooks/01_a.ipynb", "notebooks/01_a.md"),
        ("simulation.md", "../README.md", "index.md"),
        ("simulation.md", "conventions.md", "conventions.md"),
        ("design/architecture.md", "../conventions.md", "../conventions.md"),
        ("design/architecture.md", "../../README.md", "../index.md"),
        ("index.md", "https://example.org/a.md", "https://example.org/a.md"),
    ],
)
def test_links_fit_the_site(page, link, turned):
    assert site.linked(f"See [this]({link}), please.", page) == f"See [this]({turned}), please."


# --- pages --------------------------------------------------------------------------------------------------


def test_the_api_lists_every_public_module_once():
    rooms = site.modules(ROOT / "src" / "holosplat")
    names = [name for room in rooms.values() for name in room]
    assert len(names) == len(set(names)) > 100
    assert {"holosplat.geometry", "holosplat.scan"} <= set(rooms["holosplat"])
    assert {"holosplat.optics", "holosplat.optics.camera", "holosplat.optics.hologram"} <= set(rooms["optics"])
    assert not [name for name in names if re.search(r"\.(cpu|cuda|triton_\w+|__\w+__)$", name)]


def test_the_api_describes_the_top_level_names():
    index = site.api_pages()["api/index.md"]
    assert "[`Views`][holosplat.geometry.Views]: The poses of V views, and the raster of their detectors." in index
    assert "[holosplat.optics](optics.md)" in index


@pytest.mark.parametrize(
    ("html", "addresses"),
    [
        ('<a href="https://example.org">a</a><script src="assets/a.js"></script>', []),
        ('<script defer src="https://example.org/a.js"></script>', ["https://example.org/a.js"]),
        ('<link rel="stylesheet" href="//example.org/a.css">', ["//example.org/a.css"]),
    ],
)
def test_what_a_page_loads_from_elsewhere_is_seen(html, addresses):
    assert site.loads_from_elsewhere(html) == addresses


def test_docstrings_become_markdown():
    pytest.importorskip("griffe", reason="the extra `docs` is not installed")
    text = "Weights [N] [m], *not* a*b, `[x]`.\n\nfirst, second [px]: one;\n    goes on.\nthird: `a_b` a_b.\n\nEnd."
    examples = "\n\nExamples:\n\n    >>> [a_b]\n    ... [*c]\n    1\n    >>> d"
    assert loaded("docstrings").markdown(text + examples) == (
        "Weights \\[N\\] \\[m\\], *not* a\\*b, `[x]`.\n\n\n"
        "- **first, second \\[px\\]**: one;\n    goes on.\n- **third**: `a_b` a\\_b.\n\nEnd.\n\nExamples:\n\n"
        "```pycon\n>>> [a_b]\n... [*c]\n1\n>>> d\n```\n"
    )


# --- the gallery --------------------------------------------------------------------------------------------

GOOD = '''"""A title: `python a.py [folder]`.

A text.
"""

import sys
from pathlib import Path

out = Path(sys.argv[1])
out.mkdir()
(out / "a_picture.png").write_bytes(b"")
print("score 1.0 in", out.resolve())
'''


def test_an_example_becomes_a_page(tmp_path):
    (tmp_path / "01_a.py").write_text(GOOD)
    pages = gallery.build(tmp_path, tmp_path / "gallery")
    assert [page.name for page in pages] == ["01_a.md"]
    text = pages[0].read_text(encoding="utf-8")
    assert text.startswith("# A title\n\nA text.\n\n```python\nimport sys\n")
    assert "```text\nscore 1.0 in out\n```" in text
    assert "![A picture](01_a/out/a_picture.png)" in text
    made = site.gallery_pages(tmp_path / "gallery")
    assert list(made) == ["gallery/index.md", "gallery/01_a.md"]
    assert "## [A title](01_a.md)\n\nA text." in made["gallery/index.md"]
    assert [path.name for path in site.gallery_pictures(tmp_path / "gallery")] == ["a_picture.png"]


@pytest.mark.parametrize("fault", ["raise SystemExit(3)", "sys.stderr.write('warning')"])
def test_an_example_that_fails_or_warns_fails_the_build(tmp_path, fault):
    (tmp_path / "01_a.py").write_text(GOOD + fault + "\n")
    with pytest.raises(RuntimeError, match="01_a"):
        gallery.build(tmp_path, tmp_path / "gallery")


def test_a_gallery_that_was_not_built_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no pages"):
        site.gallery_pages(tmp_path)
