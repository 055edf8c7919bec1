"""The seal of HDF5 files: what has no checksum of HDF5's own is held against one before the library reads it."""

from __future__ import annotations

import hashlib
import io
import random
import time
import tracemalloc
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

import holosplat.io.hdf5_guard as module
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.io import read_scan
from holosplat.io.hdf5 import new_hdf5, put
from holosplat.io.hdf5_guard import ENDING, MAGIC, require_sealed, seal, summed
from holosplat.io.nxtomo import write_scan
from holosplat.scan import Exposures, Scan
from holosplat.workflows.run_folder import check

PIXEL = 3.2e-6


@pytest.fixture
def scan(tmp_path) -> Path:
    """Six frames of 18 × 20 pixels."""
    exposures = Exposures.of(Views.evenly_spaced(6, (18, 20), PIXEL), 20.0, 0.1)
    frames = 1 + np.random.default_rng(1).normal(0, 0.1, (6, 18, 20)).astype(np.float32)
    write_scan(tmp_path / "scan.nxs", Scan(frames, exposures, np.arange(6) % 4 == 3, {}))
    return tmp_path / "scan.nxs"


def flipped(path: Path, at: int, bit: int) -> Path:
    """A copy with one bit flipped."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    (path.parent / "flipped.nxs").write_bytes(content)
    return path.parent / "flipped.nxs"


def test_what_was_written_is_read(scan):
    assert scan.read_bytes().endswith(MAGIC)
    assert check(scan) == (1, [])
    with h5py.File(scan) as file:  # by another program
        assert file["entry/instrument/detector/data"].shape == (6, 18, 20)


def test_a_flipped_bit_is_noticed_wherever_it_is(scan):
    """In the seal, too."""
    draws, size = random.Random(1), scan.stat().st_size
    for at in [*(draws.randrange(size) for _ in range(60)), size - 3, size - 40]:
        assert check(flipped(scan, at, draws.randrange(8)))[1], at


def test_a_file_cut_off_within_its_seal_is_noticed(scan):
    content = scan.read_bytes()
    (length, *_) = ENDING.unpack(content[-ENDING.size :])
    for kept in (length + 1, length + len(MAGIC) + 3, len(content) - 1):
        scan.write_bytes(content[:kept])
        with pytest.raises(InputError, match="truncated or damaged"):
            read_scan(scan)
    scan.write_bytes(content[:length])  # as a program leaves it that writes
    assert len(read_scan(scan)) == 6


def test_a_number_that_stands_for_itself_does_not_change_unnoticed(scan):
    """The pixel size: eight bytes in the file, of which any would give another one."""
    content = scan.read_bytes()
    at = content.find(np.float64(PIXEL).tobytes())
    assert at > 0
    for byte in range(8):
        with pytest.raises(InputError, match="must be as it was written, but it is truncated or damaged"):
            read_scan(flipped(scan, at + byte, 3))


def test_values_of_chunks_have_checksums_of_their_own(scan):
    """The seal does not look at them, however many there are; HDF5 does when they are read."""
    with h5py.File(scan) as file:
        frames = file["entry/instrument/detector/data"]
        first = frames.id.get_chunk_info(0)
        ranges = [tuple(pair) for pair in summed(file).tolist()]
        assert (first.byte_offset, first.size) in ranges
    path = flipped(scan, first.byte_offset + 5, 1)
    require_sealed(path)
    with pytest.raises(InputError, match="truncated, damaged or not readable"):
        read_scan(path).in_memory()
    assert check(path)[1]


def test_a_program_that_writes_to_a_file_takes_its_seal_off(scan):
    with h5py.File(scan, "r+") as file:
        file["entry/instrument/detector/x_pixel_size"][()] = 2 * PIXEL
        file["entry/instrument/detector/y_pixel_size"][()] = 2 * PIXEL
    assert MAGIC not in scan.read_bytes()
    assert read_scan(scan).views.pixel_size == pytest.approx(2 * PIXEL)


@pytest.mark.parametrize("change", [(0, 1), (1, 1 << 62), (1, 3)])
def test_a_seal_that_cannot_be_is_refused(scan, change):
    content = scan.read_bytes()
    parts = list(ENDING.unpack(content[-ENDING.size :]))
    parts[change[0]] += change[1]
    scan.write_bytes(content[: -ENDING.size] + ENDING.pack(*parts))
    with pytest.raises(InputError, match="damaged"):
        require_sealed(scan)


def forged(path: Path, content: bytes, packed: bytes, ranges: bytes) -> Path:
    """A file whose seal has such ranges, and the checksum that goes with them."""
    starts = np.frombuffer(ranges, "<i8").reshape(-1, 2).tolist()
    rest, at = b"", 0
    for offset, size in starts:
        rest, at = rest + content[at : max(offset, 0)], max(at, offset + size)
    digest = hashlib.sha256(ranges + rest + content[at:]).digest()
    path.write_bytes(content + MAGIC + packed + ENDING.pack(len(content), len(packed), digest, MAGIC))
    return path


def zeros(size: int) -> bytes:
    """So many zeros, deflated."""
    packer, block = zlib.compressobj(), bytes(1 << 20)
    return b"".join(packer.compress(block) for _ in range(size >> 20)) + packer.flush()


def test_a_seal_that_unpacks_to_gigabytes_is_refused_without_doing_so(tmp_path):
    """1 MB of deflated zeros, behind a file of 64 kB: 2²⁶ ranges, which took minutes and gigabytes."""
    path = forged(tmp_path / "a.h5", bytes(1 << 16), zeros(1 << 30), b"")
    tracemalloc.start()
    began = time.perf_counter()
    with pytest.raises(InputError, match=r"a\.h5 must be as it was written, but it is truncated or damaged"):
        require_sealed(path)
    seconds, (_, peak) = time.perf_counter() - began, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < 2
    assert peak < 16e6


def test_a_seal_that_is_longer_than_deflate_makes_one_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_unpacked", lambda *_: pytest.fail("it must not be unpacked"))
    path = forged(tmp_path / "a.h5", bytes(1 << 16), bytes(3 << 20), b"")
    with pytest.raises(InputError, match="truncated or damaged"):
        require_sealed(path)


@pytest.mark.parametrize(
    ("ranges", "good"),
    [
        ([[3, 4], [10, 2]], True),
        ([], True),
        ([[3, 7], [10, 50]], True),
        ([[3, 0]], False),
        ([[3, -1]], False),
        ([[-1, 4]], False),
        ([[10, 2], [3, 4]], False),
        ([[3, 8], [10, 2]], False),
        ([[3, 4], [3, 4]], False),
        ([[10, 51]], False),
        ([[61, 1]], False),
        ([[1 << 62, 1 << 62], [3, 4]], False),
    ],
)
def test_ranges_hold_something_follow_each_other_and_lie_in_the_file(tmp_path, ranges, good):
    """Their checksum is right."""
    content = np.array(ranges, "<i8").tobytes()
    path = forged(tmp_path / "a.h5", bytes(range(60)), zlib.compress(content), content)
    if good:
        require_sealed(path)
        return
    with pytest.raises(InputError, match="truncated or damaged"):
        require_sealed(path)


class Slow(io.BytesIO):
    """A file that takes three bytes at a time."""

    def write(self, data) -> int:
        return super().write(bytes(data[:3]))


def test_a_seal_is_written_whole_by_a_file_that_takes_parts(tmp_path):
    ranges = np.array([[3, 4], [10, 2]], dtype="<i8")
    found = []
    for kind in (io.BytesIO, Slow):
        raw = kind(bytes(range(20)))
        seal(raw, ranges)
        found.append(raw.getvalue())
    assert found[0] == found[1]
    path = tmp_path / "a"
    for at, good in ((2, False), (3, True), (6, True), (7, False), (11, True), (12, False), (19, False)):
        content = bytearray(found[0])
        content[at] ^= 1
        path.write_bytes(content)
        if good:
            require_sealed(path)
        else:
            with pytest.raises(InputError):
                require_sealed(path)


def test_texts_empty_arrays_and_single_numbers_are_sealed(tmp_path):
    with new_hdf5(tmp_path / "a.h5") as file:
        put(file, "number", 1.25)
        put(file, "text", "words")
        put(file, "none", np.zeros((0, 3)))
        file.attrs["format"] = "mine"
    content = (tmp_path / "a.h5").read_bytes()
    for part in (np.float64(1.25).tobytes(), b"words", b"mine"):
        (tmp_path / "b.h5").write_bytes(content.replace(part, part[:-1] + bytes([part[-1] ^ 1])))
        assert check(tmp_path / "b.h5")[1], part
