"""Code blocks of a page of the documentation: what is run of them, in which folder, and what is not."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXCUSE = re.compile(r"# (?:needs (?:network|a browser|a cluster|files of yours)|takes (?:minutes|hours|days))\b")
"""How a block begins, for the reader to see, that is not run but only parsed."""
FAR = re.compile(r"# needs (?:network|a browser|a cluster)\b")
"""How a block begins of these that no test can run."""
GIVEN = re.compile(
    r"((?:`[\w.]+`(?:,\s+|\s+and\s+)?)+)\s+(?:is|are)\s+made\s+"
    r"\[in\s+the\s+README\]\([./]*README\.md#your-own-cells\)"
)
"""Files that a page takes from what the README's commands make."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language (empty for output) and its text."""

    language: str
    text: str

    @property
    def runs(self) -> bool:
        """Whether it is code that is to run as it stands."""
        return self.language in ("sh", "python") and not EXCUSE.match(self.text)


def blocks(page: str) -> list[Block]:
    """All fenced blocks of a page, in their order."""
    return [Block(*found) for found in BLOCK.findall(page)]


def given(page: str) -> list[str]:
    """Names of the files that the page takes from the README's folder."""
    return [name for found in GIVEN.findall(page) for name in re.findall(r"`([\w.]+)`", found)]


def run(page: str, folder: Path, readme: Path | None = None, shell: Path | None = None) -> None:
    """Run the blocks of a page in a folder, in their order; a block that fails ends it with what it said.

    shell: a file that shells read before.
    """
    for name in given(page):
        assert readme is not None
        shutil.copy(readme / name, folder)
    for block in blocks(page):
        if block.runs:
            run_block(block, folder, shell)


FEW_STEPS = """import holosplat as hs
hs.reconstruct = lambda scan, prior, method=hs.methods.Auto(), reconstruct=hs.reconstruct, **how: reconstruct(
    scan, prior, method.with_effort(0.02), **how)
"""
"""What Python reads before a block."""


def run_block(block: Block, folder: Path, shell: Path | None = None) -> None:
    """Run a block in a folder; one that fails ends it with what it said. shell: a file that a shell reads before;
    with one, fits of Python take few steps, too."""
    words = ["bash", "-euo", "pipefail", "-c"] if block.language == "sh" else [sys.executable, "-c"]
    before = FEW_STEPS if shell and block.language == "python" else ""
    env = _environment() | ({"BASH_ENV": str(shell)} if shell else {})
    done = subprocess.run([*words, before + block.text], cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, f"{block.text}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def _environment() -> dict[str, str]:
    """That of a terminal without a screen. What `python` and `holosplat` are there says PATH."""
    return os.environ | {"MPLBACKEND": "agg"}


def misparsed(block: Block) -> str:
    """What a shell or Python says of the syntax of a block; empty where there is nothing to say."""
    if block.language == "sh":
        return subprocess.run(["bash", "-n"], input=block.text, capture_output=True, text=True).stderr
    try:
        compile(block.text if block.language == "python" else "", "block", "exec")
    except SyntaxError as error:
        return str(error)
    return ""
