"""`holosplat check`: whether files are as they were written."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from ..checks import InputError
from ..workflows.check import check as look


def check(path: Positional[Path]) -> None:
    """Say whether a run folder or an HDF5 file is as it was written, by manifest and checksums.

    Args:
        path: Run folder, another folder with HDF5 files, or one such file.
    """
    count, wrong = look(path)
    if wrong:
        raise InputError("; ".join(wrong) + ".")
    print(f"{path} is as it was written: {count} HDF5 file{'s' if count != 1 else ''} read to the end")
