"""Methods by name: presets, which are the TOML files of this folder, and the files that options are read from.

A file (TOML or JSON) may be partial: it changes what its `base` says, the name of a preset or of a method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from ...checks import InputError, require
from ...tables import changed, merged, overridden, read_table
from .. import METHODS
from ..gaussians import Gaussians
from ..method import Method

SCHEMA = 2
"""Version of what config.json says of a method. Version 1 is that of holosplat 0.1, which did not name it."""
FOLDER = Path(__file__).parent
DEFAULT = "default"
OLD_RATES = {
    "rate_position": "centres",
    "rate_scale": "log_scales",
    "rate_rotation": "quaternions",
    "rate_amplitude": "raw_amplitudes",
}
"""What version 0.1 called the rates of a schedule."""


def preset_names() -> tuple[str, ...]:
    """The names of the presets, the default first."""
    return (DEFAULT, *sorted(path.stem for path in FOLDER.glob("*.toml") if path.stem != DEFAULT))


@lru_cache
def preset(name: str) -> Gaussians:
    """Look up the options of Gaussians called `name`; `InputError` lists the names otherwise.

    Examples:

        >>> import holosplat as hs
        >>> hs.methods.presets.preset_names()
        ('default', 'fast', 'random', 'thesis')
        >>> fast = hs.preset("fast")
        >>> fast.fit.schedule.steps < hs.Gaussians().fit.schedule.steps
        True
    """
    if name not in preset_names():
        raise InputError(f"preset must be one of {', '.join(preset_names())}, but it is {name!r}.")
    found = method_of(read_table(FOLDER / f"{name}.toml"), f"preset {name}")
    assert isinstance(found, Gaussians)
    return found


def method_called(name: str) -> Method:
    """The method called `name` with its options by default; `InputError` listing the names otherwise."""
    if name not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, but it is {name!r}.")
    return METHODS[name]


def chosen_method(
    method: str | None, preset_name: str | None, config: Path | None, changes: Sequence[str] = ()
) -> Method:
    """The method that one of the three names (a method, a preset, or a file; `auto` without any), then changed.

    changes: assignments `PATH=VALUE` of single fields, as `tables.overridden` has them.
    """
    if config is not None:
        found = read_method(config)
    else:
        found = preset(preset_name) if preset_name is not None else method_called(method or "auto")
    return overridden(found, changes)


def read_method(path: Path) -> Method:
    """The method that a JSON or TOML file describes: the config.json of a run, of any version, or such a table alone.

    A table may be partial: `base` names the preset or the method that it changes (default: that of its `kind`).
    """
    table = read_table(path)
    version = table.pop("schema_version", 1)
    require(
        version in range(1, SCHEMA + 1),
        f"{path} has the schema version {version!r}, but this version reads 1 to {SCHEMA}; use the one that wrote it.",
    )
    values = table.get("method", table.get("settings", table))
    require(isinstance(values, dict), f"{path} must hold a table of options, but it holds {values!r}.")
    return method_of(values)


def method_of(table: dict[str, Any], where: str = "options") -> Method:
    """The method that a table changes its `base` into (by default what its `kind` has by default, else Gaussians).

    Entries of version 0.1 are brought to today's names. where: the table's path, for messages.
    """
    values = dict(_modern(table))
    base, kind = values.pop("base", None), values.get("kind")
    kinds = {type(method).kind: type(method) for method in METHODS.values()}
    known = kind is None or kind in list(kinds)
    require(known, f"{where}.kind must be one of {', '.join(kinds)}, but it is {kind!r}.")
    if base is None:
        return changed(kinds[kind or Gaussians.kind](), values, where)
    require(isinstance(base, str), f"{where}.base must be a name, but it is {base!r}.")
    start = _based_on(base)
    fits = kind in (None, start.kind)
    require(fits, f"{where}: the base {base} is of the kind {start.kind}, not {kind}; change either.")
    return changed(start, values, where)


def _based_on(name: str) -> Method:
    known = dict.fromkeys((*preset_names(), *METHODS))
    require(name in known, f"base must be one of {', '.join(known)}, but it is {name!r}.")
    return METHODS[name] if name in METHODS else preset(name)


def _modern(options: dict[str, Any]) -> dict[str, Any]:
    """Settings of version 0.1 as the options of Gaussians have them; others as they are."""
    fit = options.get("fit")
    schedule = fit.get("schedule") if isinstance(fit, dict) else None
    if not (isinstance(fit, dict) and isinstance(schedule, dict) and OLD_RATES.keys() & schedule.keys()):
        return options
    rates = {new: schedule[old] for old, new in OLD_RATES.items() if old in schedule}
    kept = {name: value for name, value in schedule.items() if name not in OLD_RATES}
    return options | {"fit": merged({"rates": rates}, fit | {"schedule": kept})}
