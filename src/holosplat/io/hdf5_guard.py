"""HDF5 files that nobody vouches for: they bring their own values, not those of other files, and no more than they are.

A link, a virtual dataset or external storage can make a reader copy any file of this machine into what it writes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
from h5py import h5d, h5l, h5o  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, require
from .guard import DEEPEST, require_declared

MOST = 200_000
"""Links in a file, at most: larger ones are no scans, and take minutes to look through."""
_vouched: set[Path] = set()


def allow_external(path: Path) -> None:
    """From now on `path`, or the files below it, may bring values of other files (`--allow-external`)."""
    _vouched.add(path.resolve())


def require_own(file: h5py.File, path: Path) -> None:
    """`InputError` if an open file at `path` refers to other files, is nested too deeply, or declares more values than
    it can hold."""
    size, own = path.stat().st_size, not _is_vouched(path)
    for name, kind in _links(file, path):
        require(name.count(b"/") < DEEPEST, f"{path} must not be nested more than {DEEPEST} deep, but it is.")
        if kind == h5l.TYPE_EXTERNAL:
            require(not own, _refers(path, name, "is a link to another file"))
            continue
        if kind != h5l.TYPE_HARD or h5o.get_info(file.id, name).type != h5o.TYPE_DATASET:
            continue
        dataset = h5d.open(file.id, name)
        plan = dataset.get_create_plist()
        virtual = plan.get_layout() == h5d.VIRTUAL
        if virtual or plan.get_external_count() > 0:
            require(not own, _refers(path, name, "has its values in another file"))
            continue
        declared = dataset.get_type().get_size()
        for length in dataset.shape:
            declared *= length
        require_declared(f"{path}: /{name.decode(errors='replace')}", declared, size)


def _is_vouched(path: Path) -> bool:
    whole = path.resolve()
    return any(whole == known or known in whole.parents for known in _vouched)


def _refers(path: Path, name: bytes, what: str) -> str:
    return (
        f"{path} must hold its own values, but /{name.decode(errors='replace')} {what}; if you trust both, add "
        "--allow-external."
    )


def _links(file: h5py.File, path: Path) -> Iterator[tuple[bytes, int]]:
    """Names and kinds of all links in a file; links are not followed."""
    found: list[tuple[bytes, int]] = []

    def take(name: bytes, info: h5l.LinkInfo) -> bool | None:
        found.append((name, info.type))
        return True if len(found) > MOST else None

    file.id.links.visit(take, info=True)
    if len(found) > MOST:
        raise InputError(f"{path} must hold at most {MOST} entries, but it holds more.")
    return iter(found)
