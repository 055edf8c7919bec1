"""Filters of HDF5 that are plugins (bitshuffle, blosc, lz4 and others): loaded where hdf5plugin is installed."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
from h5py import h5p, h5z  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

PLUGINS = "hdf5plugin"


def unknown_filters(plan: h5p.PropDCID) -> dict[int, str]:
    """Number and name of the filters of a dataset that HDF5 cannot undo, even with the plugins, if they are there."""
    filters = [plan.get_filter(number) for number in range(plan.get_nfilters())]
    unknown = {code: name.decode(errors="replace") for code, _, _, name in filters if not h5z.filter_avail(code)}
    if unknown:
        with suppress(ImportError):
            import_module(PLUGINS)  # which registers its filters
    return {code: name for code, name in unknown.items() if not h5z.filter_avail(code)}


def filters_missing_in(path: Path) -> str:
    """The filters in a file that HDF5 cannot undo, in words; empty if there are none, or it cannot be opened."""
    found: dict[int, str] = {}

    def look(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found.update(unknown_filters(item.id.get_create_plist()))

    with suppress(OSError, RuntimeError), h5py.File(path, "r") as file:
        file.visititems(look)
    return ", ".join(f"{name.split(';')[0] or 'unnamed'} (number {code})" for code, name in found.items())
