"""A run is a folder: config.json, metrics.csv, checkpoint.pt, gaussians.h5, summary.json, source.json, report.html."""

from __future__ import annotations

import csv
import hashlib
import os
import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from .. import __version__
from ..backends import device_name
from ..checks import InputError, require
from ..io.atomic import atomic_path
from ..io.hdf5 import Fields, attribute_numbers, open_hdf5
from ..io.json import read_json
from ..representations.gaussians import PARAMETERS, GaussianCloud
from ..scan import Scan

FORMAT = "holosplat Gaussians 1"


class RunFolder:
    """The files of one reconstruction. Every file is replaced as a whole; metrics.csv only grows."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.json"
        self.metrics = self.path / "metrics.csv"
        self.checkpoint = self.path / "checkpoint.pt"
        self.gaussians = self.path / "gaussians.h5"
        self.summary = self.path / "summary.json"
        self.source = self.path / "source.json"
        self.report = self.path / "report.html"
        self._columns: list[str] = []

    def require_new(self, advise_resume: bool = False) -> None:
        """`InputError` if something is there already; the message may point to --resume."""
        taken = self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir()))
        way_out = "choose another, or add --resume" if advise_resume else "choose another"
        require(not taken, f"the run folder (--out) must be new or empty, but {self.path} holds files; {way_out}.")
        parent = self.path.resolve().parent
        require(parent.is_dir(), f"--out must lie in an existing folder, but {parent} is none; create it.")

    def require_run(self) -> None:
        """`InputError` unless the folder holds a reconstruction."""
        require(self.path.is_dir(), f"the run folder {self.path} does not exist; check the path.")
        found = self.config.is_file() and self.gaussians.is_file()
        hint = "; it was cut off, finish it with reconstruct --resume" if self.checkpoint.is_file() else ""
        require(found, f"{self.path} must hold a reconstruction (config.json, gaussians.h5), but it does not{hint}.")

    def create(self) -> None:
        """Make the folder."""
        self.path.mkdir(exist_ok=True)

    def read_config(self) -> dict[str, Any]:
        """What config.json holds."""
        return read_json(self.config)

    def source_scan(self) -> Path:
        """The scan file that was reconstructed; `InputError` if it is not known, or no longer there."""
        require(self.source.is_file(), f"{self.path} does not say which scan it is of; name it with --scan.")
        path = Path(str(read_json(self.source).get("scan", "")))
        require(path.is_file(), f"the scan {path} of this run is no longer there; name it with --scan.")
        return path

    def start_metrics(self, columns: Iterable[str], keep_until: int = 0) -> None:
        """Begin metrics.csv, or cut it back to the rows up to step `keep_until`."""
        self._columns = list(columns)
        rows = self.read_rows() if keep_until and self.metrics.exists() else []
        with atomic_path(self.metrics) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(row for row in rows if float(row["step"]) <= keep_until)

    def append_metrics(self, records: list[dict[str, float]]) -> None:
        """Add rows to metrics.csv."""
        with self.metrics.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="", extrasaction="ignore")
            writer.writerows({k: f"{v:.7g}" for k, v in record.items()} for record in records)

    def read_rows(self) -> list[dict[str, str]]:
        """The rows of metrics.csv as text."""
        with self.metrics.open(newline="") as file:
            return list(csv.DictReader(file))

    def history(self) -> dict[str, np.ndarray]:
        """The columns of metrics.csv as float64 (NaN where a row has no entry); empty if there is no file."""
        rows = self.read_rows() if self.metrics.is_file() else []
        names = rows[0].keys() if rows else ()
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace checkpoint.pt."""
        with atomic_path(self.checkpoint) as temporary:
            torch.save(state, temporary)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint, or None; `InputError` if it cannot be read."""
        if not self.checkpoint.is_file():
            return None
        try:
            return torch.load(self.checkpoint, map_location="cpu", weights_only=True)
        except Exception as error:  # torch raises many kinds for damaged files
            raise InputError(
                f"{self.checkpoint} must be a checkpoint, but it is damaged; start anew without it."
            ) from error


def write_gaussians(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud: its parameters (float32, as the class documents them), `unit_length` [m] and its materials."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            format=FORMAT,
            unit_length=cloud.unit_length,
            unit_length_units="m",
            delta=cloud.delta,
            beta=cloud.beta,
        )
        if cloud.second is not None:
            file.attrs["second"] = cloud.second
        for name, parameter in zip(PARAMETERS, cloud.parameters):
            file[name] = parameter.detach().numpy()


def read_gaussians(path: Path) -> GaussianCloud:
    """The cloud that `write_gaussians` wrote; `InputError` if the file is damaged or no such file."""
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        arrays = [fields.numbers(fields.need(name)).astype(np.float32) for name in PARAMETERS]
        unit, delta, beta = (
            float(attribute_numbers(f"{path}: @{name}", file.attrs.get(name), (1,))[0])
            for name in ("unit_length", "delta", "beta")
        )
        other = file.attrs.get("second")
        second = None if other is None else attribute_numbers(f"{path}: @second", other, (2,))
    return GaussianCloud(
        [torch.from_numpy(a) for a in arrays], unit, delta, beta, None if second is None else (second[0], second[1])
    )


def scan_hash(scan: Scan) -> str:
    """A short fingerprint (SHA-256) of the frames and how they were taken."""
    digest = hashlib.sha256()
    exposures = scan.exposures
    parts = (
        scan.frames,
        scan.is_test,
        scan.views.rotations,
        scan.views.shifts,
        exposures.distance,
        exposures.psf_sigma_px,
        exposures.time,
    )
    for array in parts:
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr((scan.views.pixel_size, exposures.energy_kev)).encode())
    return digest.hexdigest()[:16]


def environment(backend: str) -> dict[str, dict[str, str]]:
    """Versions and machine, for config.json; `backend` is the one that fits."""
    return {
        "versions": {
            "holosplat": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
        "machine": {
            "system": platform.platform(),
            "processor": _processor(),
            "threads": f"{torch.get_num_threads()} of {os.cpu_count()} cores",
            "backend": backend,
            "device": device_name(backend),
        },
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
