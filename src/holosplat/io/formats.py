"""Which format a path holds, told from its content."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import h5py

from ..checks import InputError, require
from . import nerf_synthetic, r2_gaussian, tiff

ScanFormat = Literal["nxtomo", "nerf-synthetic", "tiff", "r2-gaussian"]

MARKS: dict[str, ScanFormat] = {
    nerf_synthetic.TRAIN: "nerf-synthetic",
    tiff.SCAN: "tiff",
    r2_gaussian.META: "r2-gaussian",
}
"""The file that makes a folder one of a format."""


def format_of(path: str | Path) -> ScanFormat:
    """The format of `path`: NXtomo is an HDF5 file, the others are folders with a file of a certain name."""
    found = Path(path)
    require(found.exists(), f"{path} must be a scan, but there is no such file or folder; check the path.")
    marks = ", ".join(f"{name} ({kind})" for name, kind in MARKS.items())
    if found.is_file():
        require(
            h5py.is_hdf5(found), f"{path} must be an HDF5 file (nxtomo), or a folder with {marks}, but it is neither."
        )
        return "nxtomo"
    kinds: list[ScanFormat] = [kind for name, kind in MARKS.items() if (found / name).is_file()]
    if len(kinds) != 1:
        what = f"it is ambiguous, with those of {' and '.join(kinds)}" if kinds else "it holds none of them"
        raise InputError(f"{path} must hold one of the files {marks}, but {what}.")
    return kinds[0]
