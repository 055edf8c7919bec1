"""Options of a method with some of them changed, wherever in it they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass, replace
from typing import Any, TypeVar

Options = TypeVar("Options")


def changed(options: Options, values: Mapping[str, Any]) -> Options:
    """`options`, a dataclass, with other values of the fields that `values` names: its own, or of dataclasses in it.

    Errors: `KeyError` for a name that neither has.
    """
    found: dict[str, Any] = {}
    missing = set(values)
    for name, part in vars(options).items():
        inner = {k: v for k, v in values.items() if is_dataclass(part) and k in vars(part) and k not in vars(options)}
        if name in values or inner:
            found[name] = values[name] if name in values else replace(part, **inner)  # type: ignore[type-var]
            missing -= {name, *inner}
    if missing:
        raise KeyError(f"{type(options).__name__} has no option {', '.join(sorted(missing))}")
    return replace(options, **found)  # type: ignore[type-var]
