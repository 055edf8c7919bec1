"""Names of a package that are imported when they are first used, as the stub beside its `__init__.py` lists them."""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

Lookup = Callable[[str], Any]


def exports(package: str, file: str) -> tuple[Lookup, Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of `package`, whose `__init__.py` is `file`.

    The names are those of the relative imports in `__init__.pyi`, which type checkers read, too: `from .module import
    name as name`, or `from . import module as module`.
    """
    where = _listed(Path(file).with_suffix(".pyi"))

    def lookup(name: str) -> Any:
        if name not in where:
            inside = [inner for inner, module in where.items() if module is None and name in _names(file, inner)]
            advice = f"; it is {package}.{inside[0]}.{name}" if inside else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{advice}")
        module = where[name]
        return import_module(f".{name}", package) if module is None else getattr(import_module(module, package), name)

    return lookup, lambda: sorted(where), sorted(where)


def _names(file: str, inner: str) -> set[str]:
    """What the package `inner` beside `file` exports by a stub."""
    stub = Path(file).parent / inner / "__init__.pyi"
    return set(_listed(stub)) if stub.is_file() else set()


def _listed(stub: Path) -> dict[str, str | None]:
    """Name → module that it comes from, relative to the package; None for a module itself."""
    imports = [node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {
        alias.name: f".{node.module}" if node.module else None
        for node in imports
        if node.level == 1
        for alias in node.names
    }
