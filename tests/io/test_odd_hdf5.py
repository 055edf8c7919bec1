"""Odd HDF5 files of real users: read right, or refused by name, and never silently taken for what they are not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.odd_files import SHAPE, N, a_scan
from holosplat.checks import InputError, MissingError
from holosplat.io.formats import read_as
from holosplat.io.hdf5 import open_hdf5
from holosplat.io.hdf5_guard import filters_missing_in
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.reading import Reading, Told


def virtual(path: Path, layout: h5py.VirtualLayout) -> Path:
    write_scan(path, a_scan())
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"], file["entry/data/data"]
        file.create_virtual_dataset("entry/instrument/detector/data", layout)
    return path


@pytest.mark.parametrize(("held", "mapped", "empty"), [(N, N, 0), (N, 5, 3), (5, N, 3), (0, N, N)])
def test_virtual_frames_without_data_are_refused(tmp_path, held, mapped, empty):
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["data" if held else "other"] = a_scan().frames[: held or N]
    layout = h5py.VirtualLayout((N, *SHAPE), np.float32)
    layout[:mapped] = h5py.VirtualSource("raw.h5", "data", (N, *SHAPE))[:mapped]
    path = virtual(tmp_path / "scan.nxs", layout)
    told = Told(allow_external=True)
    if not empty:
        np.testing.assert_array_equal(read_as(path, Reading(told)).frames, a_scan().frames)
        return
    with pytest.raises(InputError, match=f"for {empty} of {N} it has none"):
        read_as(path, Reading(told))
    if empty < N:
        left = read_as(path, Reading(Told(allow_external=True, leave_out="5:8")))
        np.testing.assert_array_equal(left.frames, a_scan().frames[:5])


def test_virtual_frames_of_the_file_itself_are_its_own(tmp_path):
    layout = h5py.VirtualLayout((N, *SHAPE), np.float32)
    layout[:] = h5py.VirtualSource(".", "raw", (N, *SHAPE))
    path = virtual(tmp_path / "scan.nxs", layout)
    with h5py.File(path, "a") as file:
        file["raw"] = a_scan().frames
    np.testing.assert_array_equal(read_as(path, Reading()).frames, a_scan().frames)


def test_frames_that_were_never_written_are_refused(tmp_path):
    write_scan(tmp_path / "a.nxs", a_scan())
    with h5py.File(tmp_path / "a.nxs", "a") as file:
        del file["entry/instrument/detector/data"], file["entry/data/data"]
        data = file.create_dataset("entry/instrument/detector/data", (N, *SHAPE), "f4", chunks=(2, *SHAPE))
        data[:5] = a_scan().frames[:5]
    with pytest.raises(InputError, match=r"for 2 of 8 it has none \(6, 7, counted from 0\): they were never written"):
        read_as(tmp_path / "a.nxs", Reading())
    assert len(read_as(tmp_path / "a.nxs", Reading(Told(leave_out="6:8")))) == 6
    with h5py.File(tmp_path / "raw.h5", "w") as file:  # the same as the source of another
        data = file.create_dataset("data", (N, *SHAPE), "f4", chunks=(1, *SHAPE))
        data[:5] = 1.0
    layout = h5py.VirtualLayout((N, *SHAPE), np.float32)
    layout[:] = h5py.VirtualSource("raw.h5", "data", (N, *SHAPE))
    with pytest.raises(InputError, match="for 3 of 8 it has none"):
        read_as(virtual(tmp_path / "b.nxs", layout), Reading(Told(allow_external=True)))


def test_gaps_between_modules_are_defective_pixels(tmp_path, caplog):
    caplog.set_level("INFO")
    layout = h5py.VirtualLayout((N, *SHAPE), np.float32)
    for columns in (slice(0, 11), slice(12, 24)):
        width = columns.stop - columns.start
        with h5py.File(tmp_path / f"{columns.start}.h5", "w") as file:
            file["data"] = a_scan().frames[:, :, columns]
        layout[:, :, columns] = h5py.VirtualSource(f"{columns.start}.h5", "data", (N, SHAPE[0], width))
    scan = read_as(virtual(tmp_path / "scan.nxs", layout), Reading(Told(allow_external=True)))
    np.testing.assert_allclose(scan.frames, a_scan().frames, atol=3e-3)
    assert f"pixels that no source fills ({SHAPE[0]}) count as defective" in caplog.text


@pytest.mark.parametrize(("version", "swmr"), [("earliest", False), ("latest", False), ("latest", True)])
def test_a_file_that_another_program_writes_is_read_as_it_is(tmp_path, caplog, version, swmr):
    path = tmp_path / "a.nxs"
    write_scan(path, a_scan())
    code = f"""
import h5py, os
old = h5py.File({str(path)!r}, "r+")
file = h5py.File({str(tmp_path / "b.nxs")!r}, "w", libver={version!r})
old.copy("entry", file)
file.flush()
if {swmr}:
    file.swmr_mode = True
print("open", flush=True)
input()
os._exit(9)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        if version == "latest" and not swmr:
            with pytest.raises(InputError, match=r"b\.nxs must be closed, but another program has it open"):
                read_scan(tmp_path / "b.nxs")
        else:
            np.testing.assert_array_equal(read_scan(tmp_path / "b.nxs").frames, a_scan().frames)
            assert "b.nxs is open for writing elsewhere" in caplog.text
        writer.communicate(b"\n")
    if swmr:  # left open
        np.testing.assert_array_equal(read_scan(tmp_path / "b.nxs").frames, a_scan().frames)


def test_filters_that_are_plugins_are_named(tmp_path, monkeypatch):
    path = tmp_path / "scan.nxs"
    write_scan(path, a_scan())
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    monkeypatch.setattr("holosplat.io.hdf5_guard.h5z.filter_avail", lambda code: False)
    assert "fletcher32 (number 3)" in filters_missing_in(path)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *_: (_ for _ in ()).throw(OSError("no filter")))
    with pytest.raises(MissingError, match=r"filters that HDF5 does not have here: fletcher32 .*holosplat\[codecs\]"):
        _ = read_scan(path).frames


def test_a_lack_of_memory_is_not_called_damage(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["a"] = np.ones(3)
    with pytest.raises(MemoryError, match="memory allocation failed"), open_hdf5(path):
        raise OSError("Can't synchronously read data (memory allocation failed for chunk)")
