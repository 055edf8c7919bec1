"""Tables of a TOML file read into frozen dataclasses, entry by entry: what is unknown, missing or ill-typed is said."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..checks import InputError, require


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; `InputError` where it cannot be read or is no TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} must be a readable TOML file, but reading it failed: {error}.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} must be valid TOML, but: {error}.") from None


def merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`table` with the entries of `changes`; inner tables are merged alike, unless the change says its own `kind`."""
    together = table | changes
    for name, change in changes.items():
        old = table.get(name)
        if isinstance(change, dict) and isinstance(old, dict) and "kind" not in change:
            together[name] = merged(old, change)
    return together


def from_table(kind: Any, table: Any, where: str = "") -> Any:
    """The dataclass `kind` made of `table`; entries with a default may be left out.

    where: the table's dotted path, for messages. A field's type is bool, int, float, str, a `Literal`, a tuple, a
    dataclass, one of these or None, or a union of dataclasses, each with its name as the class variable `kind`, which
    the table's entry `kind` names. A dataclass with the class variable `shorthand` may be written as that one entry.
    """
    values: dict[str, Any]
    if isinstance(table, str) and hasattr(kind, "shorthand"):
        values = {kind.shorthand: table}
    elif isinstance(table, dict):
        values = {name: value for name, value in table.items() if name != "kind" or not hasattr(kind, "kind")}
    else:
        raise InputError(f"{where} must be a table, but it is {table!r}.")
    hints, fields = get_type_hints(kind), {field.name: field for field in dataclasses.fields(kind)}
    unknown = [name for name in values if name not in fields]
    require(not unknown, f"{_path(where, *unknown[:1])} is not known; remove it, or use one of {', '.join(fields)}.")
    missing = [n for n, f in fields.items() if n not in values and f.default is dataclasses.MISSING]
    require(not missing, f"{_path(where, *missing[:1])} is missing; add it.")
    checked = {name: _checked(hints[name], value, _path(where, name)) for name, value in values.items()}
    try:
        return kind(**checked)
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from None


def _path(where: str, *name: str) -> str:
    return ".".join(filter(None, (where, *name)))


def _checked(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint`."""
    members = [member for member in get_args(hint) if member is not NoneType]
    if get_origin(hint) is Literal:
        require(value in members, f"{where} must be one of {', '.join(members)}, but it is {value!r}.")
        return value
    if get_origin(hint) is tuple:
        return _tuple(members, value, where)
    if dataclasses.is_dataclass(hint):
        return from_table(hint, value, where)
    if len(members) == 1:  # one type or None
        return _checked(members[0], value, where)
    if members:
        return _one_of(members, value, where)
    return _plain(hint, value, where)


def _one_of(kinds: list[Any], value: Any, where: str) -> Any:
    """The table `value` as the dataclass among `kinds` that its entry `kind` names."""
    require(isinstance(value, dict), f"{where} must be a table, but it is {value!r}.")
    table = {kind.kind: kind for kind in kinds}
    names = ", ".join(table)
    require("kind" in value, f"{where}.kind is missing; add one of {names}.")
    known = isinstance(value["kind"], str) and value["kind"] in table
    require(known, f"{where}.kind must be one of {names}, but it is {value['kind']!r}.")
    return from_table(table[value["kind"]], value, where)


def _tuple(members: list[Any], value: Any, where: str) -> tuple[Any, ...]:
    """A TOML array as a tuple: of one type and any length, or of as many entries as there are types."""
    require(isinstance(value, list), f"{where} must be a list, but it is {value!r}.")
    if members[-1] is Ellipsis:
        members = members[:1] * len(value)
    require(len(value) == len(members), f"{where} must have {len(members)} entries, but it is {value!r}.")
    return tuple(_checked(member, v, f"{where}[{i}]") for i, (member, v) in enumerate(zip(members, value)))


def _plain(kind: type, value: Any, where: str) -> Any:
    accepted = (int, float) if kind is float else (kind,)
    good = isinstance(value, accepted) and (kind is bool or not isinstance(value, bool))
    name = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}[kind]
    require(good and (kind is not float or math.isfinite(value)), f"{where} must be {name}, but it is {value!r}.")
    return kind(value)
