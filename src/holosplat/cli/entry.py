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
from importlib import import_module
from io import TextIOWrapper

import tyro

from ..checks import InputError, is_of_memory
from ..plugins import Extended
from ..ranges import checked_later
from ..version import __version__
from .help import ALL, CONFIG, HELP, acts_of, overview, page, parser_of
from .places import with_checked_arguments
from .progress import INTERRUPTED, end_as_on_interrupt, logged, say_notes
from .resume import resumed
from .sentence import give_up

LONGEST = 200
"""Characters of another program's message, at most."""

EMPTY = re.compile("(--[^=]+)=")
"""An option to which nothing is given."""

_OWN: dict[str, tuple[str, str]] = {
    "plan": (
        "plan",
        "Say what an experiment would see, resolve and store, and where its best distance and energy lie.",
    ),
    "materials": (
        "data",
        "List the materials that have a name, with density, δ, β and δ/β; formulas need a density instead.",
    ),
    "grow": ("grow", "Let red cells flow through a channel, and write their meshes (VTK, µm) at every snapshot."),
    "simulate": (
        "simulate",
        "Simulate the holograms of closed meshes, still or moving (--frame-rate), of a volume, or of generated matter.",
    ),
    "record": (
        "imaging",
        "Record a noise-free scan as raw counts: pulses of a free-electron laser, a camera, flats and darks.",
    ),
    "correct": ("imaging", "Correct raw counts by dark and flat fields into a scan of relative intensities."),
    "align": ("align", "Find where the beams of a scan really are, and write the same frames with other exposures."),
    "calibrate": (
        "calibrate",
        "Find where beams are by frames of a phantom of known shape, or of beads, for --exposures of other commands.",
    ),
    "join": ("imaging", "Join scans of several beams, one file each; pixel sizes, energies and distances may differ."),
    "retrieve": ("retrieve", "Retrieve phase and thickness of single frames, into TIFF files or HDF5."),
    "reconstruct": (
        "commands",
        "Reconstruct a scan, by what suits its matter or by a method of your choice, into a run folder.",
    ),
    "init": (
        "pipeline",
        "Print a pipeline file with comments, which you change and run (holosplat init > run.toml).",
    ),
    "run": (
        "pipeline",
        "Run the stages of a pipeline file (correct, align, reconstruct, export) in order; finished ones are skipped.",
    ),
    "track": (
        "track",
        "Follow closed bodies through the times of a scan: their shapes on smooth paths, into a run folder.",
    ),
    "series": (
        "series",
        "Reconstruct a series as tasks of their own: on this machine, by Slurm, on Dask (plan, run, status, collect).",
    ),
    "watch": (
        "watch",
        "Reconstruct scans as they appear in a folder, each begun with what the last one gave, and keep a live page.",
    ),
    "forecast": (
        "forecast",
        "Carry a run of track on: its bodies and their frames at later times, with a standard error.",
    ),
    "render": ("commands", "Predict the frames of a scan from a run."),
    "export": (
        "export",
        "Write δ and β of a run as a volume, its bodies as meshes, or its object in few bytes or as splats.",
    ),
    "view": (
        "view",
        "Show a run or an object file in the browser, as Gaussians or surfaces, with sliders (Ctrl-C ends).",
    ),
    "surface": (
        "surface",
        "Cut the bodies of a run out as closed surfaces, fit these to the frames, and write them as VTK files (µm).",
    ),
    "convert": ("convert", "Bring a scan into another format; what SOURCE is, its content says."),
    "evaluate": (
        "commands",
        "Score a run on held-out frames and against the true volume, which then joins its report.",
    ),
    "compare": (
        "compare",
        "Compare two runs side by side: what was asked, decided and found, and where their volumes differ.",
    ),
    "check": (
        "data",
        "Say whether a run folder or an HDF5 file is as it was written, by manifest and checksums.",
    ),
    "data": ("data", "Sample data of other people: list it, or fetch one into the cache (list, fetch NAME)."),
    "dataset": (
        "dataset",
        "Simulate scenes for learning, drawn at random from stated ranges, into a folder of shards with a datasheet.",
    ),
    "train": (
        "train",
        "Train a network on scenes of `holosplat dataset`: weights with a card, and curves.",
    ),
    "demo": ("commands", "Run the whole chain on generated red cells: simulate, reconstruct, evaluate, report."),
    "info": (
        "data",
        "Say what a file or a run is: shape, beam, angles, air, noise, fringes, what is missing, and what it takes.",
    ),
    "doctor": (
        "doctor",
        "Look at the installation: versions, kernels, threads, memory, disk, and a small run with its error.",
    ),
    "backends": ("commands", "Say which backends can be used here, and what each of them offers."),
}
COMMANDS = Extended(_OWN, "holosplat.commands")
"""Name → (module that has a function of that name, first paragraph of the function's docstring).

Modules are of this package, or of another one that adds commands (docs/adding.md), by their whole names.
"""

GROUPS: dict[str, tuple[str, ...]] = {
    "Data": ("info", "convert", "correct", "join", "data", "materials", "check"),
    "Simulate": ("plan", "grow", "simulate", "record"),
    "Reconstruct": ("init", "run", "calibrate", "align", "retrieve", "reconstruct", "track", "surface"),
    "Look": ("evaluate", "view", "export", "render", "compare"),
    "Series": ("series", "watch", "forecast"),
    "Learn": ("dataset", "train"),
    "Benchmark and installation": ("demo", "doctor", "backends"),
}
"""Heading of the overview → its commands; what other packages add stands first under the last."""
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
        print("holosplat: interrupted", file=sys.stderr)
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
