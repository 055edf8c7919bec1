"""The folder of a study: study.json, and the files of each configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from holosplat.checks import as_written, require
from holosplat.io.atomic import atomic_path, read_json, require_new, write_json, write_rows, write_state
from holosplat.io.guard import read_archive
from holosplat.tables import read_rows
from holosplat.workflows.run_folder import checkpoint_state

from .configurations import EVERY

CURVES = (
    *("step", "seconds", "count"),
    *(f"{split}_{score}" for split in ("test", "train") for score in ("ssim", "frcm", "psnr", "l1")),
    *("loss", "dice", "relative_error_delta", "mean_delta", "mean_beta", "ratio", "own_ratio", "median_own_ratio"),
)
"""Columns of a configuration's curves: δ, β and their ratio are means inside the true cells, weighted by true matter;
own_ratio is the mean of the Gaussians' own δ/β, which the thesis plots; loss is that of the last step."""
SAME = ("case", "physics", "pace", "seed", "scan_hash")
"""What a study must have in common with the one that its folder was begun for."""

Look = Mapping[str, float]


class StudyFolder:
    """study.json, and of each configuration NAME.config.json, NAME.curves.csv, NAME.maps.npz and NAME.row.json, and
    while it runs NAME.checkpoint.pt.

    The row is written last: where there is one, the configuration is finished.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.about = self.path / "study.json"

    def begin(self, about: Mapping[str, Any]) -> None:
        """Make the folder, or go on in it; `InputError` if it is something else's, or another study's."""
        if self.about.is_file():
            old = read_json(self.about)
            for key in SAME:
                same = old.get(key) == about[key]
                require(same, f"the study in {self.path} has another {key.replace('_', ' ')}; choose another --out.")
            return
        require_new(self.path, "choose another --out, or a study to go on with")
        self.path.mkdir(exist_ok=True)
        write_json(self.about, dict(about))

    def finished(self, name: str) -> bool:
        """Whether the configuration `name` is done."""
        return self._file(name, "row.json").is_file()

    def write_config(self, name: str, values: dict[str, Any]) -> None:
        """NAME.config.json."""
        write_json(self._file(name, "config.json"), values)

    def write_row(self, name: str, values: dict[str, Any]) -> None:
        """NAME.row.json: the configuration is done, and its checkpoint goes."""
        write_json(self._file(name, "row.json"), values)
        self._file(name, "checkpoint.pt").unlink(missing_ok=True)

    def write_curves(self, name: str, looks: Sequence[Look]) -> None:
        """NAME.curves.csv, of everything seen so far."""
        rows = ([f"{look[key]:.6g}" for key in CURVES] for look in looks)
        write_rows(self._file(name, "curves.csv"), CURVES, rows)

    def curves(self, name: str) -> dict[str, np.ndarray]:
        """The columns of NAME.curves.csv, float64."""
        path = self._file(name, "curves.csv")
        with as_written(path, "the curves of a study"):
            rows = read_rows(path, "the curves of a study")
            return {key: np.array([float(row[key]) for row in rows]) for key in CURVES}

    def write_maps(self, name: str, maps: Mapping[str, np.ndarray]) -> None:
        """NAME.maps.npz: what `looks.maps` makes."""
        with atomic_path(self._file(name, "maps.npz")) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **maps)

    def maps(self, name: str) -> dict[str, np.ndarray]:
        """What NAME.maps.npz holds; empty where there is none."""
        path = self._file(name, "maps.npz")
        if not path.is_file():
            return {}
        return read_archive(path, what="the maps of a study")

    def save_checkpoint(self, name: str, state: dict[str, Any]) -> None:
        """NAME.checkpoint.pt."""
        write_state(self._file(name, "checkpoint.pt"), state)

    def load_checkpoint(self, name: str) -> dict[str, Any] | None:
        """What NAME.checkpoint.pt holds; None where there is none, or it is damaged: the configuration starts anew."""
        path = self._file(name, "checkpoint.pt")
        return checkpoint_state(path) if path.is_file() else None

    def row(self, name: str) -> dict[str, Any]:
        """What NAME.row.json holds."""
        return read_json(self._file(name, "row.json"))

    def _file(self, name: str, kind: str) -> Path:
        return self.path / f"{name}.{kind}"


@dataclass(frozen=True)
class Study:
    """A study as far as it is done: what study.json says, and rows, curves and maps by configuration.

    rows: what NAME.row.json holds; curves: columns `CURVES` [looks]; maps: what `looks.maps` makes.
    """

    about: dict[str, Any]
    rows: dict[str, dict[str, Any]]
    curves: dict[str, dict[str, np.ndarray]]
    maps: dict[str, dict[str, np.ndarray]]


def load_study(folder: StudyFolder) -> Study:
    """All finished configurations of `folder`; `InputError` if there is none."""
    names = [c.name for c in EVERY if folder.finished(c.name)]
    require(len(names) > 0, f"{folder.path} must hold a finished configuration of the study, but it holds none.")
    rows, curves, maps = ({n: read(n) for n in names} for read in (folder.row, folder.curves, folder.maps))
    return Study(read_json(folder.about), rows, curves, maps)
