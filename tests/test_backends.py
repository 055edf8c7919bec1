"""The backend switch: what a name stands for, what is said when something is missing, and that the table is true."""

from __future__ import annotations

import importlib
import re

import numpy as np
import pytest
import torch

from holosplat import backends, native
from holosplat.backends import DESCRIPTIONS, NAMES, SUPPORT, coarse_work, missing, resolve, support_table
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError, MissingError
from holosplat.cli import commands
from holosplat.cli.commands import Asked
from holosplat.cli.options import MethodOptions
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, Task
from holosplat.methods.illumination import prepared
from holosplat.methods.solve import settled
from holosplat.methods.trials import decide_kind
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

GONE = "a reason"


def lack(monkeypatch, *names: str) -> None:
    """Make the named backends unusable."""
    monkeypatch.setattr(backends, "missing", lambda name: GONE if name in names else "")


@pytest.mark.parametrize(
    ("lacking", "wanted"), [((), "cuda"), (("cuda",), "cpu"), (("cpu",), "cuda")], ids=["both", "no GPU", "no kernels"]
)
def test_auto_prefers_a_gpu_and_never_takes_the_plain_path(monkeypatch, lacking, wanted):
    lack(monkeypatch, *lacking)
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    assert resolve("auto") == wanted


def test_auto_never_takes_the_interpreter(monkeypatch):
    lack(monkeypatch)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert resolve("auto") == "cpu"
    assert resolve("cuda") == "cuda"
    lack(monkeypatch, "cpu")
    with pytest.raises(InputError, match="cannot be used"):
        resolve("auto")


@pytest.mark.parametrize("name", ["auto", "cpu", "cuda"])
def test_what_is_missing_is_said_of_both_with_the_way_out(monkeypatch, name):
    monkeypatch.setattr(backends, "missing", lambda which: {"cpu": "no library", "cuda": "no device"}.get(which, ""))
    with pytest.raises(InputError, match=rf"'{name}'.*cuda: no device; cpu: no library.*'reference'"):
        resolve(name)
    assert resolve("reference") == "reference"


def test_a_missing_backend_is_never_replaced(monkeypatch):
    lack(monkeypatch, "cuda")
    with pytest.raises(InputError, match=f"cuda: {GONE}; cpu: can be used"):
        resolve("cuda")


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="must be one of auto, cpu, cuda, reference, but it is 'gpu'"):
        resolve("gpu")
    with pytest.raises(InputError, match="backend must be one of"):
        backends.implementation("holosplat.fit.adam", "auto")


def test_the_kernels_reason_is_the_loaders(monkeypatch):
    def absent() -> tuple[str, ...]:
        raise MissingError("The kernels are gone.")

    monkeypatch.setattr(native, "available_isas", absent)
    assert missing("cpu") == "The kernels are gone"


def test_the_gpus_reasons(monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert "has no CUDA" in missing("cuda")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert "no CUDA device" in missing("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert missing("cuda") == ""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "triton is not installed" in missing("cuda")


@pytest.mark.parametrize("operation", SUPPORT)
@pytest.mark.parametrize("backend", DESCRIPTIONS)
def test_the_table_says_what_there_is(operation, backend):
    package, function, _ = SUPPORT[operation]
    if backend == "cuda":
        pytest.importorskip("triton")
    assert callable(getattr(backends.implementation(f"holosplat.{package}", backend), function))


def test_the_table_has_every_folder_of_backends():
    source = native.Path(backends.__file__).parent
    folders = {p.parent.relative_to(source).as_posix().replace("/", ".") for p in source.rglob("cuda.py")}
    assert folders == {package for package, _, _ in SUPPORT.values()}
    assert [row[0] for row in support_table()] == list(SUPPORT)
    assert set(NAMES) == {"auto", *DESCRIPTIONS}


def test_the_documented_table_is_the_table():
    page = (native.Path(__file__).resolve().parents[1] / "docs/backends.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"]
    assert [row for row in rows if row in support_table()] == support_table()


def test_the_command_line_lists_and_refuses(monkeypatch, capsys, tmp_path):
    """`holosplat backends` has every name and reason; a backend that cannot be used stops before anything is read."""
    monkeypatch.setattr(backends, "missing", lambda name: GONE if name == "cuda" else "")
    commands.backends()
    shown = capsys.readouterr().out
    assert f"not usable here: {GONE}" in shown
    assert all(name in shown for name in NAMES)
    rows = [tuple(re.split(" {2,}", line)) for line in shown.splitlines()]
    assert [row for row in rows if row[0] in SUPPORT] == [tuple(row) for row in support_table()]
    lack(monkeypatch, "cuda")
    with pytest.raises(InputError, match=f"'cuda' cannot be used here. cuda: {GONE}"):
        commands.reconstruct(tmp_path / "none.nxs", tmp_path / "run", Asked(how=MethodOptions(backend="cuda")))
    assert not (tmp_path / "run").exists()


def test_a_backend_that_an_operation_lacks_is_missing():
    with pytest.raises(MissingError, match=r"optics cannot use backend 'cpu'"):
        backends.implementation("holosplat.optics", "cpu")


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_coarse_work_takes_one_thread_and_gives_the_others_back():
    @coarse_work()
    def failing(threads: int) -> None:
        assert torch.get_num_threads() == threads
        raise InputError("no matter.")

    with pytest.raises(InputError):
        failing(1)
    assert torch.get_num_threads() == 3


@pytest.mark.usefixtures("three_threads")
def test_decisions_are_coarse_work():
    """The light, the kind of matter and the kind of result of two views, of which there is little to decide."""
    threads = list[int]()
    views = Views.evenly_spaced(2, (16, 17), 1e-6)
    scene = MeshScene.of_one_material(random_cells(1, (16e-6,) * 3, 1), DeltaBeta(4e-7, 4e-10))
    scan = simulate(scene, Exposures.of(views, 20.0, 0.05), is_test=np.zeros(2, dtype=bool))
    task = Task(scan, MaterialPrior.unknown(), on_progress=lambda stage, part: threads.append(torch.get_num_threads()))
    task = prepared(task, Auto())
    settled(Auto(), task)
    decide_kind(task, Auto().suited("levels"), "surfaces", "gaussians")
    assert set(threads) == {1}
    assert torch.get_num_threads() == 3
