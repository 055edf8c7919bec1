"""Scans whose frames stay in their file until they are asked for."""

from __future__ import annotations

import os
import pickle
import tracemalloc
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import holosplat.frames as frames_module
from holosplat.checks import InputError
from holosplat.frames import Binned, Frames, Picked, divided
from holosplat.geometry import Views, rotation_y
from holosplat.io.nxtomo import RawLayout, read_scan, scan_writer, write_scan
from holosplat.io.raw_file import ScanFile
from holosplat.scan import Exposures, Scan
from holosplat.workflows.provenance import scan_hash

N, SHAPE = 12, (21, 26)
DATA = "/entry/instrument/detector/data"


def a_series(shape: tuple[int, int] = SHAPE, count: int = N) -> Scan:
    """Frames of two views at each of N/2 instants."""
    views = Views(rotation_y(np.tile([0.0, 50.0], count // 2)), np.zeros((count, 2)), shape, 1e-6)
    exposures = Exposures(views, 20.0, 0.1, 0.3, np.repeat(np.arange(count // 2), 2))  # type: ignore[arg-type]
    frames = np.random.default_rng(0).random((count, *shape), dtype=np.float32)
    return Scan(frames, exposures, np.arange(count) % 4 == 3)


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    write_scan(tmp_path / "series.nxs", a_series())
    return tmp_path / "series.nxs"


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of the frames that were read from files so far."""
    numbers, read = [], ScanFile.rows

    def counted(file: ScanFile, number: int, rows: slice) -> np.ndarray:
        numbers.append(number)
        return read(file, number, rows)

    monkeypatch.setattr(ScanFile, "rows", counted)
    return numbers


def test_opening_a_file_reads_no_frame(stored, reads):
    found = read_scan(stored)
    assert (len(found), found.views.shape, found.source.shape) == (N, SHAPE, (N, *SHAPE))
    assert isinstance(found.source, Frames)
    assert "12 frames of 21 × 26 pixels" in repr(found)
    assert reads == []


def test_only_what_is_asked_for_is_read(stored, reads):
    scan, wanted = read_scan(stored), a_series()
    np.testing.assert_array_equal(scan.at_instant(2).frames, wanted.at_instant(2).frames)
    assert reads == [4, 5]
    reads.clear()
    np.testing.assert_array_equal(scan.test().frames, wanted.test().frames)
    assert reads == [3, 7, 11]
    reads.clear()
    np.testing.assert_array_equal(scan.train()[[5, 0]].frames, wanted.train()[[5, 0]].frames)
    assert reads == [6, 0]
    reads.clear()
    np.testing.assert_array_equal(scan[2:4].as_static().binned(4).frames, wanted[2:4].as_static().binned(4).frames)
    assert reads == [2, 3]


def test_frames_are_read_once_and_kept(stored, reads):
    scan = read_scan(stored)
    np.testing.assert_array_equal(scan.frames, a_series().frames)
    assert scan.frames is scan.frames
    assert reads == list(range(N))
    np.testing.assert_array_equal(np.asarray(read_scan(stored).source), a_series().frames)
    reads.clear()
    at_once = read_scan(stored).in_memory()
    stored.unlink()
    np.testing.assert_array_equal(at_once.train().frames, a_series().train().frames)
    assert reads == list(range(N))


def test_frames_are_indexed_as_arrays_are(stored):
    source, wanted = read_scan(stored).source, a_series().frames
    mask = np.arange(N) % 5 == 1
    for index in (3, -1, slice(1, 9, 3), [4, 0], np.array([7, 7]), mask, slice(0, 0), np.array([], dtype=int)):
        np.testing.assert_array_equal(source[index], wanted[index])
    assert source[3].dtype == np.float32
    with pytest.raises(IndexError):
        source[N]


def test_frames_can_be_replaced_and_scans_pickled(stored):
    scan = read_scan(stored)
    assert replace(scan, frames=2 * scan.frames).frames.max() == 2 * a_series().frames.max()
    scan = pickle.loads(pickle.dumps(read_scan(stored)))
    assert isinstance(scan.source, Frames)
    np.testing.assert_array_equal(scan.train().frames, a_series().train().frames)


def test_frames_of_another_shape_are_refused(stored):
    scan = read_scan(stored)
    with pytest.raises(InputError, match=r"frames must have the shape \(11, 21, 26\), but it is \(12, 21, 26\)"):
        Scan.of(scan.source, scan.exposures[:11], scan.is_test[:11], {})


def test_the_hash_is_the_same_however_frames_are_read(stored, monkeypatch):
    monkeypatch.setattr(frames_module, "BLOCK_BYTES", 5 * 4 * SHAPE[0] * SHAPE[1])
    lazy = read_scan(stored)
    assert [len(block) for block in lazy.blocks()] == [5, 5, 2]
    assert scan_hash(lazy) == scan_hash(a_series())
    assert isinstance(lazy.source, Frames)


def test_a_long_series_passes_through_little_memory(tmp_path, monkeypatch):
    """Hashed and written anew, 8 MB of frames never take 2 MB at once; the whole does, as a check of the check."""
    path, shape, count = tmp_path / "long.nxs", (128, 128), 128
    write_scan(path, a_series(shape, count))
    monkeypatch.setattr(frames_module, "BLOCK_BYTES", 2**18)
    scan = read_scan(path)
    tracemalloc.start()
    try:
        scan_hash(scan)
        write_scan(tmp_path / "copy.nxs", scan)
        assert tracemalloc.get_traced_memory()[1] < 2 * 2**20
        assert scan.frames.nbytes == 8 * 2**20
        assert tracemalloc.get_traced_memory()[1] > 8 * 2**20
    finally:
        tracemalloc.stop()


def test_raw_frames_are_corrected_when_they_are_read(tmp_path, reads):
    """Upside down, mirrored, with darks and flats between: as frame by frame by hand."""
    clean, rng = a_series(), np.random.default_rng(1)
    dark, light = rng.integers(90, 110, SHAPE), rng.integers(900, 1100, SHAPE)
    kinds = np.array([2, 1] + [0] * N)
    index = np.concatenate([[0, 0], np.arange(N)])
    layout = RawLayout(kinds, np.zeros(SHAPE), flips=(True, True))
    counts = np.stack([dark, dark + light, *np.rint(dark + light * clean.frames)])
    with scan_writer(tmp_path / "raw.nxs", clean.exposures[index], clean.is_test[index], {}, layout) as add:
        for frame in counts:
            add(frame[::-1, ::-1])
    found = read_scan(tmp_path / "raw.nxs")
    assert set(reads) == {0, 1}, "the dark and the flat frame, for their means"
    reads.clear()
    np.testing.assert_allclose(found[[5]].frames[0], (counts[7] - dark) / light, rtol=1e-6)
    assert reads == [7]
    np.testing.assert_allclose(found.frames, clean.frames, atol=1e-3)


def test_a_file_that_has_gone_or_changed_is_named(stored):
    scan = read_scan(stored)
    with h5py.File(stored, "a") as file:
        file[DATA][0] = 1.0
    later = stored.stat().st_mtime_ns + 1
    os.utime(stored, ns=(later, later))
    with pytest.raises(InputError, match=r"series\.nxs must be the file that was opened, but it has changed since"):
        scan.frames  # noqa: B018
    stored.unlink()
    with pytest.raises(InputError, match=r"series\.nxs must be the file that was opened, but it is gone"):
        scan[[0]].frames  # noqa: B018


def test_a_scan_can_be_written_over_its_own_file(stored):
    scan = read_scan(stored)
    write_scan(stored, scan)
    np.testing.assert_array_equal(read_scan(stored).frames, a_series().frames)


def test_values_that_are_no_numbers_are_filled_and_said(stored, caplog):
    with h5py.File(stored, "a") as file:
        file[DATA][3, 2, 5] = np.nan
    whole = a_series().frames[3]
    scan = read_scan(stored)
    assert np.isfinite(scan[[2, 4]].frames).all()
    assert not caplog.records
    around = np.delete(whole[1:4, 4:7].ravel(), 4)
    np.testing.assert_allclose(scan[[3]].frames[0, 2, 5], around.mean(), rtol=1e-6)
    assert "(1 in 1 of 1 frames)" in caplog.text


def test_picked_and_binned_frames_can_be_stacked(stored):
    source, wanted = read_scan(stored).source, a_series().frames
    twice = Picked(Picked(source, slice(2, None, 2)), np.array([3, 1]))
    np.testing.assert_array_equal(np.asarray(twice), wanted[[8, 4]])
    np.testing.assert_array_equal(Binned(twice, 3)[:], a_series()[[8, 4]].binned(3).frames)


@pytest.mark.parametrize("shape", [(1, *SHAPE), (N, *SHAPE), (N, 1, SHAPE[1])], ids=["still", "each", "by column"])
def test_frames_are_divided_by_the_light_of_their_numbers(stored, shape):
    light = np.random.default_rng(1).uniform(0.5, 2, shape).astype(np.float32)
    series, found = a_series(), divided(read_scan(stored).source, light)
    assert isinstance(found, Frames)
    whole = divided(series.frames, light)
    np.testing.assert_array_equal(whole, series.frames / light)
    np.testing.assert_array_equal(found[[7, 2]], whole[[7, 2]])
    np.testing.assert_array_equal(np.asarray(found), whole)
