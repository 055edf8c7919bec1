"""Every block of code in the README and the guide runs as it stands, in an empty folder, on data that blocks make.

Fits of commands take few steps (`helpers.doc_small.of_few_steps`), and figures of reports are blank.

Blocks of the lab notebook (docs/notebook) are parsed only: they show how numbers were made.

A block that begins with a comment such as `# needs network` or `# takes hours` (`helpers.doc_blocks.EXCUSE`) does not
run as it stands; tests/house/test_docs_commands.py holds the options of its commands to the command line. Most of these
run at a small size (`helpers.doc_small`).
"""

from __future__ import annotations

import os
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.doc_blocks import FAR, Block, blocks, given, misparsed, run, run_block
from helpers.doc_small import PAGES as PAGES_SMALL
from helpers.doc_small import of_few_steps
from helpers.forked import served
from holosplat.methods.presets import read_method

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
ELSEWHERE = ("adding.md",)
"""Pages whose blocks are files of the package: tests/house/test_adding.py runs them."""
DOCS = ROOT / "docs"
NOTEBOOK = DOCS / "notebook"
PAGES = [README, *sorted([*DOCS.glob("*.md"), *(DOCS / "howto").glob("*.md"), *NOTEBOOK.glob("*.md")])]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
WITH_BLOCKS = [page for page, text in TEXTS.items() if page.name not in ELSEWHERE and blocks(text)]
RUN = [page for page in WITH_BLOCKS if page != README and any(block.runs for block in blocks(TEXTS[page]))]
RUN = [page for page in RUN if page.parent != NOTEBOOK]


TAKE_MINUTES = (
    ("docs/command_line.md", "a run of which nothing is told: fits decide about light and matter"),
    ("docs/forecast.md", "cells must be followed well enough to go with the flow of the channel"),
    ("docs/moving_matter.md", "a flow is searched for, of which fewer frames show nothing"),
    ("docs/moving_matter.md", "two fits of networks, whose steps take seconds"),
)
"""Pages with a block that runs nowhere, and why it takes minutes with few pixels, too."""


def name_of(page: Path) -> str:
    """Where a page lies in the repository."""
    return page.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module", autouse=True)
def _of_these_tests() -> Iterator[None]:
    """`python` and `holosplat` in blocks are those of these tests."""
    with served() as folder, pytest.MonkeyPatch.context() as patch:
        places = (str(folder), str(Path(sys.executable).parent), os.environ.get("PATH", ""))
        patch.setenv("PATH", os.pathsep.join(places))
        yield


@pytest.fixture(scope="module")
def few_steps(tmp_path_factory) -> Path:
    """What a shell reads before a block: commands whose fits take few steps."""
    return of_few_steps(tmp_path_factory.mktemp("shell"))


@pytest.fixture(scope="module")
def readme(few_steps, tmp_path_factory) -> Path:
    """The folder in which all blocks of the README were run."""
    folder = tmp_path_factory.mktemp("readme")
    run(TEXTS[README], folder, shell=few_steps)
    return folder


@pytest.mark.slow
def test_the_blocks_of_the_readme_run(readme):
    assert {"scan.nxs", "truth.h5", "run", "moving"} <= {path.name for path in readme.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_the_blocks_of_a_page_run(page, readme, few_steps, tmp_path):
    run(TEXTS[page], tmp_path, readme, few_steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES_SMALL)
def test_blocks_that_take_long_run_at_a_small_size(name, tmp_path):
    """With files that stand in for the reader's, fewer pixels, views and steps, and blank figures."""
    small = PAGES_SMALL[name]
    shell = tmp_path / ".small.sh"
    shell.write_text(small.shell(), encoding="utf-8")
    run_block(Block("sh", small.before), tmp_path)
    found = [block for block in blocks(TEXTS[README if name == "README.md" else DOCS / name]) if small.takes(block)]
    assert found
    for block in found:
        run_block(block, tmp_path, shell)


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name_of)
def test_blocks_are_well_formed(page):
    """Their language is one that is run, parsed here, or output; shell and Python take their syntax."""
    found = blocks(TEXTS[page])
    assert {block.language for block in found} <= {"sh", "python", "toml", ""}
    assert {block.text: misparsed(block) for block in found if misparsed(block)} == {}
    scripts = [name for block in found for name in re.findall(r"^python ([\w/.]+\.py)", block.text, re.MULTILINE)]
    assert [name for name in scripts if not (ROOT / name).is_file()] == []


def test_settings_files_are_read(tmp_path):
    every = [block.text for text in TEXTS.values() for block in blocks(text) if block.language == "toml"]
    found = [text for text in every if "project" not in tomllib.loads(text)]  # that is of a package
    assert found
    for text in found:
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        assert read_method(tmp_path / "mine.toml").kind == "gaussians"


def test_there_are_pages_that_run():
    assert len(RUN) >= 8
    assert any(block.runs for block in blocks(TEXTS[README]))


def test_few_blocks_of_the_guide_run_nowhere():
    """Beside those that need a network or a cluster."""
    left = []
    for page in [page for page in WITH_BLOCKS if page.parent != NOTEBOOK]:
        small = PAGES_SMALL.get("README.md" if page == README else page.relative_to(DOCS).as_posix())
        for block in blocks(TEXTS[page]):
            far = block.language in ("", "toml") or FAR.match(block.text)
            left += [] if block.runs or far or (small and small.takes(block)) else [name_of(page)]
    assert left == [page for page, _ in TAKE_MINUTES]


def test_what_fails_is_seen(tmp_path):
    """In a shell at its first command and in a pipe, and in Python; what has an excuse is not run."""
    ours = "```sh\nholosplat info nowhere.nxs\n```\n"
    for text in (ours, "```sh\nfalse\ntrue\n```\n", "```sh\nfalse | cat\n```\n", "```python\nassert 0\n```\n"):
        with pytest.raises(AssertionError):
            run(text, tmp_path)
    run("```sh\n# needs network: a file\nfalse\n```\n\n```\nfalse\n```\n", tmp_path)
    assert given("`a.nxs` and\n`b.h5` are made\n[in the README](../README.md#your-own-cells).") == ["a.nxs", "b.h5"]
    assert misparsed(Block("sh", "if true\n"))
    assert misparsed(Block("python", "a =\n"))
