"""The command line starts at once: the overview loads nothing heavy, a command's help no other command's modules."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys

import pytest

from helpers.cli import holosplat, worked
from holosplat.cli.entry import COMMANDS, command, is_late

pytestmark = pytest.mark.usefixtures("unjudged_runs")

HEAVY = ("torch", "scipy", "h5py", "xraydb", "vtk", "vtkmodules", "matplotlib", "jinja2", "tifffile", "PIL", "triton")
LIGHT = (
    *([], ["plan"], ["simulate"], ["reconstruct"], ["render"], ["export"], ["evaluate"], ["demo"], ["backends"]),
    *(["bench"], ["bench", "run"], ["bench", "report"], ["bench", "thesis"]),
)
IN_A_TENTH = {"h5py", "tifffile", "PIL", "jinja2"}
"""What other commands than `LIGHT` may load, which takes a tenth of a second."""
OTHERS = [name for name, (module, *_) in COMMANDS.items() if not is_late(module) and [name] not in LIGHT]


def loaded(arguments: list[str]) -> tuple[str, list[str]]:
    """What `holosplat ARGUMENTS --help` says in a process of its own, and which of `HEAVY` it loads."""
    code = "import sys\nsys.argv = ['holosplat', *sys.argv[1:]]\nfrom holosplat.cli import main\n"
    code += f"try: main()\nfinally: print('loaded', *(m for m in {HEAVY} if m in sys.modules))"
    command = [sys.executable, "-c", code, *arguments, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said, _, names = done.stdout.rpartition("loaded")
    return said, names.split()


@pytest.mark.parametrize("arguments", LIGHT, ids=" ".join)
def test_help_loads_nothing_heavy(arguments):
    said, heavy = loaded(arguments)
    assert heavy == []
    assert f"holosplat {' '.join(arguments)}".strip() in said


@pytest.mark.parametrize("name", OTHERS)
def test_help_takes_no_seconds(name):
    assert IN_A_TENTH.issuperset(loaded([name])[1])


def test_the_first_line_comes_before_what_takes_seconds_to_load(tmp_path):
    """Nothing is loaded where arguments are refused."""
    (tmp_path / "torch.py").write_text("raise SystemExit('loaded')\n")
    told = {**os.environ, "PYTHONPATH": str(tmp_path)}
    for options, code, said in ((["--out", "run"], 1, "loading libraries …\nloaded\n"), ([], 2, "--out")):
        command = [sys.executable, "-m", "holosplat", "reconstruct", str(tmp_path), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=told, cwd=tmp_path)
        assert done.returncode == code
        assert said in done.stderr
        assert "loaded" in done.stderr or code == 2


def test_nothing_is_searched_for_garbage_in_the_end():
    """Functions that are registered first are called last."""
    code = "import atexit, gc, sys\natexit.register(lambda: print(gc.get_freeze_count()))\n"
    code += "sys.argv = ['holosplat', '--version']\nfrom holosplat.cli import main\nmain()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) > 0


def test_the_check_sees_what_is_loaded(tmp_path, monkeypatch):
    """A module that loads h5py, put in the place of a command's, is noticed."""
    (tmp_path / "sitecustomize.py").write_text("import h5py\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert "h5py" in loaded([])[1]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_table_says_what_the_docstring_says(name):
    first = inspect.cleandoc(command(name).__doc__ or "").split("\n\n")[0]
    assert COMMANDS[name][1] == " ".join(first.split())


def test_the_overview_names_every_command():
    said = " ".join(worked(holosplat("--help")).out.split())
    for name, (_, summary, _) in COMMANDS.items():
        assert f" {name} {summary}" in said


def test_every_public_function_of_a_command_module_is_a_command():
    """A new command that is not in the table would be unreachable."""
    modules = {inspect.getmodule(command(name)) for name in COMMANDS}
    inner = {"report", "thesis", "arena", "write_bodies"}  # of `bench`; of `surface`
    inner |= {"status", "collect"}  # of `series`
    inner |= {"reconstruct_each", "reconstruct_in_motion", "asks_for_motion", "may_go_on", "report_of_middle"}
    inner |= {"watched", "say_where"}  # these and the others of `reconstruct`, by its --motion and --view
    for module in filter(None, modules):
        functions = {
            name
            for name, value in vars(module).items()
            if inspect.isfunction(value) and value.__module__ == module.__name__ and not name.startswith("_")
        }
        assert functions - set(COMMANDS) <= inner, module.__name__


def test_python_runs_the_package():
    done = subprocess.run([sys.executable, "-m", "holosplat", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == worked(holosplat("--version")).out


@pytest.mark.parametrize(
    "broken",
    ["raise ModuleNotFoundError('No module named torch', name='torch')", "raise ImportError('libc10.so: bad')"],
)
def test_without_torch_one_sentence_says_how_to_get_it(broken, tmp_path):
    """Whether it is missing or fails to load."""
    (tmp_path / "torch.py").write_text(broken + "\n")
    command = [sys.executable, "-m", "holosplat", "backends"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("holosplat: the package torch must be installed and load, but it does not")
    assert "Compute Platform: CPU" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1
