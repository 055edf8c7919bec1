"""What several test modules share."""

from __future__ import annotations

import gc
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin starve whoever shares the cores
os.environ.setdefault("OMP_NUM_THREADS", "1")  # BLAS's, too: problems of the tests are too small for two

import pytest
import torch
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from helpers.once import Once

pytest.register_assert_rewrite("helpers")  # failures there say as much as in the tests

TRITON = importlib.util.find_spec("triton") is not None
GPU = TRITON and torch.cuda.is_available()
KERNELS = (
    "projectors.splat",
    "projectors.surface",
    "projectors.voxels.lattice_kernels",
    "projectors.voxels.slice_products",
    "optics.hologram",
    "fit.fidelity",
    "fit.adam",
    "baselines.tv_steps",
)
"""Packages with Triton kernels."""

TOGETHER = ("tests/cli", "tests/workflows")
"""Folders whose files share what takes seconds to make: the run of the commands, what runs on one scan begin with."""

LONG = (
    *TOGETHER,
    "tests/house/test_triton_compile.py",
    "tests/house/test_examples.py",
    "tests/house/test_docs_blocks.py",
    "tests/bench",
    "tests/align",
    "tests/baselines",
    "tests/methods",
    "tests/optics/test_retrieval_methods.py",
    "tests/training",
    "tests/motion",
    "tests/series",
)
"""What takes longest, and so begins first where there are several processes: none has a long file left at the end."""

settings.register_profile(
    "repeatable",  # the same examples at every run, on every machine, however slow it is
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("repeatable")


def _bind_kernels_to_the_interpreter() -> None:
    """Import Triton and all kernels such that they run in Triton's interpreter, on tensors in main memory.

    Triton decides so when a kernel is defined, by an environment variable. It is taken away again: only tests that
    ask for the fixture `gpu` shall see it, no other test and no subprocess.
    """
    from helpers.interpreter import spare_repetitions

    os.environ["TRITON_INTERPRET"] = "1"
    spare_repetitions()
    try:
        for package in KERNELS:
            importlib.import_module(f"holosplat.{package}.cuda")
    finally:
        del os.environ["TRITON_INTERPRET"]


if TRITON and not GPU:
    _bind_kernels_to_the_interpreter()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests marked `gpu` need one; in one of several processes, what is `LONG` comes first."""
    for item in items:
        if not GPU and item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="there is no GPU here"))
    if hasattr(config, "workerinput"):
        items.sort(key=_place)  # a stable sort: the tests of a file keep their order


def _place(item: pytest.Item) -> int:
    """The number in `LONG` of the folder or file of a test; what is not there comes last."""
    return next((k for k, start in enumerate(LONG) if item.nodeid.startswith(start)), len(LONG))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object | None:
    """With `--dist loadfile`, tests of a folder in `TOGETHER` stay in one process, too, as those of a file do.

    Their order is that of the collection, in which what is `LONG` comes first.
    """
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False  # by the number of tests, which says little of their time

    class ByFolder(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            folder = nodeid.split("::")[0].rpartition("/")[0]
            return folder if folder in TOGETHER else super()._split_scope(nodeid)

    return ByFolder(config, log)


def pytest_collection_finish() -> None:
    """What is there before the first test stays: no later collection of garbage looks through it again.

    And these come more seldom, for they were a fortieth of the time of a file of tests: what tests leave is little.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where Triton's kernels run: on the GPU or, without one, in Triton's interpreter on the CPU."""
    if not TRITON:
        pytest.skip("triton is not installed")
    if GPU:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)  # hidden where a test asks for this late
    else:
        monkeypatch.setenv("TRITON_INTERPRET", "1")
    return torch.device("cuda" if GPU else "cpu")


@pytest.fixture(autouse=True)
def _on_the_cpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The backend `auto` means the CPU in tests that do not ask for a GPU: their results are the same everywhere."""
    if GPU and not {"gpu"} & {*request.fixturenames, *(mark.name for mark in request.node.iter_markers())}:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Torch takes one thread: the problems of the tests are small."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _no_wait_for_the_disk() -> Iterator[None]:
    """What tests write need not survive a power cut; that it is flushed, and when, tests/workflows/test_full_disk.py
    asks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)  # which fails as fsync does where there is no such file
        yield


@pytest.fixture
def undrawn_reports() -> Iterator[None]:
    """Reports of runs have their text, and blank figures; see `helpers.pictures`."""
    from helpers.pictures import undrawn

    with undrawn():
        yield


@pytest.fixture
def unjudged_runs() -> Iterator[None]:
    """Runs are not judged; see `helpers.unjudged`."""
    from helpers.unjudged import unjudged

    with unjudged():
        yield


@pytest.fixture
def quick_likelihood() -> Iterator[None]:
    """The likelihood of δ/β is that of volumes of few steps; see `helpers.short`."""
    from helpers.short import in_few_steps

    with in_few_steps():
        yield


@pytest.fixture(scope="session")
def memory() -> Once:
    """What short runs of this session begin with, by their frames; see `helpers.once`."""
    from helpers.once import Once

    return Once()


@pytest.fixture(scope="module")
def begun_once(memory: Once) -> Iterator[Once]:
    """Runs on the same frames begin with what the first of them has found. To begin anew: `begun_once.made.clear()`."""
    from helpers.once import once

    with once(memory):
        yield memory


@pytest.fixture(scope="module")
def plain_light(begun_once: Once) -> Iterator[None]:
    """Runs compare no hypotheses about light, and share what they begin with; see `helpers.unjudged`."""
    from helpers.unjudged import in_plain_light

    with in_plain_light():
        yield


@pytest.fixture(scope="session")
def espresso_rbc() -> Path:
    """Folder of simulated red cells in a channel (VTK files of other programs); skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared/data/espresso_rbc"
    if not folder.is_dir():
        pytest.skip("the red-cell sample data is not here")
    return folder
