"""Names of a package that are imported when they are first used, as the stub beside its `__init__.py` lists them."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
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
            spaces = [inner for inner, module in where.items() if module is None]
            homes = (home for inner in spaces for home in _homes(Path(file).parent, inner, name))
            home = next(homes, None)
            advice = f"; it is {package}.{home}" if home else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{advice}")
        module = where[name]
        return import_module(f".{name}", package) if module is None else getattr(import_module(module, package), name)

    return lookup, lambda: sorted(where), sorted(where)


def _homes(folder: Path, inner: str, name: str) -> Iterator[str]:
    """Dotted paths of the public `name` in the namespace `inner`: in its stub or file, or in a module of that name."""
    files = {f"{inner}/__init__.pyi": inner, f"{inner}/__init__.py": inner, f"{inner}.py": inner}
    for file, module in {**files, f"{inner}/{name}.py": f"{inner}.{name}"}.items():
        path = folder / file
        if not name.startswith("_") and path.is_file() and name in _bound(path):
            yield f"{module}.{name}"


def _bound(path: Path) -> set[str]:
    """The names that a module defines, or imports from its own package."""
    names = set(_listed(path))
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def _listed(stub: Path) -> dict[str, str | None]:
    """Name → module that it comes from, relative to the package; None for a module itself."""
    imports = [node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {
        alias.name: f".{node.module}" if node.module else None
        for node in imports
        if node.level == 1
        for alias in node.names
    }
