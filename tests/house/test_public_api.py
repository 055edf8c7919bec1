"""The public names: few at the top, the rest in namespaces; all exist, and none costs anything before its use.

Each name at the top has runnable examples in its docstring, which run here as they stand, in an empty folder.
"""

from __future__ import annotations

import ast
import doctest
import inspect
import subprocess
import sys
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest

import holosplat
from holosplat.lazy import exports

FOLDER = Path(holosplat.__file__).parent
STUBS = sorted(path.parent.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("__init__.pyi"))
PACKAGES = ["holosplat" + (f".{path}" if path != "." else "") for path in STUBS]


def stub_of(package: str) -> list[tuple[str, str]]:
    """(module, name) of every import in the stub of `package`; the module is absolute."""
    module = import_module(package)
    body = ast.parse(Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")).body
    assert all(isinstance(node, ast.ImportFrom) and node.level == 1 for node in body)
    found = []
    for node in body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name, "type checkers take `x as x` for an export, and no other name"
            found.append((f"{package}.{node.module}" if node.module else package, alias.name))
    return found


def top_level() -> list[str]:
    """The names at the top, without the namespaces and the version."""
    return [name for source, name in stub_of("holosplat") if source != "holosplat" and name != "__version__"]


def failures(name: str, docstring: str) -> list[str]:
    """What differs from the results in the examples of a docstring; they must import what they use."""
    test = doctest.DocTestParser().get_doctest(docstring, {}, name, None, 0)
    reports: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    runner.run(test, out=reports.append)
    return reports


def test_there_are_thirty_names_at_the_top():
    assert len(top_level()) == 30


@pytest.mark.parametrize("name", top_level())
def test_a_name_at_the_top_has_examples_that_run(name, tmp_path, monkeypatch):
    docstring = inspect.getdoc(getattr(holosplat, name)) or ""
    assert "\n\nExamples:\n\n    >>> " in docstring
    monkeypatch.chdir(tmp_path)
    assert failures(name, docstring) == []


@pytest.mark.parametrize("example", [">>> 1 + 1\n3", ">>> 1 + 1", ">>> holosplat\n1", ">>> x = 1 +"])
def test_examples_that_fail_are_seen(example):
    assert failures("bad", example) != []


def test_the_namespaces_are_those_with_stubs_and_a_few_more():
    spaces = {name for name in holosplat.__all__ if ismodule(getattr(holosplat, name))}
    assert {"beamline", "io", "optics", "planning", "specimens", "workflows"} <= spaces
    assert {package.removeprefix("holosplat.") for package in PACKAGES} - {"holosplat"} <= spaces


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_is_what_the_stub_says(package):
    module, listed = import_module(package), stub_of(package)
    assert sorted(name for _, name in listed) == module.__all__ == sorted(set(module.__all__))
    assert set(module.__all__) <= set(dir(module))
    for source, name in listed:
        value = getattr(module, name)
        assert value is getattr(import_module(source), name)
        assert source == package or not ismodule(value), "a module of that name would hide it once it is imported"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_name_is_hidden_by_a_module_of_the_package(package):
    folder = Path(str(import_module(package).__file__)).parent
    modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert {name for source, name in stub_of(package) if source != package} & modules <= {"__init__"}


@pytest.mark.parametrize(
    "home",
    [
        "specimens.random_cells",
        "volume.Object",
        "mesh.TriangleMesh",
        "methods.METHODS",
        "materials.parse_material",
        "workflows.Reconstruction",
        "beamline.grow.grow",
        "workflows.join.join",
    ],
)
def test_a_name_of_a_namespace_is_pointed_to(home):
    name = home.split(".")[-1]
    with pytest.raises(AttributeError, match=rf"no attribute '{name}'; it is holosplat\.{home}$"):
        getattr(holosplat, name)
    module, _, _ = home.rpartition(".")
    assert hasattr(import_module(f"holosplat.{module}"), name)


def test_a_name_of_nowhere_is_refused():
    with pytest.raises(AttributeError, match=r"has no attribute 'cats'$"):
        _ = holosplat.cats  # pyright: ignore[reportAttributeAccessIssue]


def test_names_are_imported_when_they_are_used(tmp_path):
    """Of a package of one module, the module is imported by the name that it has, not before."""
    (tmp_path / "boxes").mkdir()
    (tmp_path / "boxes/__init__.py").write_text(
        "from holosplat.lazy import exports\n__getattr__, __dir__, __all__ = exports(__name__, __file__)\n"
    )
    (tmp_path / "boxes/__init__.pyi").write_text("from .lid import close as close\n")
    (tmp_path / "boxes/lid.py").write_text("def close():\n    return 'closed'\n")
    code = "import sys, boxes\nprint('boxes.lid' in sys.modules, boxes.close(), 'boxes.lid' in sys.modules)\n"
    code += "from boxes import *\nprint(close())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.stdout.split() == ["False", "closed", "True", "closed"], done.stderr


def test_a_stub_without_imports_exports_nothing(tmp_path):
    (tmp_path / "__init__.pyi").write_text("")
    lookup, names, everything = exports("nothing", str(tmp_path / "__init__.py"))
    assert (names(), everything) == ([], [])
    with pytest.raises(AttributeError, match="module 'nothing' has no attribute 'x'"):
        lookup("x")


def test_the_package_says_that_it_is_typed():
    assert (FOLDER / "py.typed").is_file()
