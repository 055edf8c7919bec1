"""The commands by name, and `main`, which loads the module of one command only: the others need torch, VTK or figures.

The overview (`holosplat --help`) comes from the tables alone. A command's module imports what its options need, and
each function imports its work where it starts, so that `holosplat COMMAND --help` is fast, too.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path

import tyro

from ..checks import InputError, is_of_memory
from ..plugins import Extended
from ..ranges import checked_later
from ..version import __version__
from .help import ALL, CONFIG, HELP, acts_of, overview, page, parser_of
from .places import with_checked_arguments
from .progress import end_as_on_interrupt, logged, say_notes
from .resume import resumed
from .sentence import INTERRUPTED, give_up, say

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
    "Simulate": {"plan": "plan", "grow": "grow", "simulate": "simulate", "record": "imaging"},
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
        "export": "export",
        "render": "commands",
        "compare": "view",
    },
    "Series": {"series": "series", "watch": "series", "forecast": "forecast"},
    "Learn": {"dataset": "learn", "train": "learn"},
    "Benchmark and installation": {"demo": "commands", "doctor": "data", "backends": "commands"},
}
"""Heading of the overview → its commands, each with the module that has a function of its name; what other packages add
stands first under the last."""


@cache
def _source(module: str) -> str:
    return Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")


def _summary(name: str, module: str) -> str:
    """The first paragraph of a command's docstring; its module is read, and not imported."""
    found = re.search(rf'^def {name}\(.*?"""(.*?)(?:\n\n|""")', _source(module), re.DOTALL | re.MULTILINE)
    assert found is not None
    return " ".join(found[1].split())


COMMANDS = Extended(
    {name: (module, _summary(name, module)) for names in GROUPS.values() for name, module in names.items()},
    "holosplat.commands",
)
"""Name → (module that has a function of that name, first paragraph of the function's docstring).

Modules are of this package, or of another one that adds commands (docs/adding.md), by their whole names.
"""
DESCRIPTION = "Quantitative 3D maps from a handful of X-ray phase-contrast images."


def main() -> None:
    """Run a command; bad input, and a machine that cannot do it, print one sentence and exit with 2.

    Ctrl-C, SIGTERM and SIGHUP exit with 130, after what can be saved is.
    """
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
    added = [name for name in COMMANDS if name not in COMMANDS.own]
    groups = {heading: [(name, COMMANDS[name][1]) for name in names] for heading, names in GROUPS.items()}
    last = list(groups)[-1]
    return {**groups, last: [*((name, COMMANDS[name][1]) for name in added), *groups[last]]}


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


def command(name: str) -> Callable[..., None]:
    """The function of the command `name`, a key of `COMMANDS`, whose numbers are checked; imports its module."""
    module = COMMANDS[name][0]
    found = import_module(f".{module}", __package__) if name in COMMANDS.own else import_module(module)
    return with_checked_arguments(getattr(found, name))


def _functions(arguments: list[str]) -> dict[str, Callable[..., None]]:
    """A function for each command: the real one for that which the first argument names, summaries for the others.
    Beside one of our own the parser needs no other packages."""
    known = COMMANDS.own if arguments[:1] and arguments[0] in COMMANDS.own else COMMANDS
    return {
        name: command(name) if arguments[:1] == [name] else _summarised(summary) for name, (_, summary) in known.items()
    }


def _summarised(summary: str) -> Callable[..., None]:
    """A function that the parser shows with `summary`; it is never called."""

    def unloaded() -> None:
        pass

    unloaded.__doc__ = summary
    return unloaded
