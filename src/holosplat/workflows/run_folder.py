"""A run is a folder: config.json, metrics.csv, checkpoint.pt, object.h5, summary.json, source.json, report.html."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..checks import InputError, require
from ..io.atomic import atomic_path
from ..io.folder import require_new
from ..io.json import read_json


class RunFolder:
    """The files of one reconstruction. Every file is replaced as a whole; metrics.csv only grows."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.json"
        self.metrics = self.path / "metrics.csv"
        self.checkpoint = self.path / "checkpoint.pt"
        self.object = self.path / "object.h5"
        self.light = self.path / "light.h5"
        self.summary = self.path / "summary.json"
        self.source = self.path / "source.json"
        self.report = self.path / "report.html"
        self._columns: list[str] = []

    def require_new(self, advise_resume: bool = False) -> None:
        """`InputError` if something is there already; the message may point to --resume."""
        require_new(self.path, f"choose another --out{', or add --resume' if advise_resume else ''}")

    def require_run(self) -> None:
        """`InputError` unless the folder holds a reconstruction."""
        require(self.path.is_dir(), f"the run folder {self.path} does not exist; check the path.")
        found = self.config.is_file() and self.result().is_file()
        hint = "; it was cut off, finish it with --resume" if self.checkpoint.is_file() else ""
        require(found, f"{self.path} must hold a reconstruction (config.json, object.h5), but it does not{hint}.")

    def result(self) -> Path:
        """The file of the reconstructed object; a run of version 0.1 has it under another name."""
        older = self.path / "gaussians.h5"
        return older if older.is_file() and not self.object.is_file() else self.object

    def create(self) -> None:
        """Make the folder."""
        self.path.mkdir(exist_ok=True)

    def read_config(self) -> dict[str, Any]:
        """What config.json holds."""
        return read_json(self.config)

    def is_of(self, fingerprint: str) -> bool:
        """Whether a scan (`provenance.scan_hash`) is the one that was reconstructed, as it came or with the constants
        that were found."""
        config = self.read_config()
        return fingerprint in (config.get("scan_hash"), config.get("decided", {}).get("scan_hash"))

    def source_scan(self) -> Path:
        """The scan file that was reconstructed; `InputError` if it is not known, or no longer there."""
        require(self.source.is_file(), f"{self.path} does not say which scan it is of; name it with --scan.")
        path = Path(str(read_json(self.source).get("scan", "")))
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
