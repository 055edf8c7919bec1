"""Nested frozen dataclasses and tables (TOML, JSON): read, write, merge, and change one field by its dotted path.

A table is checked entry by entry: an unknown, missing or ill-typed entry is an `InputError` that names its path.
A field's type is bool, int, float, str, Path, a `Literal`, a tuple, a table by name, a dataclass, one of these or None,
or a union of dataclasses. Each member of such a union has a name, its class variable `kind`; the table's entry `kind`
chooses one.
"""

from __future__ import annotations

import csv
import dataclasses
import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from .checks import InputError, require, require_regular

LARGEST = 1 << 64
"""What no whole number of a table exceeds: larger ones are no numbers of an experiment, and no floats."""
DOTTED = re.compile(r"""(?:[\w"'-]+[ \t]*\.[ \t]*){64}""")
"""A key of TOML with more parts than any table is deep; of tens of thousands, the decoder takes gigabytes."""
MOST_ENTRIES = 2_000_000
"""Tables, keys and values of a file, at most: decoders take some microseconds for each."""
SHOWN = 60
"""Characters of a value in messages, at most."""

# --- files --------------------------------------------------------------------------------------------------


def read_table(path: Path) -> dict[str, Any]:
    """The table that a file holds: TOML where its name ends in .toml, JSON otherwise.

    Raises `InputError` if the file cannot be read, is damaged, or holds something else than a table.
    """
    toml = path.suffix.lower() == ".toml"
    language = "TOML" if toml else "JSON"
    require_regular(path, f"a {language} file")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"{path} must be a readable {language} file, but reading it failed: {error}.") from None
    try:
        table = (_toml if toml else _json)(text)
    except RecursionError:
        raise InputError(f"{path} must be valid {language}, but it is nested too deeply; make it flat.") from None
    except ValueError as error:  # both decoders' errors
        other = "" if toml else "; the name of a TOML file ends with .toml"
        raise InputError(f"{path} must be valid {language}, but: {error}{other}.") from None
    require(isinstance(table, dict), f"{path} must hold a table, but it holds {type(table).__name__}.")
    return table


def table_in(text: str) -> dict[str, Any]:
    """The table that a JSON text holds. Raises `ValueError` for any other text."""
    table = _json(text)
    require(isinstance(table, dict), f"it must be a table, but it is {shown(table)}.")
    return table


def _json(text: str) -> Any:
    _require_few(text, "[{,")
    found = json.loads(text, parse_constant=_no_number)
    _require_numbers(found)
    return found


def _toml(text: str) -> dict[str, Any]:
    if DOTTED.search(text):
        raise RecursionError
    _require_few(text, "[{=,")
    found = tomllib.loads(text)
    _require_numbers(found)
    return found


def _require_few(text: str, signs: str) -> None:
    """`ValueError` for a text of more entries than take seconds, each of which has one of `signs` at least."""
    if (entries := sum(map(text.count, signs))) > MOST_ENTRIES:
        raise ValueError(f"it has some {entries} entries, and at most {MOST_ENTRIES} are read")


def read_rows(path: Path, what: str) -> list[dict[str, str]]:
    """The rows of the CSV file that `path` must be, by column. Raises `InputError` for any other file."""
    require_regular(path, what)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file, restval=""))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} must be {what}, but reading it failed: {error}.") from None


def number_in(text: str) -> float:
    """The number that a text is; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _require_numbers(value: Any) -> None:
    """`ValueError` for a whole number within `value` that is none of an experiment."""
    if isinstance(value, int) and abs(value) > LARGEST:
        raise ValueError(f"a number of it has {value.bit_length() * 3 // 10} digits or more")
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _require_numbers(inner)


def shown(value: Any) -> str:
    """A value in messages."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _no_number(name: str) -> Any:
    """What JSON does not have, and Python reads."""
    raise ValueError(f"{name} is no number")


# --- tables -------------------------------------------------------------------------------------------------


def to_table(value: Any) -> Any:
    """A dataclass as a nested dictionary that JSON holds; `from_table` gives the dataclass back.

    Tuples become lists, paths text. A dataclass with the class variable `kind` gets the entry `kind` first.
    """
    if _is_dataclass(value):
        kind = type(value)
        table = {"kind": kind.kind} if _has_tag(kind) else {}
        return table | {field.name: to_table(getattr(value, field.name)) for field in _fields(kind).values()}
    if isinstance(value, tuple | list):
        return [to_table(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


def with_entries(value: Any, entries: Mapping[str, Any]) -> Any:
    """The dataclass `value` with these values of its fields, and of dataclasses that are its fields, by their names."""
    changes = {}
    for name in _fields(type(value)) if _is_dataclass(value) else ():
        old = getattr(value, name)
        new = entries[name] if name in entries else with_entries(old, entries)
        changes |= {} if new is old else {name: new}
    return dataclasses.replace(value, **changes) if changes else value


def merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`table` with the entries of `changes`; inner tables are merged alike, unless the change is of another `kind`."""
    together = table | changes
    for name, change in changes.items():
        old = table.get(name)
        if isinstance(change, dict) and isinstance(old, dict) and change.get("kind") in (None, old.get("kind")):
            together[name] = merged(old, change)
    return together


def from_table(kind: Any, table: Any, where: str = "") -> Any:
    """The dataclass `kind`, or the one of a union `kind` that the table names, made of `table`.

    Entries with a default may be left out. where: the table's dotted path, for messages. A dataclass with the class
    variable `shorthand` may be written as that one entry.
    """
    if not _is_dataclass(kind):
        return _checked(kind, table, where)
    if isinstance(table, str) and hasattr(kind, "shorthand"):
        table = {kind.shorthand: table}
    if not isinstance(table, dict):
        raise InputError(f"{where or 'this'} must be a table, but it is {table!r}.")
    values: dict[str, Any] = {**table}
    if _has_tag(kind):
        _tagged([kind], values.pop("kind", kind.kind), where)
    hints, fields = _hints(kind), _fields(kind)
    unknown = [name for name in values if name not in fields]
    require(not unknown, f"{_path(where, *unknown[:1])} is not known; remove it, or use one of {', '.join(fields)}.")
    missing = [name for name, field in fields.items() if name not in values and not _has_default(field)]
    require(not missing, f"{_path(where, *missing[:1])} is missing; add it.")
    checked = {name: _checked(hints[name], value, _path(where, name)) for name, value in values.items()}
    try:
        return kind(**checked)
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from None


def changed(base: Any, changes: dict[str, Any], where: str = "", kind: Any = None) -> Any:
    """The dataclass `base` with the entries of the table `changes`, which may be partial at every depth.

    A dataclass of a union is changed entry by entry, or replaced where the change names another `kind`.
    kind: what the result may be, such as a union that `base` is a member of (default: the type of `base`).
    """
    return from_table(kind or type(base), _with(base, changes), where)


def _with(base: Any, changes: Any) -> Any:
    """The table of `base` with `changes`; what is no dataclass, or becomes another one of a union, is replaced."""
    if not (_is_dataclass(base) and isinstance(changes, dict)):
        return changes
    if _has_tag(type(base)) and changes.get("kind", base.kind) != base.kind:
        return changes
    return to_table(base) | {name: _with(getattr(base, name, None), change) for name, change in changes.items()}


# --- one field by its path ----------------------------------------------------------------------------------


def overridden(base: Any, assignments: Sequence[str]) -> Any:
    """The dataclass `base` with each assignment `PATH=VALUE` carried out, such as `fit.schedule.steps=500`.

    Names in the middle of a path may be left out where one field only is meant (`fit.steps=500`). The field's type
    says how the value is read: `none` is None, lists are in brackets (`[1, 2]`), text needs no quotes. The path that
    ends in `kind` chooses the member of a union. The values are checked together, so that their order does not matter
    (one weight to zero, another one up). Raises `InputError` for a path that names no field (the message has
    the nearest ones) or several, and for a value that the field cannot take.
    """
    together: dict[str, Any] = {}
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        require(
            bool(equals and path.strip()),
            f"a setting must read PATH=VALUE, as fit.steps=500, but it is {assignment!r}.",
        )
        names, hint = _field_called(base, path.strip())
        change: Any = _parsed(hint, text.strip())
        for name in reversed(names):
            change = {name: change}
        together = merged(together, change)
        if names[-1] == "kind":  # later paths are those of the new member
            base, together = changed(base, together), {}
    return changed(base, together) if together else base


def paths(base: Any) -> dict[str, Any]:
    """The dotted path of each plain field in the dataclass `base`, in order, and the field's type.

    A union of dataclasses gives the path of its `kind` and the fields of the member that `base` holds.
    """
    return {".".join(names): hint for names, hint in _leaves(type(base), base)}


def _leaves(kind: type, value: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    hints = _hints(kind)
    for name in _fields(kind):
        hint, held = hints[name], getattr(value, name, None)
        members = [member for member in _members(hint) if _is_dataclass(member)]
        if not members:
            yield (name,), hint
            continue
        if len(members) > 1:
            yield (name, "kind"), Literal[tuple(member.kind for member in members)]
        if NoneType in get_args(hint):
            yield (name,), NoneType
        inner = type(held) if _is_dataclass(held) else members[0]
        for rest, leaf in _leaves(inner, held if _is_dataclass(held) else None):
            yield (name, *rest), leaf


def _field_called(base: Any, path: str) -> tuple[list[str], Any]:
    """The whole path and the type of the one field that `path` means."""
    known = paths(base)
    wanted = path.split(".")
    whole = [path] if path in known else [name for name in known if _abbreviates(wanted, name.split("."))]
    require(len(whole) < 2, f"the setting {path} may mean {', '.join(whole)}; write one of these.")
    if not whole:
        last = wanted[-1]
        alike = difflib.get_close_matches(path, known, n=3, cutoff=0.6)
        alike += [name for name in known if difflib.get_close_matches(last, [name.split(".")[-1]], cutoff=0.75)]
        nearest = ", ".join(list(dict.fromkeys(alike))[:4])
        advice = f"did you mean {nearest}?" if nearest else f"use one of {', '.join(known)}."
        raise InputError(f"the setting {path} is not known; {advice}")
    return whole[0].split("."), known[whole[0]]


def _abbreviates(wanted: list[str], names: list[str]) -> bool:
    """Whether `wanted` is `names` without some that come before the last."""
    rest = iter(names)
    return wanted[-1] == names[-1] and all(name in rest for name in wanted)


def _parsed(hint: Any, text: str) -> Any:
    """`text` as an entry of a table, for a field of the type `hint`."""
    if text.lower() == "none" and (hint is NoneType or NoneType in get_args(hint)):
        return None
    members = _members(hint)
    if str in members or Path in members or any(isinstance(m, str) for m in members):
        return text.strip("\"'")
    for read in (lambda: _toml(f"value = {text}")["value"], lambda: float(text)):
        try:
            return read()
        except ValueError:
            continue
    return text  # `from_table` says what the field must be


# --- entries ------------------------------------------------------------------------------------------------


def _fields(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    return {field.name: field for field in dataclasses.fields(kind) if field.init}


@cache
def _hints(kind: Any) -> dict[str, Any]:
    """The types of a dataclass' fields, which take long to find."""
    return get_type_hints(kind)


def _is_dataclass(value: Any) -> bool:
    """`dataclasses.is_dataclass`, of a hint or a value, for which pyright need not narrow the type."""
    return dataclasses.is_dataclass(value)


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _has_tag(kind: Any) -> bool:
    """Whether the entry `kind` of its table is the dataclass' name rather than a field of it."""
    return hasattr(kind, "kind") and "kind" not in _fields(kind)


def _members(hint: Any) -> list[Any]:
    """The types that a union or a `Literal` has beside None; the type itself where it is neither."""
    if get_origin(hint) is tuple or not get_args(hint):
        return [hint]
    return [member for member in get_args(hint) if member is not NoneType]


def _path(where: str, *name: str) -> str:
    return ".".join(filter(None, (where, *name)))


def _checked(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint`."""
    if value is None and (hint is NoneType or NoneType in get_args(hint)):
        return None
    members = _members(hint)
    if hint is Any:
        return value
    if get_origin(hint) in (dict, Mapping):
        if not isinstance(value, dict):
            raise InputError(f"{where} must be a table, but it is {shown(value)}.")
        return {name: _checked(members[-1], inner, _path(where, str(name))) for name, inner in value.items()}
    if get_origin(hint) is Literal:
        names = ", ".join(map(str, members))
        good = any(type(value) is type(member) and value == member for member in members)
        require(good, f"{where} must be one of {names}, but it is {shown(value)}.")
        return value
    if get_origin(hint) is tuple:
        return _tuple(list(get_args(hint)), value, where)
    if _is_dataclass(hint):
        return from_table(hint, value, where)
    if members != [hint]:  # a union, or one type or None
        return _checked(members[0], value, where) if len(members) == 1 else _one_of(members, value, where)
    return _plain(hint, value, where)


def _one_of(kinds: list[Any], value: Any, where: str) -> Any:
    """The table `value` as the dataclass among `kinds` that its entry `kind` names; or a text, where that may be."""
    if not any(_is_dataclass(kind) for kind in kinds):
        texts = isinstance(value, str) and str in kinds
        return _plain(str if texts else kinds[0], value, where)
    require(isinstance(value, dict), f"{where} must be a table, but it is {shown(value)}.")
    require("kind" in value, f"{_path(where, 'kind')} is missing; add one of {', '.join(k.kind for k in kinds)}.")
    return from_table(_tagged(kinds, value["kind"], where), value, where)


def _tagged(kinds: list[Any], name: Any, where: str) -> Any:
    """The dataclass among `kinds` whose class variable `kind` is `name`."""
    found = [kind for kind in kinds if kind.kind == name]
    names = ", ".join(kind.kind for kind in kinds)
    require(bool(found), f"{_path(where, 'kind')} must be one of {names}, but it is {name!r}.")
    return found[0]


def _tuple(members: list[Any], value: Any, where: str) -> tuple[Any, ...]:
    """A list as a tuple: of one type and any length, or of as many entries as there are types."""
    require(isinstance(value, list), f"{where} must be a list, but it is {shown(value)}.")
    if members[-1] is Ellipsis:
        members = members[:1] * len(value)
    require(len(value) == len(members), f"{where} must have {len(members)} entries, but it is {shown(value)}.")
    return tuple(_checked(member, v, f"{where}[{i}]") for i, (member, v) in enumerate(zip(members, value)))


def _plain(kind: type, value: Any, where: str) -> Any:
    accepted = {float: (int, float), Path: (str,)}.get(kind, (kind,))
    good = isinstance(value, accepted) and (kind is bool or not isinstance(value, bool))
    names = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", Path: "a path"}
    good = (
        good and (kind is not float or math.isfinite(value)) and (names.get(kind) != "a path" or "\0" not in str(value))
    )
    require(good, f"{where} must be {names.get(kind, 'none')}, but it is {shown(value)}.")
    return kind(value)
