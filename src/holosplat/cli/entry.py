"""The commands by name, and `main`, which loads the module of one command only: the others need torch, VTK or figures.

The overview (`holosplat --help`) comes from the tables alone. A command's module imports what its options need, and
each function imports its work where it starts, so that `holosplat COMMAND --help` is fast, too.

`--resume RUN` alone: the scan and the options are those that the run was begun with.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import tyro

from ..checks import InputError, as_written, is_of_memory, require
from ..io.provenance import MADE, NAME, fingerprint, from_home, origin, records
from ..plugins import Extended
from ..ranges import checked_later
from ..version import __version__
from .help import ALL, CONFIG, HELP, acts_of, overview, page, parser_of
from .places import with_checked_arguments
from .progress import end_as_on_interrupt, logged, say_notes
from .sentence import INTERRUPTED, give_up, say, say_that_libraries_load

LONGEST = 200
"""Characters of another program's message, at most."""

EMPTY = re.compile("(--[^=]+)=")
"""An option to which nothing is given."""

GROUPS: dict[str, dict[str, str]] = {
    "Data": {
        "info": "data",
        "convert": "convert",
        "correct": "imaging",
        "join": "imaging",
        "data": "data",
        "materials": "data",
        "check": "data",
    },
    "Simulate": {"plan": "plan", "grow": "imaging", "simulate": "simulate", "record": "imaging"},
    "Reconstruct": {
        "init": "pipeline",
        "run": "pipeline",
        "calibrate": "align",
        "align": "align",
        "retrieve": "convert",
        "reconstruct": "commands",
        "track": "track",
        "surface": "track",
    },
    "Look": {
        "evaluate": "commands",
        "rehearse": "view",
        "view": "view",
        "export": "commands",
        "render": "commands",
        "compare": "view",
    },
    "Series": {"series": "series", "watch": "series", "forecast": "forecast"},
    "Learn": {},
    "Benchmark and installation": {"demo": "commands", "doctor": "data", "backends": "commands"},
}
"""Heading of the overview → its commands, each with its module; what other packages add stands first."""


LATE = ("imaging", "track", "series", "forecast", "learn")
"""Modules whose options cannot be had without libraries that take seconds to load."""


@cache
def _source(module: str) -> str:
    return Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")


def _summary(name: str, module: str) -> str:
    """The first paragraph of a command's docstring; its module is read, and not imported."""
    found = re.search(rf'^def {name}\(.*?"""(.*?)(?:\n\n|""")', _source(module), re.DOTALL | re.MULTILINE)
    assert found is not None
    return " ".join(found[1].split())


COMMANDS = Extended(
    {
        name: (module, _summary(name, module), heading)
        for heading, names in GROUPS.items()
        for name, module in names.items()
    },
    "holosplat.commands",
)
"""Name → (module that has a function of that name, by its whole name in other packages; the docstring's first
paragraph; the heading in the overview)."""
DESCRIPTION = "Quantitative 3D maps from a handful of X-ray phase-contrast images."


def main() -> None:
    """Run a command. Bad input, and a machine that cannot do it, print one sentence and exit with 2; Ctrl-C, SIGTERM
    and SIGHUP save what they can and exit with 130."""
    end_as_on_interrupt()
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # names of files need be no UTF-8
    say_notes()
    if sys.argv[1:] == ["--version"]:
        print(f"holosplat {__version__}")
        return
    with ExitStack() as log:
        _carry_out(log)


def _carry_out(log: ExitStack) -> None:
    """Run the command of the arguments; what it says until `log` ends is in the file of --log."""
    try:
        _require_no_empty(sys.argv[1:])
        if _explained(sys.argv[1:]):
            return
        arguments = resumed(sys.argv[1:])
        log.enter_context(logged(arguments))
        with checked_later():
            tyro.extras.subcommand_cli_from_dict(
                _functions(arguments),
                prog="holosplat",
                description=DESCRIPTION,
                args=arguments,
                config=CONFIG,
            )
    except InputError as error:
        give_up(str(error))
    except RecursionError:
        give_up("the input is nested too deeply; make it flat.")
    except UnicodeError as error:
        give_up(f"a name or text is none in UTF-8: {error}; correct it.")
    except KeyboardInterrupt:
        say("holosplat: interrupted")
        raise SystemExit(INTERRUPTED) from None
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except (MemoryError, OSError, RuntimeError) as error:
        if is_of_memory(error):
            give_up(
                f"the memory of this machine is not enough{_said(error)}; take larger pixels (--bin) or fewer rows."
            )
        if not isinstance(error, OSError):
            raise
        give_up(f"a file cannot be read or written{_said(error)}; check its path, its permissions and the disk.")


def _explained(arguments: list[str]) -> bool:
    """Whether the arguments ask for help, which is then printed: that of the program, a command or an act of one."""
    if not {*HELP, ALL}.intersection(arguments):
        return False
    first = arguments[0]
    if first in COMMANDS:
        parser, act = parser_of(command(first), first), arguments[1]
        acts = acts_of(parser)
        print(page(f"{first} {act}" if act in acts else first, acts.get(act, parser), ALL in arguments))
    elif first.startswith("-"):
        print(overview(_groups(), DESCRIPTION))
    return first in COMMANDS or first.startswith("-")


def _groups() -> dict[str, list[tuple[str, str]]]:
    """The overview: heading → names of commands and what they do."""
    groups: dict[str, list[tuple[str, str]]] = {heading: [] for heading in GROUPS}
    for name in sorted(COMMANDS, key=lambda name: name in COMMANDS.own):
        _, summary, heading = COMMANDS[name]
        groups.setdefault(heading, []).append((name, summary))
    return groups


def _require_no_empty(arguments: list[str]) -> None:
    """`InputError` that names the first argument which is empty: the parser would take it for the folder one is in."""
    for before, argument in zip(["holosplat", *arguments], arguments):
        bare = EMPTY.fullmatch(argument)
        if bare or not argument:
            flag = bare[1] if bare else before if before.startswith("--") else f"the argument behind {before}"
            raise InputError(f"{flag} must not be empty, but it is; give it a value, or leave it out instead.")


def _said(error: BaseException) -> str:
    """What an error says, in its first line; empty where it says nothing."""
    text = str(error).split("\n", 1)[0].strip()
    return f" ({text[:LONGEST]})" if text else ""


def is_late(module: str) -> bool:
    """Whether the module of a command, of whatever package, is one of `LATE`."""
    return module.rpartition(".")[2] in LATE


def command(name: str) -> Callable[..., None]:
    """The function of the command `name`, a key of `COMMANDS`, whose numbers are checked; imports its module."""
    module = COMMANDS[name][0]
    if is_late(module):
        say_that_libraries_load()
    found = import_module(f".{module}", __package__) if name in COMMANDS.own else import_module(module)
    return with_checked_arguments(getattr(found, name))


def _functions(arguments: list[str]) -> dict[str, Callable[..., None]]:
    """A function for each command, which does nothing but have a summary unless the first argument names it."""
    known = COMMANDS.own if arguments[:1] and arguments[0] in COMMANDS.own else COMMANDS
    found: dict[str, Callable[..., None]] = {}
    for name, (_, summary, _) in known.items():

        def unloaded() -> None:
            pass

        unloaded.__doc__ = summary
        found[name] = command(name) if arguments[:1] == [name] else unloaded
    return found


AGAIN = "give the scan, the options and --out again, with --resume"
OF_ONE_CALL = ("--log", "--force", "--resume")
"""Options of the command that began a run which are not those of one that goes on."""
PERMISSION = "--allow-external"
"""What whoever goes on must say again: a run that came from elsewhere permits itself nothing."""


def resumed(arguments: Sequence[str]) -> list[str]:
    """Arguments with those of the run that `--resume RUN` names, unless --out does; `InputError` for a folder that no
    such command began, and for input that is gone or changed."""
    name, *words = arguments or [""]
    at = next((n for n, word in enumerate(words) if word.partition("=")[0] == "--resume"), None)
    if at is None or any(word.partition("=")[0] == "--out" for word in words):
        return list(arguments)
    joined = words[at].partition("=")[2]
    value = joined or (words[at + 1] if at + 1 < len(words) else "")
    if not value or value.startswith("--"):
        return list(arguments)
    run, rest = Path(value), words[:at] + words[at + (1 if joined else 2) :]
    return [name, *_again(name, run), "--resume", *rest]


def is_made_by(path: Path, words: Sequence[str]) -> bool:
    """Whether the command with these `words` made `path`, unchanged since, from inputs that are unchanged, as far as
    these are named one by one."""
    record = origin(path)
    with suppress(InputError), as_written(path):
        said, folder = shlex.split(record["command"])[1:], Path(from_home(record["folder"]))
        for one in record["inputs"]:
            if "files" not in one:
                _place(path if path.is_dir() else path.parent, folder, one)
        own = MADE not in record or record[MADE] == fingerprint(path)
        return own and [from_home(word) for word in _lasting(said)] == list(words)
    return False


def _again(name: str, run: Path) -> list[str]:
    """The words behind `name` that began `run`, with its own place, and with its inputs where they are now."""
    require(run.is_dir(), f"--resume must name a run folder, but {run} is none; check the path.")
    begun = records(run)
    require(
        bool(begun), f"--resume alone needs the command in {run / NAME}, but there is none, or it is damaged; {AGAIN}."
    )
    with as_written(run / NAME):
        _, command, *words = (word for word in shlex.split(begun[0]["command"]) if word != PERMISSION)
        folder = Path(from_home(begun[0]["folder"]))
        inputs = [(Path(one["path"]), dict(one)) for one in begun[0]["inputs"]]
    require(command == name, f"{run} was begun by holosplat {command}; go on with holosplat {command} --resume {run}.")
    return _moved(_lasting(words), {path: _place(run, folder, said) for path, said in inputs}, run)


def _lasting(words: Sequence[str]) -> list[str]:
    """The words without options that are of one call."""
    kept, skip = [], False
    for word in words:
        flag, is_joined, _ = word.partition("=")
        if not skip and flag not in OF_ONE_CALL:
            kept.append(word)
        skip = flag == "--log" and not is_joined
    return kept


def _moved(words: Sequence[str], places: Mapping[Path, Path], run: Path) -> list[str]:
    """The words with the places of inputs and of the run."""
    found, is_out = [], False
    for word in words:
        flag, is_joined, path = word.partition("=")
        if is_out or (flag == "--out" and is_joined):
            found.append(str(run) if is_out else f"--out={run}")
        elif Path(word) in places:
            found.append(str(places[Path(word)]))
        elif is_joined and Path(path) in places:
            found.append(f"{flag}={places[Path(path)]}")
        else:
            found.append(from_home(word))
        is_out = word == "--out" and not is_out
    return found


def _place(run: Path, folder: Path, said: Mapping[str, Any]) -> Path:
    """Where an input of `run` is: beside it as it was, or where it was; `InputError` where it is gone, or another."""
    beside = [Path(os.path.normpath(run / said["relative"]))] if "relative" in said else []
    ways = list(dict.fromkeys([*beside, folder / from_home(said["path"])]))
    there = [way for way in ways if way.exists()]
    looked = " and ".join(str(way) for way in ways)
    require(
        bool(there), f"{run} was begun with {said['path']}, but it is gone from {looked}; bring it back, or {AGAIN}."
    )
    hashed = {key: value for key, value in said.items() if key in ("bytes", "sha256", "sha256_of_ends")}
    for way in there:
        if fingerprint(way) == hashed:
            return way
    raise InputError(
        f"{run} was begun with another {said['path']} than {there[0]}, which has changed since; bring back what "
        "it was, or start anew into another --out."
    )
