"""Chunks of HDF5 files: HDF5 itself unpacks a deflated one to any size, whatever the chunk is declared to hold."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

from h5py import h5d, h5z  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, require
from .guard import SMALL, require_declared
from .room import free_memory

DEFLATION = 1032
"""How many times more bytes deflate can give than it takes (Deutsch 1996, RFC 1951: 258 bytes for two bits)."""
SHARE = 4
"""A chunk that cannot unpack to more than a quarter of the free memory is left to HDF5, which is as fast as reading."""
PIECE = 1 << 20
"""Bytes that are unpacked at a time."""


def require_chunks(dataset: h5d.DatasetID, label: str, size: int) -> None:
    """`InputError` if a chunk of `dataset`, in a file of `size` bytes, declares more than it can hold, or unpacks to
    more than it declares."""
    plan = dataset.get_create_plist()
    if plan.get_layout() != h5d.CHUNKED:
        return
    declared = dataset.get_type().get_size()
    for length in plan.get_chunk():
        declared *= length
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
    if not hasattr(dataset, "chunk_iter"):  # HDF5 before 1.14
        infos = (dataset.get_chunk_info(number) for number in range(dataset.get_num_chunks()))
        yield from ((info.chunk_offset, info.filter_mask, info.size) for info in infos)
        return
    found: list[tuple[tuple[int, ...], int, int]] = []

    def take(info: h5d.StoreInfo) -> None:
        found.append((info.chunk_offset, info.filter_mask, info.size))

    dataset.chunk_iter(take)
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
