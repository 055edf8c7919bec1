"""Disks that are full: one sentence, no crash, and what was there stays."""

from __future__ import annotations

import os
import resource
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.cli.align import _write_table
from holosplat.cli.convert import _preview
from holosplat.geometry import Views
from holosplat.io import write_scan
from holosplat.io.atomic import atomic_folder, atomic_path
from holosplat.io.hdf5 import new_hdf5, put, require_room
from holosplat.scan import Exposures, Scan
from holosplat.workflows.run_folder import RunFolder

SHAPE = (3, 40, 31)


@contextmanager
def room_of(size: int):
    """No file grows beyond `size` bytes, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def scan():
    frames = np.random.default_rng(1).uniform(0.5, 1.5, SHAPE).astype(np.float32)
    views = Views.evenly_spaced(SHAPE[0], SHAPE[1:], 1e-6)
    return Scan(frames, Exposures.of(views, 20.0, 0.1), np.zeros(SHAPE[0], dtype=bool))


@pytest.mark.parametrize("size", [0, 100, 3000, 9000, 14000])
def test_a_scan_that_does_not_fit_is_not_there(tmp_path, scan, size):
    """Wherever the disk ends: within the header, the frames, or what is written at last."""
    path = tmp_path / "scan.nxs"
    path.write_bytes(b"old")
    with room_of(size), pytest.raises(InputError, match="must be writable, but writing it failed"):
        write_scan(path, scan)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scan.nxs"]


def two_values(path):
    """The disk fills up between them."""
    with new_hdf5(path) as file:
        put(file, "first", np.arange(10))
        file.flush()
        with room_of(next(path.parent.iterdir()).stat().st_size + 50_000):
            put(file, "second", np.random.default_rng(1).normal(size=(200, 333)))
            file.flush()


def test_a_disk_that_fails_between_two_values_is_noticed(tmp_path):
    """It has room again when the file is closed, but what is in it is not what was written."""
    with pytest.raises(InputError, match="must be writable"):
        two_values(tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_room_is_asked_for_before_the_start(tmp_path):
    with pytest.raises(InputError, match=r"a\.h5 needs \d+ MB, but .* has \d+ MB left; make room"):
        require_room(tmp_path / "a.h5", 1 << 60)
    with pytest.raises(InputError, match="make room"), new_hdf5(tmp_path / "a.h5", 1 << 60):
        raise AssertionError("it must not begin")


def test_a_checkpoint_that_does_not_fit_leaves_the_one_before(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.begin({})
    folder.save_checkpoint({"step": 1})
    with room_of(200), pytest.raises(InputError, match=r"checkpoint\.pt must be writable"):
        folder.save_checkpoint({"step": 2, "values": [0.5] * 1000})
    assert folder.load_checkpoint() == {"step": 1}


def test_values_have_checksums(tmp_path):
    """A flipped bit in them is noticed when they are read."""
    path, values = tmp_path / "a.h5", np.random.default_rng(2).normal(size=(7, 11, 5))
    with new_hdf5(path) as file:
        put(file, "values", values)
    assert h5py.File(path)["values"].fletcher32
    bytes_ = bytearray(path.read_bytes())
    bytes_[bytes_.index(values.tobytes()[:64]) + 40] ^= 4
    path.write_bytes(bytes_)
    with h5py.File(path) as file, pytest.raises(OSError, match="filter returned failure"):
        file["values"][()]


def test_files_and_their_names_are_on_the_disk_when_they_are_there(tmp_path, monkeypatch):
    """fsync of the bytes comes before the name is given, that of the folder after it."""
    order, replace, fsync = [], os.replace, os.fsync

    def noted(handle: int) -> None:
        order.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        fsync(handle)

    monkeypatch.setattr(os, "replace", lambda a, b: (order.append("name"), replace(a, b)))
    monkeypatch.setattr(os, "fsync", noted)
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("a")
    assert order == ["file", "name", "folder"]
    order.clear()
    with atomic_folder(tmp_path / "b") as temporary:
        (temporary / "c.txt").write_text("c")
    assert order == ["file", "folder", "folder"]


def test_a_table_of_views_is_there_whole_or_not_at_all(tmp_path):
    """The disk is full in the middle of it, after the estimate."""
    path, count = tmp_path / "table.csv", 2000
    path.write_text("old")
    found = SimpleNamespace(changes=np.ones((count, 7)), errors=np.ones((count, 7)))
    for name in ("flux", "before", "after"):
        setattr(found, name, np.ones(count))
    with room_of(9000), pytest.raises(InputError, match=r"table\.csv must be writable"):
        _write_table(path, found)  # pyright: ignore[reportArgumentType]
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["table.csv"]
    _write_table(path, found)  # pyright: ignore[reportArgumentType]
    assert len(path.read_text().splitlines()) == count + 1


def test_a_preview_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    class Drawn:
        def savefig(self, path: Path) -> None:
            path.write_bytes(bytes(9000))

    monkeypatch.setattr("holosplat.report.light.phase_figure", lambda *_: Drawn())
    found = SimpleNamespace(light=SimpleNamespace(background=None), phase=SimpleNamespace(numpy=lambda: None))
    views = Views.evenly_spaced(SHAPE[0], SHAPE[1:], 1e-6)
    measured = SimpleNamespace(frames=None, views=views)
    with room_of(5000), pytest.raises(InputError, match=r"preview\.png must be writable"):
        _preview(tmp_path / "preview.png", measured, found)  # pyright: ignore[reportArgumentType]
    assert os.listdir(tmp_path) == []
