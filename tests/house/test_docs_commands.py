"""Commands in the documentation parse: what a reader copies, holosplat understands."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import tyro

from holosplat.cli import entry
from holosplat.cli.help import CONFIG

ROOT = Path(__file__).resolve().parents[2]
OPTION = re.compile(r"(?<!\S)(--[a-z][a-z-]*)")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").glob("*.sh")])
STANDS_FOR = {
    r"\$\(holosplat data fetch [^)]*\)": "fetched.nxs",
    r"\{nxtomo, [^}]*\}": "nxtomo",
    r"--pixel-size \$p\b": "--pixel-size 1e-6",
    r"\$[n1]\b": "1",
    r"\$geometry": "--detector 64 64 --pixel-size 1e-6",
}
"""What a reader or a shell puts into commands, and an example of it."""


def commands(page: Path) -> list[str]:
    """Commands of a page that stand by themselves, one line each."""
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))
    blocks = [text] if page.suffix == ".sh" else re.findall(r"^```(?:sh)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()] + re.findall(r"^    (.*)$", text, re.MULTILINE)
    found = []
    for line in lines:
        fetched = re.findall(r"\$\((holosplat data [^)]*)\)", line)
        for shown, meant in STANDS_FOR.items():
            line = re.sub(shown, meant, line)
        found += fetched
        found += re.findall(r"(?:^|[;&] ?(?:do )?)\s*(holosplat .+?)(?= [#|&>]|[;)]|$)", line)
    return list(dict.fromkeys(command.strip() for command in found))


def options(page: Path) -> list[tuple[str, str]]:
    """Pairs of command and option in running text, such as `surface --threads`."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    spans = re.findall(r"`(?:holosplat )?([a-z]+)( [^`]*)`", text)
    return [(name, option) for name, rest in spans if name in entry.COMMANDS for option in OPTION.findall(rest)]


@functools.cache
def silent(name: str) -> Callable[..., None]:
    """The command `name`, which takes what it takes and does nothing."""
    real = entry.command(name)

    @functools.wraps(real)
    def nothing(*args: object, **kwargs: object) -> None:
        pass

    return nothing


def misunderstood(command: str) -> str:
    """What the parser says of a command; empty where it understands it."""
    _, name, *words = shlex.split(command)
    if name in ("data", "bench", "series"):  # whose acts would run: their help says what they take
        shown = parsed(name, [words[0], "--help"])[1]
        return " ".join(word for word in words[1:] if word.startswith("--") and word not in shown)
    code, said = parsed(name, words)
    return said if code else ""


def parsed(name: str, words: list[str]) -> tuple[object, str]:
    """Exit code of the parser, and what it prints."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            tyro.cli(silent(name), args=words, prog=name, config=CONFIG)
        except SystemExit as end:
            return end.code, said.getvalue()
    return 0, said.getvalue()


COMMANDS = {command: page for page in reversed(PAGES) for command in commands(page)}
"""Each command once, with the first page that has it."""


def test_there_are_commands():
    assert len(COMMANDS) > 80


@pytest.mark.parametrize("name", entry.COMMANDS)
def test_commands_parse(name):
    mine = {command: page.name for command, page in COMMANDS.items() if command.split()[1:2] == [name]}
    assert {f"{page}: {command}": misunderstood(command) for command, page in mine.items()} == {
        f"{page}: {command}": "" for command, page in mine.items()
    }


@functools.cache
def explained(name: str) -> str:
    """The help of a command, of all its acts."""
    acts = {
        "bench": ("run", "report", "thesis"),
        "data": ("fetch",),
        "series": ("plan", "run", "status", "collect"),
    }.get(name, ())
    return "".join(parsed(name, words)[1] for words in ([["--help"]] if not acts else [[a, "--help"] for a in acts]))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_in_running_text_exist(page):
    unknown = [pair for pair in options(page) if not re.search(rf"{pair[1]}(?![a-z-])", explained(pair[0]))]
    assert unknown == []


def test_what_does_not_parse_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Run `plan --tilts 3`.\n\n```sh\nholosplat plan --ball x  # a ball\n```\n\n    holosplat fly\n")
    assert commands(page) == ["holosplat plan --ball x", "holosplat fly"]
    assert options(page) == [("plan", "--tilts")]
    assert "--ball" in misunderstood("holosplat plan --ball x")


def test_all_are_commands():
    assert [command for command in COMMANDS if command.split()[1] not in entry.COMMANDS] == []
