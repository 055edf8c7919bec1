"""Scans of every format that the project knows: `read` recognises the format by the content of a path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from ..checks import InputError, require
from ..scan import Scan
from . import nerf_synthetic, nxtomo, r2_gaussian, run_scan, tiff
from .loader import Loader

ScanFormat = Literal["nxtomo", "nerf-synthetic", "tiff", "r2-gaussian"]
"""Formats that scans are written in."""

LOADERS: tuple[Loader, ...] = (
    nxtomo.LOADER,
    tiff.LOADER,
    nerf_synthetic.LOADER,
    r2_gaussian.LOADER,
    run_scan.loader(lambda path: read(path)),
)
"""Every format that scans are read from; a new one is a file and a line here (docs/adding.md)."""


def read(path: str | Path, given: Mapping[str, float] | None = None) -> Scan:
    """The scan at `path`, a file or folder of any format in `LOADERS`.

    given: values that folders of other programs lack, by name (`Loader.takes`): energy_kev [keV], distance [m],
    pixel_size [m], black and white [relative intensity]. Errors: `InputError` for a path that does not exist, holds no
    known scan or a damaged one, and for `given` values that do not belong to its format.
    """
    loader, given = loader_of(path), given or {}
    stray = [name for name in given if name not in loader.takes]
    require(not stray, f"{', '.join(stray)}: not for a source in {loader.name}; leave it away.")
    return loader.read(Path(path), given)


def loader_of(path: str | Path) -> Loader:
    """The loader of `path`; `InputError` if none or more than one recognises it."""
    found = Path(path)
    require(found.exists(), f"{path} must be a scan, but there is no such file or folder; check the path.")
    loaders = [loader for loader in LOADERS if loader.recognises(found)]
    if len(loaders) == 1:
        return loaders[0]
    if loaders:
        kinds = " and ".join(loader.name for loader in loaders)
        raise InputError(f"{path} must be a scan of one format, but it is ambiguous: {kinds}; keep the files of one.")
    known = "; ".join(f"{loader.mark} ({loader.name})" for loader in LOADERS)
    raise InputError(f"{path} must be a scan, but it is none of what is known: {known}.")
