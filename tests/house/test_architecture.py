"""The house rules of docs/design/architecture.md, read from the syntax trees of every file in src.

Each rule maps files to complaints. It is held on the real files, and on small bad examples, so that a rule
that has gone blind fails too.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

Files = dict[str, str]
"""Path below src/holosplat, or `holosplat_bench/…` → source text."""

PLAN = """
units version checks ranges rotations lazy tables native launch backends memory progress display plugins
geometry frames divided_light scan volume mesh matter
← materials optics metrics projectors preprocess inference
← specimens representations model
← io fit baselines
← bodies learning beamline
← methods
← align motion
← workflows planning
← report show
← series
← cli ← __main__
← holosplat_bench/specimens holosplat_bench/formats ← holosplat_bench/declaration ← holosplat_bench/training
← holosplat_bench/opponents ← holosplat_bench/suite
← holosplat_bench/thesis
← holosplat_bench/cli
"""
TIERS = tuple(tuple(tier.split()) for tier in PLAN.split("←"))
"""Rooms, lowest first, of the core and then of the benchmark. A room imports rooms of lower tiers."""

SAME_TIER = dict.fromkeys(TIERS[0], TIERS[0])
"""Rooms of their own tier that a room may import (the nouns among themselves: without cycles)."""

BACKENDS = ("*/cpu.py", "*/cuda.py", "*/reference.py")
BACKEND_IMPORTS = {
    "optics/hologram/reference.py": ("optics",),
    "baselines/tv_steps/cuda.py": ("projectors",),
}
"""What a backend file may import of ours, beside its own folder and `native`."""

HEAVY: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("vtk", "vtkmodules", "trimesh", "skimage", "viser", "websockets", "zarr", "numcodecs"), ()),
    "matplotlib": ("report", "holosplat_bench/suite/pages", "holosplat_bench/thesis/pages", "holosplat_bench/cli"),
    "jinja2": ("report",),
    "tyro": ("cli", "holosplat_bench/cli"),
}
"""Packages slow to import, and the rooms or parts of rooms that do so at module level (others inside a function)."""

MOST_LINES = 400
EXAMPLES = re.compile(r"\n *Examples:\n\n(?: +(?:>>>|\.\.\.) .*\n| +[^\s\"].*\n)+")
"""The last section of a docstring."""
MOST_ARGUMENTS = 7
Function = ast.FunctionDef | ast.AsyncFunctionDef

SOURCE = Path(__file__).resolve().parents[2] / "src"
BENCH = "holosplat_bench"
TESTS = Path(__file__).resolve().parents[1]
BESIDE_THE_ROOMS = ("house", "helpers", "bench")
"""Folders of tests that are not of one room: the house as a whole, what test files share, and all of the benchmark."""


@pytest.fixture(scope="module")
def files() -> Files:
    """Every Python file of both packages."""
    texts = {p.relative_to(SOURCE).as_posix(): p.read_text(encoding="utf-8") for p in SOURCE.rglob("*.py")}
    assert {path.split("/")[0] for path in texts} == {"holosplat", BENCH}
    assert len(texts) > 20
    return {path.removeprefix("holosplat/"): text for path, text in texts.items()}


# --- reading ------------------------------------------------------------------------------------------------


def _room(path: str) -> str:
    """`optics/noise.py` → `optics`, `scan.py` → `scan`, a package's own `__init__.py` → empty; rooms of the
    benchmark have its name before theirs."""
    package = f"{BENCH}/" if path.startswith(f"{BENCH}/") else ""
    first = path.removeprefix(package).split("/")[0].removesuffix(".py")
    return "" if first == "__init__" else package + first


def _dotted(path: str) -> str:
    """A file's path with its package before it."""
    return path if path.startswith(f"{BENCH}/") else "holosplat/" + path


@cache
def _tree(text: str) -> ast.Module:
    """The syntax of a file; parsed once."""
    return ast.parse(text)


@cache
def _imported(text: str) -> list[tuple[ast.Import | ast.ImportFrom, bool]]:
    """The import statements of a file, and whether they stand at module level."""
    found, outside = [], [(_tree(text), True)]
    while outside:
        parent, top = outside.pop()
        for node in ast.iter_child_nodes(parent):
            if isinstance(node, ast.Import | ast.ImportFrom):
                found.append((node, top))
            else:
                outside.append((node, top and not isinstance(node, Function)))
    return found


def _imports(files: Files, path: str) -> Iterator[tuple[str, str, bool]]:
    """(our file or empty, full dotted name, whether at module level) of each import but the version's."""
    for node, top in _imported(files[path]):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            package = _dotted(path).split("/")[: -node.level] if node.level else []
            base = ".".join([*package, *filter(None, [node.module])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        for name in set(names):
            yield _file_of(files, name), name, top


def _file_of(files: Files, name: str) -> str:
    """The file that holds the dotted `name`: itself a module, or a name in one; empty if it is not ours."""
    parts = name.split(".")
    if parts[0] not in ("holosplat", BENCH):
        return ""
    for depth in range(len(parts), 1, -1):
        stem = "/".join(parts[:depth]).removeprefix("holosplat/")
        for candidate in (f"{stem}.py", f"{stem}/__init__.py"):
            if candidate in files:
                return candidate
    return f"{BENCH}/__init__.py" if parts[0] == BENCH else "__init__.py"


def _public(files: Files) -> Iterator[tuple[str, ast.ClassDef | Function, bool]]:
    """(path:name, node, whether a method) of public classes and functions; `__init__` counts as public."""

    def walk(body: list[ast.stmt], name: str, method: bool) -> Iterator[tuple[str, ast.ClassDef | Function, bool]]:
        for node in body:
            if not isinstance(node, ast.ClassDef | Function):
                continue
            if node.name.startswith("_") and node.name != "__init__":
                continue
            yield f"{name}{node.name}", node, method
            if isinstance(node, ast.ClassDef):
                yield from walk(node.body, f"{name}{node.name}.", True)

    for path, text in files.items():
        yield from walk(_tree(text).body, f"{path}:", False)


# --- rules --------------------------------------------------------------------------------------------------


def every_room_is_on_the_plan(files: Files) -> list[str]:
    """A new room needs its place in `TIERS` and in docs/design/architecture.md."""
    known = {"", *(room for tier in TIERS for room in tier)}
    return [path for path in files if _room(path) not in known]


def imports_run_downwards(files: Files) -> list[str]:
    """A room imports its own files, rooms of lower tiers, what `SAME_TIER` adds, and the root's version."""
    tier_of = {room: t for t, tier in enumerate(TIERS) for room in tier}
    complaints = []
    for path in files:
        room = _room(path)
        for target, name, _ in _imports(files, path):
            there = _room(target)
            if not room or not target or there == room:
                continue
            lower = tier_of.get(there, len(TIERS)) < tier_of.get(room, -1)
            if not lower and there not in SAME_TIER.get(room, ()):
                complaints.append(f"{path} imports {name}")
    return complaints


def the_core_does_not_name_the_benchmark(files: Files) -> list[str]:
    """It finds what the benchmark adds by entry points (`plugins.Extended`)."""
    return [path for path, text in files.items() if not path.startswith(f"{BENCH}/") and BENCH in text]


def no_cycles(files: Files) -> list[str]:
    """No file imports itself by way of others, wherever in the file the imports stand."""
    graph = {path: {t for t, _, _ in _imports(files, path) if t and t != path} for path in files}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [" → ".join(error.args[1])]
    return []


def backends_stand_alone(files: Files) -> list[str]:
    """A backend file imports its own folder, `native`, `launch`, and what `BACKEND_IMPORTS` adds."""
    complaints = []
    for path in files:
        if not any(fnmatch(path, pattern) for pattern in BACKENDS):
            continue
        for target, name, _ in _imports(files, path):
            own = target.startswith(path.rsplit("/", 1)[0] + "/") or target in ("native.py", "launch.py")
            if target and not own and _room(target) not in BACKEND_IMPORTS.get(path, ()):
                complaints.append(f"{path} imports {name}")
    return complaints


def heavy_packages_wait(files: Files) -> list[str]:
    """Packages in `HEAVY` are imported at module level in their own rooms only."""
    return [
        f"{path} imports {name} at module level"
        for path in files
        for _, name, top in _imports(files, path)
        if top and not path.startswith(HEAVY.get(name.split(".")[0], ("",)))
    ]


def files_are_short(files: Files) -> list[str]:
    """No file is longer than `MOST_LINES`, without the examples of its docstrings."""
    lengths = {path: EXAMPLES.sub("", text).count("\n") for path, text in files.items()}
    return [f"{path}: {n} lines" for path, n in lengths.items() if n > MOST_LINES]


def everything_public_is_described(files: Files) -> list[str]:
    """Modules, public classes, functions and methods have docstrings (the class describes `__init__`)."""
    bare = [path for path, text in files.items() if text.strip() and not ast.get_docstring(_tree(text))]
    named = [(name, node) for name, node, _ in _public(files) if node.name != "__init__"]
    return bare + [name for name, node in named if not ast.get_docstring(node)]


def arguments_are_few(files: Files) -> list[str]:
    """Public functions take no `**kwargs`, and at most `MOST_ARGUMENTS` by position beside self or cls."""
    complaints = []
    for name, node, method in _public(files):
        if isinstance(node, ast.ClassDef):
            continue
        if node.args.kwarg:
            complaints.append(f"{name} takes **{node.args.kwarg.arg}")
        static = any(isinstance(d, ast.Name) and d.id == "staticmethod" for d in node.decorator_list)
        count = len(node.args.posonlyargs) + len(node.args.args) - (method and not static)
        if count > MOST_ARGUMENTS:
            complaints.append(f"{name} takes {count} arguments by position")
    return complaints


RULES: tuple[Callable[[Files], list[str]], ...] = (
    every_room_is_on_the_plan,
    imports_run_downwards,
    the_core_does_not_name_the_benchmark,
    no_cycles,
    backends_stand_alone,
    heavy_packages_wait,
    files_are_short,
    everything_public_is_described,
    arguments_are_few,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_rule_holds(rule, files):
    complaints = rule(files)
    assert not complaints, f"{rule.__doc__}\n" + "\n".join(complaints)


def test_the_tests_mirror_the_rooms_in_short_files(files):
    """A test file lies in the folder of its room (at the root for a room that is one file); names are unique."""
    found = {path.relative_to(TESTS).as_posix(): path.read_text(encoding="utf-8") for path in TESTS.rglob("*.py")}
    folders = {path.split("/")[0] for path in found if "/" in path}
    assert folders <= {path.split("/")[0] for path in files if "/" in path} - {BENCH} | set(BESIDE_THE_ROOMS)
    names = [path.rsplit("/", 1)[-1] for path in found if "/test_" in path]
    assert sorted(set(names)) == sorted(names)
    assert not files_are_short(found)


def test_the_pages_name_the_tiers(files):
    """CONTRIBUTING.md lists all rooms, lowest first; architecture.md those above the nouns."""
    contributing, architecture = (
        (TESTS.parent / page).read_text(encoding="utf-8") for page in ("CONTRIBUTING.md", "docs/design/architecture.md")
    )
    listed = contributing.split("Imports run downwards only:")[1].split("Rooms of one tier")[0]
    assert [set(tier.split()) for tier in listed.split("←")] == [set(tier) for tier in TIERS]
    listed = architecture.split("Imports run downwards only: nouns ←")[1].split(". A test")[0]
    said = [re.sub(r"\(.*?\)|[{},.`]", " ", tier).split() for tier in listed.split("←")]
    assert [set(tier) for tier in said] == [set(tier) for tier in TIERS[1:]]


def test_the_exceptions_are_still_needed(files):
    """An exception that nothing uses any more is taken off the list."""
    assert all(path in files for path in BACKEND_IMPORTS)


# --- the rules see what they should -------------------------------------------------------------------------

GOOD: Files = {
    "__init__.py": '"""Root."""\n',
    "version.py": '"""The version."""\n__version__ = "1"\n',
    "units.py": '"""Constants."""\nimport math\n',
    "geometry.py": '"""Views."""\nfrom .units import x\n',
    "optics/__init__.py": '"""Waves."""\nfrom .wave import y\n',
    "optics/wave.py": '"""A wave."""\nfrom ..units import x\n\n\ndef _draw():\n    import matplotlib\n',
    "projectors/__init__.py": '"""Lines."""\n',
    "native.py": '"""Kernels."""\n',
    "projectors/mesh/__init__.py": '"""Meshes."""\nfrom . import reference\nfrom ...geometry import Views\n',
    "projectors/mesh/reference.py": '"""Twin."""\nfrom ... import native\n',
    "io/__init__.py": '"""Files."""\nfrom ..version import __version__\nfrom ..optics import y\n',
    "report/__init__.py": '"""Pages."""\nimport matplotlib.pyplot\n',
    "cli.py": '"""Commands."""\nimport tyro\nfrom . import report\nfrom holosplat.optics.wave import y\n',
    "holosplat_bench/suite/rows.py": '"""Rows."""\nfrom holosplat.report import page\nfrom ..opponents import a\n',
    "holosplat_bench/opponents/__init__.py": '"""Opponents."""\n',
}
"""A house that keeps every rule."""

METHOD = '"""M."""\n\n\nclass A:\n    """A."""\n\n    def {signature}:\n        {body}\n'
EIGHT = "(self, a, b, c, d, e, f, g, h)"
BAD: tuple[tuple[Callable[[Files], list[str]], str, str], ...] = (
    (every_room_is_on_the_plan, "attic.py", '"""A."""\n'),
    (every_room_is_on_the_plan, "attic/box.py", '"""A."""\n'),
    (imports_run_downwards, "units.py", "from .optics.wave import y\n"),
    (imports_run_downwards, "units.py", "from . import optics\n"),
    (imports_run_downwards, "units.py", "import holosplat.optics.wave\n"),
    (imports_run_downwards, "units.py", "from holosplat import cli\n"),
    (imports_run_downwards, "optics/wave.py", "from ..projectors import mesh\n"),
    (imports_run_downwards, "optics/wave.py", "def late():\n    from .. import io\n"),
    (imports_run_downwards, "report/__init__.py", "from ..cli import main\n"),
    (imports_run_downwards, "io/more.py", "from .. import other\n"),
    (imports_run_downwards, "io/more.py", "from holosplat_bench.suite import rows\n"),
    (imports_run_downwards, "io/more.py", "def late():\n    import holosplat_bench\n"),
    (imports_run_downwards, "holosplat_bench/opponents/more.py", "from ..suite import rows\n"),
    (every_room_is_on_the_plan, "holosplat_bench/attic/box.py", '"""A."""\n'),
    (the_core_does_not_name_the_benchmark, "units.py", 'x = "holosplat_bench.suite"\n'),
    (no_cycles, "units.py", "from .geometry import Views\n"),
    (no_cycles, "optics/wave.py", "def late():\n    from . import y\n"),
    (backends_stand_alone, "projectors/splat/cpu.py", "from ...geometry import Views\n"),
    (backends_stand_alone, "projectors/splat/cpu.py", "from ..mesh.reference import rays\n"),
    (backends_stand_alone, "projectors/mesh/reference.py", "from ...checks import require\n"),
    (heavy_packages_wait, "io/vtk.py", "import vtk\n"),
    (heavy_packages_wait, "io/vtk.py", "try:\n    from vtkmodules import a\nexcept OSError:\n    pass\n"),
    (heavy_packages_wait, "report/__init__.py", "import tyro as t\n"),
    (files_are_short, "units.py", "x = 1\n" * (MOST_LINES + 1)),
    (files_are_short, "units.py", '"""U.\n\nExamples:\n\n    >>> 1\n    1\n"""\n' + "x = 1\n" * (MOST_LINES - 1)),
    (everything_public_is_described, "units.py", "x = 1\n"),
    (everything_public_is_described, "units.py", '"""U."""\n\n\ndef f():\n    return 1\n'),
    (everything_public_is_described, "units.py", METHOD.format(signature="f(self)", body="return")),
    (everything_public_is_described, "units.py", '"""U."""\n\n\nclass A:\n    b = 1\n'),
    (arguments_are_few, "units.py", 'def f(**options):\n    """F."""\n'),
    (arguments_are_few, "units.py", 'def f(a, b, c, d, /, e, f, g, h):\n    """F."""\n'),
    (arguments_are_few, "units.py", METHOD.format(signature="method" + EIGHT, body='"""F."""')),
    (arguments_are_few, "units.py", METHOD.format(signature="__init__" + EIGHT, body="return")),
)  # fmt: skip
"""Rule, file and contents that break it when added to the good house."""


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_rule_accepts_a_good_house(rule):
    seven = {"projectors/splat/cpu.py": 'def _f(a, b, c, d, e, f, g, h):\n    """F."""\n'}
    assert rule(GOOD) == []
    assert arguments_are_few(seven) == []
    assert any(bad is rule for bad, _, _ in BAD), "the rule has no bad example"


@pytest.mark.parametrize(("rule", "path", "text"), BAD, ids=lambda value: getattr(value, "__name__", None))
def test_the_rule_refuses_a_bad_house(rule, path, text):
    assert len(rule(GOOD | {path: text})) == 1


# --- measured -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("everything", [False, True], ids=["holosplat", "all but the readers"])
def test_imports_are_light(everything, files):
    """No package of `HEAVY` is loaded by `import holosplat`, nor by what does not draw or talk; triton neither."""
    pages = (f"{BENCH}/suite/pages/", f"{BENCH}/thesis/pages/")
    readers = ("cli", "report/", "series/page.py", "__init__", *pages, f"{BENCH}/cli/")
    low = [p for p in files if everything and not p.startswith(readers)]
    low = [p for p in low if not fnmatch(p, "*/cuda.py") and not fnmatch(p, "*/triton_*.py")]
    modules = ["holosplat", *(_dotted(p).removesuffix(".py").replace("/", ".") for p in low)]
    code = f"import importlib, sys\nfor m in {modules}: importlib.import_module(m.removesuffix('.__init__'))\n"
    code += f"print(*(m for m in {[*HEAVY, 'triton']} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
