"""A run is a folder: config.json, metrics.csv, checkpoint.pt, object.h5, summary.json, source.json, report.html; its
status by its last checkpoint and metrics."""

from __future__ import annotations

import csv
import secrets
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from ..checks import InputError, as_written, require, require_regular
from ..display import card, of_object
from ..io.atomic import atomic_path, read_json, require_new, require_parent, write_json, write_state
from ..io.formats import read_marks
from ..io.hdf5 import open_hdf5
from ..io.lock import Writer, sole_writer, writer_of
from ..io.provenance import sha256
from ..ranges import require_plausible
from .provenance import CONFIG_SUM, MANIFEST, RUN, config_sum, faults, require_bound, write_manifest

if TYPE_CHECKING:
    from ..representations import Stored

ROWS = 64
"""Rows of a dataset that are read at a time."""
SERIES = "series.json"
"""What tells the folder of a series."""
OBJECT_SUM = "object_sha256"
"""The entry of summary.json that says what the object's file was."""


class RunFolder:
    """The folder of a reconstruction: its settings, result, records and checkpoints.

    path: of the folder, which `reconstruct` makes. Every file is replaced as a whole; metrics.csv only grows.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> run = hs.RunFolder("run")
        >>> _ = hs.reconstruct(scan, hs.MaterialPrior.known(water), hs.preset("fast"), folder=run)
        >>> run.object.is_file(), run.config.is_file()
        (True, True)
        >>> run.read_summary()["method"]
        'gaussians'
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.json"
        self.metrics = self.path / "metrics.csv"
        self.checkpoint = self.path / "checkpoint.pt"
        self.earlier_checkpoint = self.path / "checkpoint_before.pt"
        self.object = self.path / "object.h5"
        self.light = self.path / "light.h5"
        self.guess = self.path / "guess.h5"
        self.rest = self.path / "rest.vtp"
        self.summary = self.path / "summary.json"
        self.source = self.path / "source.json"
        self.report = self.path / "report.html"
        self._columns: list[str] = []

    def _repr_html_(self) -> str:
        """What Jupyter shows: the folder, what its summary says, and the object; of a run that is not finished, so."""
        rows = {"folder": str(self.path)}
        if not (self.config.is_file() and self.result().is_file()):
            return card("RunFolder", rows | {"state": "begun" if self.config.is_file() else "empty"})
        summary = self.read_summary()
        rows |= {name: str(summary[name]) for name in ("method", "kind", "finished") if name in summary}
        from ..io.objects import read_object

        return card("RunFolder", rows | {"report": str(self.report)}) + "<br/>" + of_object(read_object(self.result()))

    def require_new(self, advise_resume: bool = False) -> None:
        """`InputError` if something is there already; the message may point to --resume."""
        require_new(self.path, f"choose another --out{', or add --resume' if advise_resume else ''}")

    def require_run(self) -> None:
        """`InputError` unless the folder holds a reconstruction."""
        require(self.path.is_dir(), f"the run folder {self.path} does not exist; check the path.")
        found = self.config.is_file() and self.result().is_file()
        hint = "; it was cut off, finish it with --resume" if self.config.is_file() else ""
        if (self.path / SERIES).is_file():
            run = min(self.path.glob("tasks/*/*/config.json"), default=None)
            named = f"as {run.parent.relative_to(self.path).as_posix()}: name one" if run else "but none has begun"
            hint = f"; it is a series, whose run folders are in tasks/, {named}"
        require(found, f"{self.path} must hold a reconstruction (config.json, object.h5), but it does not{hint}.")

    def result(self) -> Path:
        """The file of the reconstructed object; a run of version 0.1 has it under another name."""
        older = self.path / "gaussians.h5"
        return older if older.is_file() and not self.object.is_file() else self.object

    def begin(self, config: dict[str, Any]) -> None:
        """Make the folder with its config.json, and with it a new run, whose name checkpoint and summary repeat."""
        self.path.mkdir(exist_ok=True)
        write_json(self.config, {RUN: secrets.token_hex(8), **config})

    def write_summary(self, values: dict[str, Any]) -> None:
        """Replace summary.json, with the marks of the run and the SHA-256 of its object, which is written before."""
        summed = {OBJECT_SUM: sha256(self.object)} if self.object.is_file() else {}
        write_json(self.summary, values | self.marks() | summed)

    def write_source(self, values: dict[str, object]) -> None:
        """Replace source.json, which says where the frames of the run are."""
        write_json(self.source, values | self.marks())

    def read_result(self) -> Stored:
        """The object; `InputError` if it is not that of summary.json, which is written after it."""
        from ..io.objects import read_object

        found, said = read_object(self.result()), self.read_summary().get(OBJECT_SUM)
        require(
            said is None or not self.object.is_file() or said == sha256(self.object),
            f"{self.object} must be what {self.summary.name} says was written, but it is another file; bring back the "
            "whole folder, or go on with --resume.",
        )
        self.require_own(self.object)
        return found

    def require_own(self, path: Path) -> None:
        """`InputError` if an HDF5 file of this folder says that it is of another run, or of other settings."""
        if path.is_file():
            require_bound(path, read_marks(path, (RUN, CONFIG_SUM)), self._own(), self.config)

    def read_summary(self) -> dict[str, Any]:
        """What summary.json holds; `InputError` if it is of another run than config.json, or of other settings."""
        summary = _with_tables(
            self.summary, ("timing_s", "detector", "material", "verdict", "total", "geometry", "rehearsal")
        )
        require_bound(self.summary, summary, self._own(), self.config)
        return summary

    def name(self) -> str:
        """The name of the run, empty before it has begun and of older versions."""
        return self._own()[RUN]

    def marks(self) -> dict[str, str]:
        """What files of this run say of it: its name, and the hash of what it was started with (`config_sum`); nothing
        before it has begun, and of older versions."""
        own = self._own()
        return own if own[RUN] else {}

    def _own(self) -> dict[str, str]:
        config = self.read_config() if self.config.is_file() else {}
        return {RUN: str(config.get(RUN, "")), CONFIG_SUM: config_sum(config)}

    def read_config(self) -> dict[str, Any]:
        """What config.json holds; `InputError` if a part of it is not what it was."""
        return _with_tables(self.config, ("method", "prior", "light", "uncertain", "decided", "resolved"))

    def is_of(self, fingerprint: str) -> bool:
        """Whether a scan (`provenance.scan_hash`) is the one that was reconstructed, as it came or with the constants
        that were found."""
        config = self.read_config()
        return fingerprint in (config.get("scan_hash"), config.get("decided", {}).get("scan_hash"))

    def source_scan(self) -> Path:
        """The scan file that was reconstructed; `InputError` if it is not known, or no longer there."""
        require(self.source.is_file(), f"{self.path} does not say which scan it is of; name it with --scan.")
        path = Path(str(read_json(self.source).get("scan") or "nowhere"))
        require(path.exists(), f"the scan {path} of this run is no longer there; name it with --scan.")
        return path

    def start_metrics(self, columns: Iterable[str], keep_until: int = 0) -> None:
        """Begin metrics.csv, or cut it back to the rows up to step `keep_until`."""
        self._columns = list(columns)
        rows = self.read_rows() if keep_until and self.metrics.exists() else []
        with atomic_path(self.metrics) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(row for row in rows if float(row["step"]) <= keep_until)

    def set_aside_metrics(self, stage: int) -> None:
        """Keep the metrics of an earlier `stage` (0 is the first) as metrics_STAGE.csv; the next one begins its own."""
        if self.metrics.is_file():
            self.metrics.replace(self.path / f"metrics_{stage}.csv")

    def append_metrics(self, records: list[dict[str, float]]) -> None:
        """Add rows to metrics.csv."""
        with self.metrics.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="", extrasaction="ignore")
            writer.writerows({k: f"{v:.7g}" for k, v in record.items()} for record in records)

    def read_rows(self) -> list[dict[str, str]]:
        """The rows of metrics.csv as text, without those that a killed process left half-written."""
        require_regular(self.metrics, "the rows of a fit")
        with self.metrics.open(newline="", encoding="utf-8", errors="replace") as file:
            reader = csv.DictReader(line for line in file if line.endswith("\n") and "\0" not in line)
            return [row for row in reader if _is_whole(row)]

    def history(self) -> dict[str, np.ndarray]:
        """The columns of metrics.csv as float64 (NaN where a row has no entry); empty if there is no file."""
        rows = self.read_rows() if self.metrics.is_file() else []
        names = rows[0].keys() if rows else ()
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace checkpoint.pt; the one before is kept beside it."""
        write_state(self.checkpoint, self.marks() | {"state": _in_main_memory(state)}, self.earlier_checkpoint)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint, or the one before if that is damaged or not there; None if there is none.

        Errors: `InputError` if none of them can be read, or one is of another run, or of other settings.
        """
        damaged = False
        for path in (self.checkpoint, self.earlier_checkpoint):
            if not path.is_file():
                continue
            found = checkpoint_state(path)
            if found is None:
                damaged = True
                continue
            require_bound(path, found, self._own(), self.config)
            state = found.get("state", found)
            with as_written(path, "a checkpoint"):
                require(isinstance(state, dict), "its state is no table.")
                require_plausible(state, others=False)
            return state
        require(not damaged, f"{self.checkpoint} must be a checkpoint, but it is damaged; start anew without it.")
        return None


@contextmanager
def claimed(folder: RunFolder | None) -> Iterator[None]:
    """Make the folder, if need be, and keep other processes from writing to it (`sole_writer`); in the end its manifest
    is of what was written. Nothing without a folder."""
    if folder is None:
        yield
        return
    require_parent(folder.path)
    if folder.path.exists() and not folder.path.is_dir():
        folder.require_new()
    with sole_writer(folder.path):
        yield
        if folder.config.is_file():
            write_manifest(folder.path, folder.name())


def _with_tables(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """The table of a file of ours, whose entries `names` are tables where they are there."""
    found = read_json(path)
    for name in names:
        good = isinstance(found.get(name, {}), dict) or (name == "geometry" and found[name] is None)
        require(good, f"{path} must be as it was written, but {name} is no table in it; bring back the whole file.")
    return found


def checkpoint_state(path: Path) -> dict[str, Any] | None:
    """What a checkpoint holds; None if it is damaged, by the checksums of its parts or else."""
    import torch

    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is not None:
                return None
        found = torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception:  # zipfile and torch raise many kinds for damaged files
        return None
    return found if isinstance(found, dict) else None


def _is_whole(row: dict[str, Any]) -> bool:
    """Whether a row has a number, or nothing, in each column."""
    try:
        return all(text is not None and float(text or "nan") is not None for text in row.values())
    except (TypeError, ValueError):
        return False


def _in_main_memory(state: Any) -> Any:
    """The same dictionaries, lists and tuples with tensors in main memory, for machines without the device."""
    import torch

    if isinstance(state, torch.Tensor):
        return state.cpu()
    if isinstance(state, dict):
        return {name: _in_main_memory(value) for name, value in state.items()}
    return type(state)(map(_in_main_memory, state)) if isinstance(state, (list, tuple)) else state


def check(path: Path) -> tuple[int, list[str]]:
    """How many files there are at `path`, an HDF5 file or a folder, and what is wrong, a sentence each.

    A run folder is compared with its manifest; values of HDF5 files are read, which verifies their checksums where they
    have any. Errors: `InputError` where there is nothing that could be checked.
    """
    require(path.exists(), f"{path} must be a file or a folder, but there is nothing; check the path.")
    if path.is_file():
        return 1, _faults_of_values(path)
    run = RunFolder(path)
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and h5py.is_hdf5(file)]
    wrong = faults(path, run.name()) if run.config.is_file() or (path / MANIFEST).is_file() else []
    require(bool(files) or run.config.is_file(), f"{path} must hold a run or HDF5 files, but it holds none.")
    return len(files), wrong + [fault for file in files for fault in _faults_of_values(file)]


def _faults_of_values(path: Path) -> list[str]:
    """What is wrong with an HDF5 file, if anything is."""
    try:
        with open_hdf5(path) as file:
            file.visititems(_read)
    except InputError as error:
        return [str(error)]
    return []


def _read(name: str, item: h5py.Group | h5py.Dataset) -> None:
    """Read all values of a dataset, a part at a time."""
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        return
    if item.ndim == 0:
        item[()]
        return
    step = item.chunks[0] if item.chunks else ROWS
    for start in range(0, item.shape[0], step):
        item[start : start + step]


OBJECT = "object."
"""How the names of an object's parameters begin in a fit."""


@dataclass(frozen=True)
class RunStatus:
    """stage: its name, empty before the first; step, loss: the last that are kept; object: None until there is one."""

    stage: str
    step: int | None = None
    loss: float | None = None
    object: Stored | None = None

    def lines(self) -> list[str]:
        """The same in words."""
        if not self.stage:
            return ["nothing is kept yet"]
        numbers = [] if self.step is None else [f"step {self.step}"]
        numbers += [] if self.loss is None else [f"loss {self.loss:.4g}"]
        return [f"stage: {self.stage}", *([", ".join(numbers)] if numbers else [])]


def fitted_by(folder: RunFolder) -> Writer | None:
    """The process that fits the run in `folder`; None where nobody writes there, or the run has ended."""
    writer = writer_of(folder.path)
    if writer is None or writer.gone or not folder.config.is_file():
        return None
    ended = folder.summary.is_file() and bool(folder.read_summary().get("finished"))
    return None if ended else writer


def read_status(folder: RunFolder) -> RunStatus:
    """The status of the run; `InputError` for files that are damaged, or of another run."""
    state = folder.load_checkpoint()
    if state is None:
        return RunStatus("")
    with as_written(folder.checkpoint, "a checkpoint of this run"):
        if "start" in state:  # of `reconstruct`, whose records are in metrics.csv
            stages, history = list(folder.read_config().get("resolved", {})), folder.history()
            record = {name: float(column[-1]) for name, column in history.items() if len(column)}
            stage = stages[-1] if stages else "fit"
        else:  # of matter or bodies in motion, which keep theirs beside the state
            records = state.get("records") or [{}]
            record, stage = records[-1], str(state.get("next") or f"{state.get('steps')} steps are done")
        step, loss = record.get("step"), record.get("loss")
        return RunStatus(stage, None if step is None else int(step), loss, _object_of(state))


def _object_of(state: Mapping[str, Any]) -> Stored | None:
    """The object of a checkpoint as its fit has made it; None where none is kept."""
    from ..representations import KINDS, MovingSurfaces, VoxelGrid  # which load torch

    fit = state.get("fit") or {}
    if "volume" in fit:
        return VoxelGrid.from_state(fit["volume"])
    if "start" in state:
        begun = KINDS[state["start"]["kind"]].from_state(state["start"]["state"])
    elif state.get("bodies") is not None:
        begun = MovingSurfaces.from_state(state["bodies"])
    else:
        return None
    free = fit.get("trainable", {}).get("parameters", {})
    fitted = {name.removeprefix(OBJECT): value for name, value in free.items() if name.startswith(OBJECT)}
    return begun.with_parameters(fitted) if fitted and fitted.keys() <= begun.parameters().keys() else begun
