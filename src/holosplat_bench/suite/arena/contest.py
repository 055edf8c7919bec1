"""A contest in a process of its own: a question in a file, the act of a contestant, its answer and what it took."""

from __future__ import annotations

import contextlib
import importlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np

from holosplat.checks import InputError
from holosplat.io.guard import read_archive

Track = Literal["kernels", "steps", "retrieval", "tomography", "jobs"]
"""A kind of contest."""
TRACKS: Mapping[Track, str] = {
    "kernels": "the projector pair of voxels: project a volume, back-project noise",
    "steps": "one step of a fit: the gradient of the frames' misfit with respect to voxels",
    "retrieval": "the phase of every view from its frame",
    "tomography": "the volume from one and the same retrieved phase",
    "jobs": "the whole job: the volume from the frames",
}
"""Track → what contestants do there."""
WARM: Mapping[Track, int] = {"kernels": 3, "steps": 3}
"""Calls of which the fastest counts, where a fit would call thousands of times; elsewhere the first and only one."""


@dataclass(frozen=True)
class Question:
    """What a contestant gets: no truth.

    frames [V, H, W], over the flat field; angles [V] [rad], about the rows' axis y; pixel [m], energy_kev, distance
    [m]; ratio: δ/β. lines: retrieved k∫δ dz [V, H, W] [rad] (tomography), or numbers to be projected back (kernels);
    volume: kδ times a pixel [Z, Y, X] [rad] (kernels, steps). pair: acts of a pair, one after the other (jobs).
    """

    frames: np.ndarray
    angles: np.ndarray
    pixel: float
    energy_kev: float
    distance: float
    ratio: float
    lines: np.ndarray
    volume: np.ndarray
    pair: tuple[str, ...] = ()

    def write(self, path: Path) -> None:
        """As a NumPy archive."""
        np.savez(path, allow_pickle=False, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Question:
        """Those that `write` wrote."""
        held = read_archive(path, what="a question of the arena")
        pixel, energy, distance, ratio = (float(held[n]) for n in ("pixel", "energy_kev", "distance", "ratio"))
        pair = tuple(str(act) for act in held["pair"])
        return cls(held["frames"], held["angles"], pixel, energy, distance, ratio, held["lines"], held["volume"], pair)


Answer = dict[str, np.ndarray]
"""`lines` and `volume` (kernels), `gradient` (steps), `lines` (retrieval), `volume` and maybe `beta` (the others)."""
Act = Callable[[Question], Callable[[], Answer]]
"""Imports and sets up, which is not counted, and gives what is."""


@dataclass(frozen=True)
class Contestant:
    """name: of the row, with the track's; distribution: what pip installs, empty for ours; act: `module:function` of an
    `Act`; summary: one line."""

    name: str
    track: Track
    distribution: str
    act: str
    summary: str

    @property
    def ours(self) -> bool:
        """Whether it is holosplat itself."""
        return not self.distribution

    @property
    def installed(self) -> bool:
        """Whether its distribution is there."""
        try:
            return self.ours or bool(metadata.version(self.distribution))
        except metadata.PackageNotFoundError:
            return False


@dataclass(frozen=True)
class Outcome:
    """answer: None where there is none, for the reason; seconds: processor time of the act, user and system, with its
    children; memory_bytes: peak of its process, libraries included."""

    answer: Answer | None
    reason: str
    seconds: float | None = None
    memory_bytes: int | None = None


ALONE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
    "CUDA_VISIBLE_DEVICES": "",
    "MPLBACKEND": "agg",
    "QT_QPA_PLATFORM": "offscreen",
}
"""One thread, the processor alone, and no windows, for all contestants."""
STATUS, MEMORY_UNIT = Path("/proc/self/status"), 1024
"""It and `ru_maxrss` count kilobytes on Linux (getrusage(2), proc(5))."""
SPENT, PEAK = "processor_seconds", "peak_bytes"
"""Entries of an answer's file beside the answer."""


def compete(act: str, question: Question, calls: int, limit: float) -> Outcome:
    """`act` on `question` in a process of its own, stopped with its children after `limit` seconds of wall time.

    calls: of which the fastest counts. A process that ends without an answer is an outcome with the reason.
    """
    with tempfile.TemporaryDirectory(prefix="arena-") as name:
        folder = Path(name)
        asked, answered, said = folder / "question.npz", folder / "answer.npz", folder / "said.txt"
        question.write(asked)
        command = [sys.executable, "-m", __name__, act, str(asked), str(answered), str(calls)]
        paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        with said.open("wb") as errors:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=os.environ | ALONE | paths,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,
            )
            try:
                code = process.wait(limit)
            except subprocess.TimeoutExpired:
                return Outcome(None, f"stopped after {limit:g} s")
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        if code == 0 and answered.is_file():
            held = read_archive(answered, what="an answer of the arena")
            spent, peak = float(held.pop(SPENT)), int(held.pop(PEAK))
            return Outcome(held, "", spent, peak)
        return Outcome(None, _why(code, said.read_text(encoding="utf-8", errors="replace")))


def _why(code: int, said: str) -> str:
    """Why a process gave no answer, in a line."""
    last = next((line.strip() for line in reversed(said.splitlines()) if line.strip()), "")
    if code < 0:
        return f"ended by signal {signal.Signals(-code).name}"
    return last[:300] or f"ended with code {code} and no answer"


def located(act: str) -> Act:
    """The function `module:function`."""
    module, _, name = act.partition(":")
    return getattr(importlib.import_module(module), name)


def processor_seconds() -> float:
    """User and system time of this process and of the children that it waited for [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def status_bytes(key: str) -> int | None:
    """An entry of /proc/self/status [bytes]; None where there is none."""
    try:
        lines = STATUS.read_text(encoding="ascii", errors="replace").splitlines()
        return MEMORY_UNIT * next(int(line.split()[1]) for line in lines if line.startswith(key + ":"))
    except (OSError, StopIteration):
        return None


def _peak() -> int:
    """Peak memory of this process [bytes]; VmHWM where there is one, for ru_maxrss has the parent's in it."""
    return status_bytes("VmHWM") or MEMORY_UNIT * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main(act: str, asked: str, answered: str, calls: str) -> None:
    """Run an act on the question of a file, and write the answer; what fails is said in a line."""
    try:
        run = located(act)(Question.read(Path(asked)))
        best, answer = float("inf"), {}
        for _ in range(int(calls)):
            before = processor_seconds()
            answer = run()
            best = min(best, processor_seconds() - before)
    except Exception as error:  # a contestant's fault is its row, whatever it raises
        plain = str(error).strip().splitlines()
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        sys.exit(kind + (plain[-1] if plain else "no words"))
    np.savez(answered, allow_pickle=False, **answer, **{SPENT: best, PEAK: _peak()})


OWN, PEERS, WAVES = ("holosplat_bench.suite.arena." + name for name in ("own", "peers", "peers_waves"))
"""Modules of acts."""
BEST_PAIR = "best-pair"
"""The pair of peers that was best on a case, known from the rows of the two tracks before."""


def _ours(track: Track, *rows: tuple[str, str, str]) -> list[Contestant]:
    return [Contestant(f"holosplat-{name}", track, "", f"{OWN}:{act}", said) for name, act, said in rows]


def _theirs(module: str, track: Track, *rows: tuple[str, str, str, str]) -> list[Contestant]:
    return [Contestant(name, track, pip, f"{module}:{act}", said) for name, pip, act, said in rows]


CONTESTANTS = [
    *_ours("kernels", ("slices", "slices", "slice matrices, exact strips")),
    *_theirs(
        PEERS,
        "kernels",
        ("astra-strip", "astra-toolbox", "astra_strip", "ASTRA, strips"),
        ("astra-linear", "astra-toolbox", "astra_linear", "ASTRA, Joseph's interpolation"),
        ("rtk-joseph", "itk-rtk", "rtk_pair", "RTK, Joseph's interpolation"),
        ("svmbir", "svmbir", "svmbir_pair", "svmbir, matrices made in each call"),
        ("mbirjax", "mbirjax", "mbirjax_pair", "MBIRJAX"),
        ("scico", "scico", "scico_pair", "SCICO on voxels of half the size, which it needs"),
    ),
    *_ours("steps", ("voxels", "step", "compiled kernels with adjoints")),
    *_theirs(
        WAVES,
        "steps",
        ("torch-eager", "torch", "torch_step", "eager PyTorch: grid_sample and FFT"),
    ),
    *_theirs(PEERS, "steps", ("scico-jax", "scico", "scico_step", "SCICO's operators, differentiated by JAX")),
    *_ours(
        "retrieval",
        ("ctf", "contrast_transfer", "linear inverse"),
        ("tikhonov", "tikhonov", "nonlinear, with positivity"),
    ),
    *_theirs(
        WAVES,
        "retrieval",
        ("hotopy-ctf", "hotopy", "hotopy_ctf", "hotopy, linear inverse"),
        ("hotopy-tikhonov", "hotopy", "hotopy_tikhonov", "hotopy, nonlinear, with positivity"),
        ("pyphase-ctf", "pyphase", "pyphase_ctf", "PyPhase, linear inverse"),
    ),
    *_ours(
        "tomography",
        ("fbp", "backprojection", "filtered back-projection"),
        ("sirt", "sirt", "SIRT without negative values"),
        ("tv", "total_variation", "total variation without negative values"),
    ),
    *_theirs(
        PEERS,
        "tomography",
        ("astra-fbp", "astra-toolbox", "astra_backprojection", "ASTRA, filtered back-projection"),
        ("astra-sirt", "astra-toolbox", "astra_sirt", "ASTRA, SIRT without negative values"),
        ("rtk-fdk", "itk-rtk", "rtk_fdk", "RTK, filtered back-projection (FDK)"),
        ("svmbir", "svmbir", "svmbir_volume", "svmbir, qGGMRF without negative values"),
        ("mbirjax", "mbirjax", "mbirjax_volume", "MBIRJAX, qGGMRF without negative values"),
        ("scico-tv", "scico", "scico_volume", "SCICO, total variation without negative values"),
    ),
    *_ours(
        "jobs",
        ("default", "default", "holosplat reconstruct, as it decides by itself"),
        ("two-steps", "two_steps", "nonlinear retrieval of each view, total variation"),
    ),
    Contestant(BEST_PAIR, "jobs", "numpy", f"{WAVES}:pair", "the peers' best retrieval and best tomography"),
]
"""All contestants, in the order of the tables."""


if __name__ == "__main__":
    main(*sys.argv[1:])
