"""Settings of methods: presets, files that change some of them, and what config.json keeps.

A settings file (TOML or JSON) may be partial: it changes what its `base` says, the name of a preset or of a method.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from ..checks import InputError, require
from ..tables import changed, merged, read_table, to_table
from . import METHODS
from .method import Method

SCHEMA = 2
"""Version of what config.json says of a method. Version 1 is that of holosplat 0.1.0, which did not name it."""
FOLDER = Path(__file__).parent / "presets"
DEFAULT = "default"


def presets() -> tuple[str, ...]:
    """The names of the presets, the default first."""
    return (DEFAULT, *sorted(path.stem for path in FOLDER.glob("*.toml") if path.stem != DEFAULT))


@lru_cache
def preset(name: str) -> Method:
    """The method and its options that the preset `name` says; `InputError` listing the names otherwise."""
    if name not in presets():
        raise InputError(f"preset must be one of {', '.join(presets())}, but it is {name!r}.")
    return method_of(read_table(FOLDER / f"{name}.toml"), f"preset {name}")


def base(name: str) -> Method:
    """The method of a preset, or a method by its name with its options by default; `InputError` listing the names."""
    if name in METHODS:
        return METHODS[name]
    known = (*presets(), *(other for other in METHODS if other not in presets()))
    require(name in known, f"base must be one of {', '.join(known)}, but it is {name!r}.")
    return preset(name)


def read_method(path: Path) -> Method:
    """The method of a settings file, or of the config.json of a run (of version 0.1.0, too), checked field by field."""
    table = read_table(path)
    version = table.get("schema_version", 1)
    require(
        version in range(1, SCHEMA + 1),
        f"{path} has the schema version {version!r}, but this version reads 1 to {SCHEMA}; use the one that wrote it.",
    )
    inner = table.get("method", table.get("settings", table))
    require(isinstance(inner, dict), f"{path} must hold a table of settings, but it holds {inner!r}.")
    if inner is table:
        inner = {name: value for name, value in table.items() if name != "schema_version"}
    return method_of(inner)


def method_of(table: dict[str, Any], where: str = "settings") -> Method:
    """The method that a table changes its `base` into (by default what its `kind` has by default, else the default).

    Entries of version 0.1.0 are brought to today's names. where: the table's path, for messages.
    """
    table = _of_today(table)
    name, kind = table.pop("base", None), table.get("kind")
    kinds = {type(method).kind: type(method) for method in METHODS.values()}
    known = ", ".join(kinds)
    require(kind is None or kind in kinds, f"{where}.kind must be one of {known}, but it is {kind!r}.")
    if name is not None:
        require(isinstance(name, str), f"{where}.base must be a name, but it is {name!r}.")
        start = base(name)
    else:
        start = kinds[kind or type(METHODS["gaussians"]).kind]()
    if kind is not None and kind != type(start).kind:
        require(name is None, f"{where}: the base {name} is of the kind {type(start).kind}, not {kind}; change either.")
    return changed(start, table, where)


def as_config(method: Method) -> dict[str, Any]:
    """What config.json says of a method; `read_method` reads it."""
    return {"schema_version": SCHEMA, "method": to_table(method)}


RENAMED = {
    "rate_position": "centres",
    "rate_scale": "log_scales",
    "rate_rotation": "quaternions",
    "rate_amplitude": "raw_amplitudes",
}
"""Entries of `fit.schedule` in version 0.1.0 → entries of `fit.rates` of the Gaussians."""


def _of_today(table: dict[str, Any]) -> dict[str, Any]:
    """The table with the names of today."""
    fit = table.get("fit")
    schedule = fit.get("schedule") if isinstance(fit, dict) else None
    if not (isinstance(fit, dict) and isinstance(schedule, dict) and RENAMED.keys() & schedule.keys()):
        return dict(table)
    rates = {new: schedule[old] for old, new in RENAMED.items() if old in schedule}
    kept = {name: value for name, value in schedule.items() if name not in RENAMED}
    return table | {"fit": merged({"rates": rates}, fit | {"schedule": kept})}
