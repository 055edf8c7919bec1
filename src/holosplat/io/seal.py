"""The seal of an HDF5 file: a checksum, behind the file's end, of all that checksums of values do not see.

HDF5 sums up the values of chunks alone. Numbers that stand for themselves, texts, names and the index of chunks have no
checksum, and a flipped bit in them can become another number, or crash the library. So the seal has the SHA-256 of all
bytes that are in no such chunk; it is held against the file before the library sees it. Other programs pass over bytes
behind the end, and a program that writes to the file cuts them off: its seal is then gone.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from pathlib import Path
from typing import IO

import h5py
import numpy as np

from ..checks import require

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
