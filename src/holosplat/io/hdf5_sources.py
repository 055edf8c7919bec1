"""Files whose values an HDF5 file brings: where HDF5 looks for them, and what is asked of each."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from h5py import h5p  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import require, require_regular
from .guard import require_declared

LINKS, VIRTUAL, EXTERNAL = "HDF5_EXT_PREFIX", "HDF5_VDS_PREFIX", "HDF5_EXTFILE_PREFIX"
"""Variables of the environment that name folders in which HDF5 looks first."""
SERIES = re.compile(r"%\d*b")
"""Within the name of a virtual dataset's source: the number of a block."""


def linked(path: Path, label: str, name: bytes) -> list[Path]:
    """The files that a link of the file `path` to a file `name` may lead to; `InputError` where there is none, or it is
    no regular file."""
    return _required(path, label, [os.fsdecode(name)], LINKS)


def virtual_sources(path: Path, label: str, plan: h5p.PropDCID, declared: int) -> list[Path]:
    """The files of which a virtual dataset of `declared` bytes is put together, apart from `path` itself."""
    names = dict.fromkeys(plan.get_virtual_filename(number) for number in range(plan.get_virtual_count()))
    found = _required(path, label, [name for name in names if name != "."], VIRTUAL)
    held = sum(place.stat().st_size for place in found) + path.stat().st_size
    require_declared(label, declared, held)
    return found


def virtual_places(path: Path, name: str) -> list[Path]:
    """The files that HDF5 may open for the source `name` of a virtual dataset of the file `path`."""
    return [place for place in _places(path, name, VIRTUAL) if place.is_file()]


def require_external(path: Path, label: str, plan: h5p.PropDCID, declared: int) -> None:
    """`InputError` unless the files of a dataset with external storage are regular, and hold what it declares."""
    parts = [plan.get_external(number) for number in range(plan.get_external_count())]
    held = 0
    for name, offset, size in parts:
        (first, *_) = _required(path, label, [os.fsdecode(name)], EXTERNAL)
        held += max(0, min(size, first.stat().st_size - offset))
    require(
        declared <= held,
        f"{label} declares {declared:.3g} bytes of values, but the files beside it hold {held:.3g}; they are cut "
        "short, or it is no honest file.",
    )


def _required(path: Path, label: str, names: list[str], prefix: str) -> list[Path]:
    """All places of files that HDF5 may open for `names`, each a regular file; one at least for each name."""
    found: list[Path] = []
    for name in names:
        places = [place for place in _places(path, name, prefix) if os.path.lexists(place)]
        require(
            bool(places) or SERIES.search(name) is not None,
            f"{label} has its values in {name}, which is neither there nor beside it; bring both.",
        )
        for place in places:
            require_regular(place, f"a file with the values of {label}")
        found += places
    return found


def _places(path: Path, name: str, prefix: str) -> Iterator[Path]:
    """Where HDF5 looks for the file `name` of `path`: as it is named, in folders of the environment, beside `path`, and
    beside what `path` is a link to (`H5F_prefix_open_file`)."""
    given, short = Path(name), Path(Path(name).name)
    below = short if given.is_absolute() else given
    folders = [Path(part) for part in os.environ.get(prefix, "").split(os.pathsep) if part]
    for place in (given, *(folder / below for folder in (*folders, path.parent, path.resolve().parent))):
        if SERIES.search(place.name):
            like = re.compile(r"\d+".join(re.escape(part.replace("%%", "%")) for part in SERIES.split(place.name)))
            yield from (one for one in sorted(place.parent.glob("*")) if like.fullmatch(one.name))
        else:
            yield place
