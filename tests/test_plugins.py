"""Tables that other packages add to by entry points: what is imported when, and whose name counts."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from holosplat import plugins
from holosplat.cli.entry import COMMANDS
from holosplat.methods import METHODS
from holosplat.planning.needs import Estimated
from holosplat.plugins import Extended
from holosplat.representations import KINDS
from holosplat.specimens.drawn import KINDS as SPECIMENS
from holosplat.specimens.drawn import FieldKind
from holosplat_bench.training.train import NETWORKS


@pytest.fixture
def table(monkeypatch) -> Extended[object]:
    """Names a and b of our own; another package adds b, c and d, which cannot be imported."""
    values = {"b": "math:tau", "c": "math:pi", "d": "no_such_package:value"}
    added = [EntryPoint(name, value, "holosplat.tests") for name, value in values.items()]
    monkeypatch.setattr(plugins, "entry_points", lambda group: added if group == "holosplat.tests" else [])
    return Extended({"a": 1, "b": 2}, "holosplat.tests")


def test_a_table_has_its_own_entries_and_then_those_that_are_added(table):
    assert list(table) == ["a", "b", "c", "d"]
    assert len(table) == 4
    assert table["a"] == 1
    assert table["b"] == 2, "a name of our own was replaced"
    assert table["c"] == pytest.approx(3.14159, abs=1e-5)


def test_nothing_is_imported_before_it_is_asked_for(table):
    assert "d" in table
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        table["d"]


def test_a_name_that_nobody_has_is_none(table):
    assert "e" not in table
    assert table.get("e") is None
    with pytest.raises(KeyError):
        table["e"]


def test_the_benchmark_adds_its_commands_methods_networks_and_kinds():
    assert set(COMMANDS) - set(COMMANDS.own) == {"bench", "dataset", "train"}
    added = {name: KINDS[name] for name in KINDS if name not in KINDS.own}
    assert added
    methods = {name: METHODS[name] for name in METHODS if name not in METHODS.own}
    assert set(methods) == {"neural-field", "onix", "pinn", "pixelnerf"}
    assert all(method.kind == name and isinstance(method, Estimated) for name, method in methods.items())
    assert set(NETWORKS) - set(NETWORKS.own) == {"onix", "pixelnerf"}
    assert all(kind.kind == name and issubclass(kind, FieldKind) for name, kind in SPECIMENS.items())
    assert all(kind.kind == name and kind.__module__.startswith("holosplat_bench.") for name, kind in added.items())


@pytest.mark.parametrize(
    "code",
    [
        "import holosplat.representations",
        "from holosplat.cli.entry import command; command('info')",
        "from holosplat.methods.presets import chosen_method; chosen_method('volume', None, None)",
    ],
)
def test_the_core_alone_does_not_load_the_benchmark(code):
    code += "; import sys; print(*(name for name in sys.modules if name.startswith('holosplat_bench')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
