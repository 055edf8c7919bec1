"""Guards of HDF5 files: they bring their own values, no more than they are, and are as they were written.

A link, a virtual dataset or external storage can make a reader copy any file of this machine into what it writes.

HDF5 sums up the values of chunks alone. Numbers that stand for themselves, texts, names and the index of chunks have no
checksum, and a flipped bit in them can become another number, or crash the library. So a seal behind the end of our own
files has the SHA-256 of all bytes that are in no such chunk; it is held against the file before the library sees it.
Other programs pass over bytes behind the end, and a program that writes to the file cuts them off: its seal is then
gone.
"""

from __future__ import annotations

import errno
import hashlib
import io
import math
import os
import re
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from h5py import h5d, h5l, h5o, h5p, h5z  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, require, require_regular, warn
from .guard import DEEPEST, SMALL, require_declared
from .room import free_memory

MOST = 200_000
"""Links in a file, at most: larger ones are no scans, and take minutes to look through."""
MOST_FILES = 10_000
"""Files that one may bring values of: one a frame, and more than beamlines write."""
AGED = 1_000_000_000
"""Nanoseconds without a change after which the times of a file tell the next one: clocks of file systems are coarse."""
MOST_KNOWN = 1000
"""Files that are remembered, at most."""
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What locking a file fails with where the file system has no locks."""
WRITING = (f"errno = {errno.EAGAIN},", f"errno = {errno.EACCES},", "already open for write")
"""What HDF5 says of a file that another program has open for writing, or left open as it ended."""
_vouched: set[Path] = set()
_known: dict[tuple[int, ...], None] = {}
"""Files that hold all that they are read for, by device, number, size and times: a command opens one several times."""


def opened_for_reading(path: Path) -> h5py.File:
    """The file at `path`, which nobody else may write meanwhile; on a file system without locks, without that.

    One that another program writes, or left open, is read as it is now, with a warning, where HDF5 can tell its parts.
    """
    try:
        return h5py.File(path, "r")
    except OSError as error:
        said = str(error)
        if any(f"errno = {number}," in said for number in WITHOUT_LOCKS):
            return h5py.File(path, "r", locking=False)
        if not any(words in said for words in WRITING):
            raise
    # SWMR: what a writer has flushed is whole, and its marks that the file is open do not count.
    opened = h5py.File(path, "r", locking=False, swmr=WRITING[-1] in said)
    warn(f"{path} is open for writing elsewhere, or was not closed; it is read as it is now")
    return opened


def allow_external(path: Path) -> None:
    """From now on `path`, or the files below it, may bring values of other files (`--allow-external`)."""
    _vouched.add(path.resolve())


def require_own(file: h5py.File, path: Path) -> None:
    """`InputError` if an open file at `path` refers to other files, is nested too deeply, or declares more values than
    it can hold. Where it may refer to others (`allow_external`), the same holds for each of these."""
    state = os.fstat(file.id.get_vfd_handle())
    stamp = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
    if stamp in _known:
        return
    allowed, now = is_vouched(path), time.time_ns()
    seen, later = {path.resolve()}, _others(file, path, allowed)
    if not allowed and now - max(state.st_mtime_ns, state.st_ctime_ns) > AGED:
        if len(_known) >= MOST_KNOWN:
            _known.clear()
        _known[stamp] = None
    while later:
        other = later.pop()
        if other.resolve() in seen:
            continue
        seen.add(other.resolve())
        require(len(seen) <= MOST_FILES, f"{path} must bring values of at most {MOST_FILES} files, but has more.")
        require_sealed(other)
        try:
            with opened_for_reading(other) as opened:
                later += _others(opened, other, allowed)
        except OSError as error:
            raise InputError(
                f"{other}, of which {path} brings values, must be a complete HDF5 file, but it is not: {error}."
            ) from None


def _others(file: h5py.File, path: Path, allowed: bool) -> list[Path]:
    """The HDF5 files that an open one refers to, once all else of it is in order."""
    found, links = list[Path](), list[tuple[bytes, int]]()

    def take(name: bytes, info: h5l.LinkInfo) -> bool | None:
        links.append((name, info.type))
        return True if len(links) > MOST else None

    file.id.links.visit(take, info=True)  # which follows none of them
    require(len(links) <= MOST, f"{path} must hold at most {MOST} entries, but it holds more.")
    for name, kind in links:
        inner = f"/{name.decode(errors='replace')}"
        require(name.count(b"/") < DEEPEST, f"{path} must not be nested more than {DEEPEST} deep, but it is.")
        if kind == h5l.TYPE_EXTERNAL:
            require(allowed, _refers(path, inner, "is a link to another file"))
            linked = os.fsdecode(file.id.links.get_val(name)[0])
            found += _required(path, f"{path}: {inner}", [linked], LINKS)
        elif kind == h5l.TYPE_HARD and h5o.get_info(file.id, name).type == h5o.TYPE_DATASET:
            found += _dataset_files(h5d.open(file.id, name), path, inner, allowed)
    return found


def _dataset_files(dataset: h5d.DatasetID, path: Path, inner: str, allowed: bool) -> list[Path]:
    """The HDF5 files that the dataset `inner` of the file `path` refers to, once its values are in order."""
    label, plan, size = f"{path}: {inner}", dataset.get_create_plist(), path.stat().st_size
    unknown_filters(plan)  # loads those that are installed; others are named where values are read
    if dataset.shape is None:  # a null dataspace holds nothing, which whoever wants a value says
        return []
    declared = math.prod(dataset.shape, start=dataset.get_type().get_size())
    virtual = plan.get_layout() == h5d.VIRTUAL
    sources = [plan.get_virtual_filename(n) for n in range(plan.get_virtual_count())] if virtual else []
    names = [name for name in dict.fromkeys(sources) if name != "."]
    storage = [plan.get_external(n) for n in range(plan.get_external_count())]
    require(allowed or not (names or storage), _refers(path, inner, "has its values in another file"))
    if virtual:
        found = _required(path, label, names, VIRTUAL)
        require_declared(label, declared, sum(place.stat().st_size for place in found) + size)
        return found
    if storage:
        held = 0
        for name, offset, part in storage:
            (first, *_) = _required(path, label, [os.fsdecode(name)], EXTERNAL)
            held += max(0, min(part, first.stat().st_size - offset))
        require(
            declared <= held,
            f"{label} declares {declared:.3g} bytes of values, but the files beside it hold {held:.3g}; they are cut "
            "short, or it is no honest file.",
        )
    else:
        require_declared(label, declared, size)
        _require_chunks(dataset, label, size)
    return []


def is_vouched(path: Path) -> bool:
    """Whether `path` may bring values of other files (`allow_external`)."""
    whole = path.resolve()
    return any(whole == known or known in whole.parents for known in _vouched)


def _refers(path: Path, inner: str, what: str) -> str:
    return f"{path} must hold its own values, but {inner} {what}; if you trust both, add --allow-external."


DEFLATION = 1032
"""How many times more bytes deflate can give than it takes (Deutsch 1996, RFC 1951: 258 bytes for two bits)."""
SHARE = 4
"""A chunk that cannot unpack to more than a quarter of the free memory is left to HDF5, which is as fast as reading."""
PIECE = 1 << 20
"""Bytes that are unpacked at a time."""


def _require_chunks(dataset: h5d.DatasetID, label: str, size: int) -> None:
    """`InputError` if a chunk of `dataset`, in a file of `size` bytes, declares or unpacks to too much."""
    plan = dataset.get_create_plist()
    if plan.get_layout() != h5d.CHUNKED:
        return
    declared = math.prod(plan.get_chunk(), start=dataset.get_type().get_size())
    require_declared(f"a chunk of {label}", declared, size)
    filters = [plan.get_filter(number)[0] for number in range(plan.get_nfilters())]
    if h5z.FILTER_DEFLATE not in filters:
        return
    require(filters.count(h5z.FILTER_DEFLATE) == 1, f"{label} must be deflated once, but it is more often; unpack it.")
    most = max(SMALL, free_memory() // SHARE)
    if DEFLATION * size <= most:
        return
    place = filters.index(h5z.FILTER_DEFLATE)
    for offset, skipped, stored in chunks_of(dataset):
        if DEFLATION * stored > most and not skipped & (1 << place):
            known = all(one == h5z.FILTER_FLETCHER32 for one in filters[place + 1 :])
            require(known, f"{label} must be deflated last of all filters, but it is not; unpack it.")
            _require_unpacked(dataset, offset, declared, label)


def chunks_of(dataset: h5d.DatasetID) -> Iterator[tuple[tuple[int, ...], int, int]]:
    """Offset, filters that were left out (a bit each) and stored bytes of each chunk."""
    found: list[tuple[tuple[int, ...], int, int]] = []
    dataset.chunk_iter(lambda info: found.append((info.chunk_offset, info.filter_mask, info.size)))
    yield from found


def _require_unpacked(dataset: h5d.DatasetID, offset: tuple[int, ...], declared: int, label: str) -> None:
    """`InputError` if a deflated chunk unpacks to more than `declared` bytes; it is unpacked in pieces."""
    _, packed = dataset.read_direct_chunk(offset)
    stream, size = zlib.decompressobj(), 0
    try:
        while packed and not stream.eof:
            size += len(stream.decompress(packed, PIECE))
            packed = stream.unconsumed_tail
            if size > declared:
                raise InputError(
                    f"{label} unpacks to more than the {declared} bytes of its chunk; it is damaged, or no honest file."
                )
    except zlib.error as error:
        raise InputError(f"{label} must be deflated, but it is damaged: {error}.") from None


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


LINKS, VIRTUAL, EXTERNAL = "HDF5_EXT_PREFIX", "HDF5_VDS_PREFIX", "HDF5_EXTFILE_PREFIX"
"""Variables of the environment that name folders in which HDF5 looks first."""
SERIES = re.compile(r"%\d*b")
"""Within the name of a virtual dataset's source: the number of a block."""


def virtual_places(path: Path, name: str) -> list[Path]:
    """The files that HDF5 may open for the source `name` of a virtual dataset of the file `path`."""
    return [place for place in _places(path, name, VIRTUAL) if place.is_file()]


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


MAGIC = b"holosplat sealed"
"""With which a seal begins and ends."""
ENDING = struct.Struct(f"<QQ32s{len(MAGIC)}s")
"""Length of the HDF5 file, length of the packed ranges, SHA-256, and the seal's name."""
START = struct.Struct("<8sB31xQ")
"""The first bytes of an HDF5 file: its signature, the version 0 of what follows, and where it ends."""
SIGNATURE = b"\x89HDF\r\n\x1a\n"
BLOCK = 1 << 20
RANGE, CHUNK = 16, 13
"""Bytes of a range, and those that a chunk takes of the file at least: a value, its checksum, and where they are."""


def summed(file: h5py.File) -> np.ndarray:
    """Offsets and sizes [N, 2] of the chunks whose values have checksums, in order."""
    file.flush()  # they have their places then
    found: list[tuple[int, int]] = []

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset) and item.chunks and item.fletcher32:
            item.id.chunk_iter(lambda one: found.append((one.byte_offset, one.size)))

    file.visititems(take)
    return np.array(sorted(found), dtype="<i8").reshape(-1, 2)


def seal(raw: IO[bytes], ranges: np.ndarray) -> None:
    """Put the seal behind a closed HDF5 file that is open for reading and writing."""
    length, packed = raw.seek(0, io.SEEK_END), zlib.compress(ranges.tobytes())
    digest = _digest(raw, length, ranges)
    raw.seek(0, io.SEEK_END)
    rest = memoryview(MAGIC + packed + ENDING.pack(length, len(packed), digest, MAGIC))
    while rest:  # a file without a buffer may take a part
        rest = rest[raw.write(rest) :]


def require_sealed(path: Path) -> None:
    """`InputError` for a file that is not as its seal says, or has a part of one; files without one pass."""
    with path.open("rb") as raw:
        good = _is_as_sealed(raw, raw.seek(0, io.SEEK_END))
    require(good, f"{path} must be as it was written, but it is truncated or damaged; bring back the whole file.")


def _is_as_sealed(raw: IO[bytes], size: int) -> bool:
    """Whether a file of so many bytes is as its seal says, or has none."""
    if size < START.size + ENDING.size:
        return True
    raw.seek(size - ENDING.size)
    length, packed, digest, name = ENDING.unpack(raw.read(ENDING.size))
    if name != MAGIC:
        return not _has_begun(raw)
    if length + len(MAGIC) + packed + ENDING.size != size:
        return False
    most = max(BLOCK, RANGE * (length // CHUNK))
    if packed > most + most // 1000 + BLOCK:  # deflate makes nothing longer than that
        return False
    raw.seek(length + len(MAGIC))
    ranges = _unpacked(raw.read(packed), length, most)
    return ranges is not None and _digest(raw, length, ranges) == digest


def _has_begun(raw: IO[bytes]) -> bool:
    """Whether a seal begins where the HDF5 file ends, however little is left of it."""
    raw.seek(0)
    signature, version, end = START.unpack(raw.read(START.size))
    if signature != SIGNATURE or version != 0 or end >= 1 << 63:
        return False
    raw.seek(end)
    begun = raw.read(len(MAGIC))
    return bool(begun) and MAGIC.startswith(begun)


def _unpacked(packed: bytes, length: int, most: int) -> np.ndarray | None:
    """The ranges in a seal of a file of `length` bytes, unpacked to `most` bytes; None if they cannot be of such a
    file."""
    try:
        unpacker = zlib.decompressobj()
        values = np.frombuffer(unpacker.decompress(packed, most), dtype="<i8").reshape(-1, 2)
    except (zlib.error, ValueError):
        return None
    if not unpacker.eof:
        return None
    starts, sizes = values[:, 0], values[:, 1]
    sound = (sizes > 0).all() and (starts >= 0).all() and (sizes <= length - np.minimum(starts, length)).all()
    return values if sound and (starts[1:] >= starts[:-1] + sizes[:-1]).all() else None


def _digest(raw: IO[bytes], length: int, ranges: np.ndarray) -> bytes:
    """The SHA-256 of the ranges and of the first `length` bytes without them."""
    found, at = hashlib.sha256(ranges.tobytes()), 0
    for offset, size in [*ranges.tolist(), (length, 0)]:
        raw.seek(at)
        while at < offset and (block := raw.read(min(BLOCK, offset - at))):
            found.update(block)
            at += len(block)
        at = offset + size
    return found.digest()
