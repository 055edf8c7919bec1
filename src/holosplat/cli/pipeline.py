"""`holosplat init | run`: a file that says a whole pipeline, and its stages in order."""

from __future__ import annotations

import difflib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from ..checks import InputError, require
from ..io.atomic import is_taken
from ..io.lock import writer_of
from ..io.provenance import is_hdf5
from ..ranges import checked_later, with_checked_numbers
from ..tables import read_table, shown
from .entry import OF_ONE_CALL, command, is_made_by
from .help import CONFIG, Option, is_essential, options_of, parser_of, wrap
from .places import Place, is_run, of_times, places_of, require_apart
from .sentence import say

STAGES = ("correct", "align", "reconstruct", "export")
"""Commands that a pipeline file may have as tables, in the order in which they run."""
EXAMPLE = {
    "correct": {"raw": "raw.nxs", "out": "scan.nxs"},
    "align": {"out": "aligned.nxs"},
    "reconstruct": {"out": "run"},
    "export": {"volume": "volume.h5"},
}
"""What the stages of `init` read and write; a stage reads what the stage before it writes, unless it says otherwise."""
HEAD = """\
# A pipeline of holosplat: holosplat run FILE does these stages in order, and does not repeat what is done.
# Keys are the options of holosplat COMMAND --help-all. Delete a stage that you do not need, or remove the # before a
# key to set it. Paths start from the folder in which you call holosplat run."""


@dataclass(frozen=True)
class Stage:
    """A stage with checked options: its command, the function, the words of a command line, and their values."""

    name: str
    function: Callable[..., None]
    words: tuple[str, ...]
    given: inspect.BoundArguments

    def places(self) -> list[Place]:
        """What it reads and writes."""
        return places_of(self.function, self.given.arguments)

    def outputs(self) -> list[Place]:
        """Where it writes."""
        return [place for place in self.places() if place.written]

    def state(self) -> str:
        """new: nothing is there; done: all outputs are, whole and of this command and input; begun: some; other: of
        another."""
        there = [
            path
            for out in self.outputs()
            for path in ([out.path] if out.is_there() and is_taken(out.path) else of_times(out.path))
        ]
        if not there:
            return "new"
        if not all(is_made_by(path, self.words) for path in there):
            return "other"
        return "done" if all(map(self._is_whole, self.outputs())) else "begun"

    def _is_whole(self, out: Place) -> bool:
        """Whether all of an output is there and sound: itself, or a file for each time of the run that is exported."""
        from ..workflows.reconstruction import instants_of
        from ..workflows.run_folder import RunFolder, check
        from .scans import runs_of

        if is_run(out.path):
            run = RunFolder(out.path)
            ended = writer_of(out.path) is None  # a process that was killed leaves its lock, and no report
            return (
                ended
                and run.summary.is_file()
                and run.read_summary().get("finished") is True
                and not check(out.path)[1]
            )
        if self._can_resume:  # it finds out itself what is left
            return False
        whole = out.is_there() or self.name != "export"
        files = [out.path] if whole else of_times(out.path)
        source = None if whole else self.given.arguments["run"]
        wanted = 1 if source is None else len(runs_of(source) or instants_of(RunFolder(source)))
        return 0 < len(files) == wanted and all(
            file.exists() and not (is_hdf5(file) and check(file)[1]) for file in files
        )

    @property
    def _can_resume(self) -> bool:
        return "resume" in self.given.signature.parameters

    def carry_out(self, redo: bool) -> None:
        """Do what is left of it. Errors: `InputError` where that replaces what others made, without `redo`."""
        state, outs = self.state(), " and ".join(str(out.path) for out in self.outputs())
        if state == "done":
            say(f"[{self.name}] is done: {outs} is whole, and made by the same options from the same input")
            return
        require(
            state != "other" or redo,
            f"[{self.name}] must not replace {outs}, which other options, another input or another program made; name "
            "another place, or add --redo to make it anew.",
        )
        how = "resume" if state == "begun" and self._can_resume else "force"
        more = {how: True} if state != "new" else {}
        words = [*self.words, *(f"--{name}" for name in more)]
        say(f"[{self.name}] holosplat {' '.join(words)}")
        given = self.given.signature.bind(*self.given.args, **self.given.kwargs)
        given.arguments |= more
        with _typed(words):
            self.function(*given.args, **given.kwargs)


def init(everything: Annotated[bool, arg(name="all")] = False) -> None:
    """Print a pipeline file with comments, which you change and run (holosplat init > run.toml).

    Args:
        everything: Print all options of the stages, not the essential ones alone.
    """
    print(HEAD)
    before = ""
    for name in STAGES:
        print(f"\n[{name}]")
        for option in _options(name):
            value = EXAMPLE[name].get(option.key)
            if value is not None or option.is_bare or everything or is_essential(name, option):
                print(*_entry(option, value, before), sep="\n")
        before = EXAMPLE[name].get("out", before)


def run(pipeline: Positional[Path], redo: bool = False) -> None:
    """Run the stages of a pipeline file (correct, align, reconstruct, export) in order; finished ones are skipped.

    All stages are checked before the first one begins. A stage that was cut off goes on where it can.

    Args:
        pipeline: Pipeline file (TOML) with a table for each stage, as `holosplat init` prints it.
        redo: Replace what stages made with other options or from another input.
    """
    for stage in _stages(pipeline):
        stage.carry_out(redo)


def _stages(path: Path) -> list[Stage]:
    """The stages of a pipeline file. Errors: `InputError` for what is no stage, no option, or no value of one."""
    tables = read_table(path)
    _require_known(tables, STAGES, f"{path} has", "the stages are")
    require(bool(tables), f"{path} must have a stage, [{'], ['.join(STAGES)}], but it has none; see holosplat init.")
    found, before = [], None
    for name in STAGES:
        table = tables.get(name)
        if table is None:
            continue
        require(isinstance(table, dict), f"{name} of {path} must be a table, but it is {shown(table)}; write [{name}].")
        words = _words(name, table, path, before)
        found.append(_parsed(name, words, path))
        before = table.get("out", before)
    read, made = [Place("PIPELINE", path, written=False)], list[Place]()
    for stage in found:  # which must not write over the pipeline file, an input, or what another stage makes
        places = stage.places()
        read += [one for one in places if not (one.written or any(map(one.is_same, made)))]
        made += [one for one in places if one.written]
        try:
            require_apart([*read, *made])
        except InputError as error:
            raise InputError(f"[{stage.name}] of {path}: {error}") from None
    return found


def _require_known(table: Mapping[str, Any], known: Sequence[str], where: str, are: str) -> None:
    """`InputError` that names the first key of a table which is not `known`."""
    for key in table:
        if key not in known:
            alike = difflib.get_close_matches(key, known, n=3, cutoff=0.6)
            advice = f"did you mean {', '.join(alike)}?" if alike else f"{are} {', '.join(known)}."
            raise InputError(f"{where} the unknown key {key}; {advice}")


def _options(name: str) -> list[Option]:
    """The options of a stage: those of its command, but for those of one call alone."""
    return [one for one in options_of(parser_of(command(name), name)) if f"--{one.key}" not in OF_ONE_CALL]


def _words(name: str, table: Mapping[str, Any], path: Path, before: str | None) -> list[str]:
    """The words of a command line that a stage's table stands for; before: what the stage before it writes."""
    options = {option.key: option for option in _options(name)}
    _require_known(table, list(options), f"[{name}] of {path} has", "the keys are")
    words: list[str] = []
    for key, option in options.items():
        value = table.get(key, before if option.is_bare else None)
        require(value is not None or not option.required, f"[{name}] of {path} must have the key {key}; add it.")
        if value is not None:
            words += _said(option, value, f"{key} in [{name}] of {path}")
    return words


def _said(option: Option, value: Any, called: str) -> Iterator[str]:
    """The words for one option. Errors: `InputError` for values that no option has."""
    flag = f"--{option.key}"
    kinds, said = (bool, "true or false") if option.is_switch else (str | int | float | list, "a text, number or list")
    fits = isinstance(value, kinds) and isinstance(value, bool) == option.is_switch
    require(fits, f"{called} must be {said}, but it is {shown(value)}.")
    if option.is_switch:
        yield flag if value else f"--no-{option.key}"
        return
    values = list(map(str, _flat(value)))
    if option.is_repeatable:
        yield from (word for each in values for word in (flag, each))
    elif values:
        yield from [*([] if option.is_bare else [flag]), *values]


def _flat(value: Any) -> Iterator[Any]:
    """A value, or those of nested lists."""
    for each in value if isinstance(value, list) else [value]:
        yield from _flat(each) if isinstance(each, list) else [each]


def _parsed(name: str, words: Sequence[str], path: Path) -> Stage:
    """The stage with these words. Errors: `InputError`, after what the parser says, for words that it refuses."""
    function, taken = command(name), []

    @wraps(function)
    def take(*args: Any, **kwargs: Any) -> None:
        taken.append(inspect.signature(function).bind(*args, **kwargs))

    try:
        with checked_later():
            tyro.cli(with_checked_numbers(take), args=words, prog=f"holosplat {name}", config=CONFIG)
    except SystemExit:
        raise InputError(
            f"[{name}] of {path} must be options of holosplat {name}; correct what is said above."
        ) from None
    except InputError as error:
        raise InputError(f"[{name}] of {path}: {error}") from None
    return Stage(name, function, (name, *words), taken[0])


def _entry(option: Option, value: str | None, before: str) -> Iterator[str]:
    """The lines of an option in a pipeline file: its text, and its value or, in a comment, its default."""
    yield from (f"# {line}" for line in wrap(option.text, 110))
    if value is not None:
        yield f'{option.key} = "{value}"'
    else:
        yield f"# {option.key} = {_default(option, before)}"


def _default(option: Option, before: str) -> str:
    """The default of an option as TOML, or what stands for its value."""
    if option.is_bare:
        return f'"{before}"'
    if option.is_switch:
        return option.default.lower()
    words = option.default.split() if option.default not in ("", "None") else []
    values = [word if word.lstrip("-")[:1].isdigit() else f'"{word}"' for word in words]
    if not values:
        kinds = option.called.partition(" ")[2]
        if " " in kinds:
            return f"[{', '.join(kinds.split())}]"
        names = [name for kind in kinds.split("|") for name in kind.strip("{}").split(",")]
        return " or ".join(name if name in ("INT", "FLOAT") else f'"{name}"' for name in names)
    return values[0] if len(values) == 1 else f"[{', '.join(values)}]"


@contextmanager
def _typed(words: Sequence[str]) -> Iterator[None]:
    """In the block, files say that they come from these words, as if they were typed."""
    before, sys.argv = sys.argv, ["holosplat", *words]
    try:
        yield
    finally:
        sys.argv = before
