"""Input that nobody vouches for: it declares no more than it can hold."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import LONGEST as SAID
from ..checks import InputError, require, require_regular
from .room import machine_memory

RATIO = 1100
"""Declared bytes over those of a file, at most: deflate, the densest that readers know, makes zeros 1032 times smaller.
"""
SMALL = 1 << 26
"""Bytes that any file may declare."""
DEEPEST = 64
"""Levels of nested elements, groups or tables, at most."""
TAG = re.compile(rb"<(/?)([A-Za-z!?][^\s>/]*)[^>]*?(/?)>")
COUNT = re.compile(rb"\b(NumberOf\w+)\s*=\s*[\"']\s*(\d+)\s*[\"']")
MOST_COMPONENTS = 1000
"""Numbers of a point or cell in an array of VTK."""
LONGEST = 18
"""Digits of a count, at most."""
APPENDED = b"<AppendedData"


def require_declared(label: str, declared: int, held: int) -> None:
    """`InputError` if a file declares more bytes than the `held` ones can be packed into."""
    require(
        declared <= max(SMALL, RATIO * held),
        f"{label} declares {declared:.3g} bytes of values, but holds {held:.3g}; it is damaged, or no honest file.",
    )


def require_memory(label: str, size: int) -> None:
    """`InputError` if `size` bytes are more than the memory of this machine."""
    whole = machine_memory()
    require(
        size <= whole,
        f"{label} takes {size / 1e9:.3g} GB, but this machine has {whole / 1e9:.3g} GB of memory for it; "
        "take a part of it.",
    )


def require_inflated(label: str, packed: bytes, most: int) -> None:
    """`InputError` if deflated bytes become more than `most`, which unpackers other than this one would find out in
    memory. What is no deflate is left to them."""
    try:
        inflated = len(zlib.decompressobj().decompress(packed, most + 1))
    except zlib.error:
        return
    require(inflated <= most, f"{label} unpacks to more than the {most} bytes that it declares; it is no honest file.")


def read_array(path: Path, what: str) -> np.ndarray:
    """The array of numbers in a .npy file, which must be `what`; `InputError` for any other, or one cut short."""
    found = mapped_array(path, what)
    require_memory(str(path), found.nbytes)  # of a file with holes, which holds more than it takes
    return np.array(found)


def mapped_array(path: Path, what: str) -> np.ndarray:
    """The same, whose values are read when they are asked for."""
    require_regular(path, what)
    with _numpy(path, f"{what} (.npy)"):
        with path.open("rb") as file:
            declared = _declared(file)
        if declared > path.stat().st_size:
            raise ValueError(f"it declares {declared:.3g} bytes, but has {path.stat().st_size}")
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # which maps no more than there is
        if not isinstance(found, np.ndarray):
            found.close()
            raise ValueError("it is an archive")
        return found


def read_archive(
    path: Path, names: Container[str] | None = None, what: str = "a NumPy archive"
) -> dict[str, np.ndarray]:
    """The arrays in an .npz file, which must be `what`, by name, of all names or those in `names`; `InputError` for any
    other file, for one that declares more than it can hold, and for more than there is memory for."""
    require_regular(path, what)
    with _numpy(path, f"{what} (.npz)"), zipfile.ZipFile(path) as archive:
        for part in archive.infolist():
            with archive.open(part) as file:
                declared = _declared(file)
            if declared > part.file_size:
                raise ValueError(f"it declares {declared:.3g} bytes of {part.filename[:40]}, but has {part.file_size}")
        size = sum(part.file_size for part in archive.infolist())
        require_declared(str(path), size, path.stat().st_size)
        require_memory(str(path), size)
        with np.load(path, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files if names is None or name in names}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):
                raise ValueError(f"{name[:40]} is no array")
        return arrays


@contextmanager
def _numpy(path: Path, what: str) -> Iterator[None]:
    """`InputError` in place of what numpy and zipfile raise, of many kinds, for damaged files."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:SAID] or type(error).__name__
        raise InputError(f"{path} must be {what}, but it is damaged or none: {said}.") from None


def _declared(file: Any) -> int:
    """Bytes that the header of an open .npy file declares; none where it is no such header, which others will say."""
    try:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(file)
    except (OSError, ValueError, EOFError):
        return 0
    return int(np.prod(shape, dtype=object)) * dtype.itemsize


def xml_fault(content: bytes) -> str:
    """Why an XML file of VTK is not given to its parser: it is nested too deeply, or declares more points or cells than
    it has room for; empty if there is no such fault. What is appended to it is no XML and is passed over."""
    text = content[: content.rindex(APPENDED)] if APPENDED in content else content
    for name, count in COUNT.findall(text):
        most = MOST_COMPONENTS if name == b"NumberOfComponents" else RATIO * len(content)
        if len(count) > LONGEST or int(count) > most:
            return f"it declares {count.decode()[:LONGEST]} points, cells or components, but has {len(content)} bytes"
    depth = 0
    for tag in TAG.finditer(text):
        if tag[2][:1] in b"!?" or tag[3]:
            continue
        depth += -1 if tag[1] else 1
        if depth > DEEPEST:
            return f"its elements are nested more than {DEEPEST} deep"
    return ""
