"""Files that an HDF5 file brings values of, where that is allowed, and its chunks: each is looked at as the file is."""

from __future__ import annotations

import errno
import os
import resource
import zlib
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.io import hdf5_guard, room
from holosplat.io.hdf5 import open_hdf5

SHAPE = (3, 5, 7)
VALUES = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """Where all files are allowed to bring values of others."""
    monkeypatch.setattr(hdf5_guard, "_vouched", {tmp_path.resolve()})
    return tmp_path


def linking(path: Path, target: str) -> Path:
    with h5py.File(path, "w") as file:
        file["a"] = h5py.ExternalLink(target, "/a")
    return path


def virtual(path: Path, target: str, shape: tuple[int, ...] = SHAPE) -> Path:
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout(shape, "f4")
        layout[: SHAPE[0]] = h5py.VirtualSource(target, "a", SHAPE)
        file.create_virtual_dataset("a", layout)
    return path


def stored(path: Path, target: str, shape: tuple[int, ...] = SHAPE) -> Path:
    with h5py.File(path, "w") as file:
        file.create_dataset("a", shape, "f4", external=[(target, 0, h5py.h5f.UNLIMITED)])
    return path


def holding(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["a"] = VALUES
    return path


def read(path: Path) -> np.ndarray:
    with open_hdf5(path) as file:
        return np.asarray(file["a"])


def test_masters_of_masters_are_followed_and_circles_end(folder, monkeypatch):
    """A master file with links, to one with a virtual dataset, to frames; one of the files links back."""
    holding(folder / "frames.h5")
    virtual(folder / "scan.h5", "frames.h5")
    master = linking(folder / "master.h5", "scan.h5")
    with h5py.File(folder / "frames.h5", "r+") as file:
        file["back"] = h5py.ExternalLink("master.h5", "/a")
    assert np.array_equal(read(master), VALUES)
    monkeypatch.setattr(hdf5_guard, "MOST_FILES", 2)
    with pytest.raises(InputError, match=r"master\.h5 must bring values of at most 2 files"):
        read(master)


@pytest.mark.parametrize("make", [linking, virtual, stored])
def test_a_pipe_is_not_waited_for(folder, make):
    os.mkfifo(folder / "pipe")
    path = make(folder / "a.h5", str(folder / "pipe") if make is stored else "pipe")
    with pytest.raises(InputError, match=r"a\.h5: /a, but it is a pipe or a device"):
        read(path)


@pytest.mark.parametrize("make", [linking, virtual, stored])
def test_a_file_that_is_not_there_is_named(folder, make):
    with pytest.raises(InputError, match=r"a\.h5: /a has its values in gone\.h5, which is neither there nor beside it"):
        read(make(folder / "a.h5", "gone.h5"))


@pytest.mark.parametrize("make", [linking, virtual])
def test_what_is_no_hdf5_file_or_declares_too_much_is_refused(folder, make):
    path = make(folder / "a.h5", "other.h5")
    (folder / "other.h5").write_text("words")
    with pytest.raises(InputError, match=r"other\.h5, of which .*a\.h5 brings values, must be a complete HDF5 file"):
        read(path)
    with h5py.File(folder / "other.h5", "w") as file:
        file.create_dataset("a", (10**12, 5, 7), "f4", chunks=(1000, 5, 7))
    with pytest.raises(InputError, match=r"other\.h5: /a declares 1\.4e\+14 bytes"):
        read(path)


@pytest.mark.parametrize("make", [virtual, stored])
def test_more_values_than_other_files_hold_are_refused(folder, make):
    other = holding(folder / "other.h5")
    path = make(folder / "a.h5", str(other), (10**9, 5, 7))
    with pytest.raises(InputError, match=r"a\.h5: /a declares 1\.4e\+11 bytes of values, but"):
        read(path)


def test_a_series_of_sources_is_looked_at_whole(folder):
    """`%b` stands for the number of a block: no file of that name is there."""
    holding(folder / "part_0.h5")
    path, unlimited = folder / "a.h5", h5py.h5s.UNLIMITED
    whole = h5py.h5s.create_simple(SHAPE, (unlimited, *SHAPE[1:]))
    whole.select_hyperslab((0, 0, 0), (unlimited, 1, 1), SHAPE, SHAPE)
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_virtual(whole, b"part_%b.h5", b"a", h5py.h5s.create_simple(SHAPE))
    with h5py.File(path, "w") as file:
        space = h5py.h5s.create_simple(SHAPE, (unlimited, *SHAPE[1:]))
        h5py.h5d.create(file.id, b"a", h5py.h5t.IEEE_F32LE, space, plan)
    with open_hdf5(path):
        pass
    os.mkfifo(folder / "part_17.h5")
    with pytest.raises(InputError, match=r"a\.h5: /a, but it is a pipe"):
        read(path)


# --- chunks -------------------------------------------------------------------------------------------------

CHUNK = (64, 1024)


def bomb(path: Path, unpacked: int, **filters: object) -> Path:
    """A chunk of 256 kB as declared, which unpacks to `unpacked` bytes."""
    with h5py.File(path, "w") as file:
        frames = file.create_dataset("a", CHUNK, "f4", chunks=CHUNK, compression="gzip", **filters)
        frames.id.write_direct_chunk((0, 0), zlib.compress(bytes(unpacked)))
    return path


@pytest.fixture
def no_room(monkeypatch):
    """So little memory that every chunk is looked into."""
    monkeypatch.setattr(hdf5_guard, "SMALL", 1000)
    monkeypatch.setattr(hdf5_guard, "free_memory", lambda: 1000)
    monkeypatch.setattr(hdf5_guard, "PIECE", 1 << 14)


@pytest.mark.parametrize("filters", [{}, {"shuffle": True}])
def test_chunks_unpack_to_no_more_than_they_declare(folder, no_room, filters):
    whole = 4 * CHUNK[0] * CHUNK[1]
    with open_hdf5(bomb(folder / "good.h5", whole, **filters)):
        pass
    with (
        pytest.raises(InputError, match=rf"bad\.h5: /a unpacks to more than the {whole} bytes"),
        open_hdf5(bomb(folder / "bad.h5", whole + 1, **filters)),
    ):
        pass


def test_what_cannot_exceed_memory_is_not_unpacked_twice(folder, monkeypatch):
    monkeypatch.setattr(hdf5_guard, "_require_unpacked", lambda *_: pytest.fail("unpacked"))
    with open_hdf5(bomb(folder / "a.h5", 5 * CHUNK[0] * CHUNK[1])):
        pass


def test_damaged_chunks_are_found(folder, no_room):
    path = bomb(folder / "a.h5", 10**5)
    with h5py.File(path, "r+") as file:
        file["a"].id.write_direct_chunk((0, 0), b"\x78\x9c" + bytes(3000))
    with pytest.raises(InputError, match=r"a\.h5: /a must be deflated, but it is damaged"), open_hdf5(path):
        pass


def test_chunks_are_deflated_once(folder):
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk(CHUNK)
    plan.set_deflate(4)
    plan.set_filter(h5py.h5z.FILTER_DEFLATE, 0, (4,))
    with h5py.File(folder / "a.h5", "w") as file:
        h5py.h5d.create(file.id, b"a", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple(CHUNK), plan)
    with pytest.raises(InputError, match=r"a\.h5: /a must be deflated once"), open_hdf5(folder / "a.h5"):
        pass


# --- memory and disk ----------------------------------------------------------------------------------------


@pytest.fixture
def machine(folder, monkeypatch) -> Path:
    """A machine of 8 GB, of which 6 are free, and a process in two nested control groups."""
    for name in ("proc/self", "groups/memory/cluster/job"):
        (folder / name).mkdir(parents=True)
    (folder / "proc/meminfo").write_text("MemTotal: 8000000 kB\nMemAvailable: 6000000 kB\n")
    (folder / "proc/self/status").write_text("VmSize: 1000000 kB\n")
    monkeypatch.setattr(room, "PROC", folder / "proc")
    monkeypatch.setattr(room, "CGROUPS", folder / "groups")
    monkeypatch.setattr(room, "_physical", lambda: 8_192_000_000)
    return folder


def group(path: Path, names: tuple[str, str, str], limit: object, used: int, cached: int) -> None:
    (path / names[0]).write_text(str(limit))
    (path / names[1]).write_text(str(used))
    (path / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\n")


def test_memory_is_that_of_the_machine(machine):
    assert room.machine_memory() == 8_192_000_000
    assert room.free_memory() == 6_000_000 * 1024


@pytest.mark.parametrize("version", [1, 2])
def test_memory_is_that_of_the_control_groups(machine, version):
    """The group above leaves less: 3 GB less the 2 in use, of which .5 only cache files."""
    if version == 1:
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_cache")
        place, line = machine / "groups/memory/cluster", "4:cpu,memory:/cluster/job\n"
    else:
        names = ("memory.max", "memory.current", "file")
        place, line = machine / "groups/memory/cluster", "0::/memory/cluster/job\n"
    (machine / "proc/self/cgroup").write_text(f"7:cpuset:/other\n{line}")
    group(place / "job", names, "max" if version == 2 else 2**63 - 4096, 10**9, 0)
    group(place, names, 3 * 10**9, 2 * 10**9, 5 * 10**8)
    assert room.machine_memory() == 3 * 10**9
    assert room.free_memory() == 15 * 10**8
    assert room.left_by_limits() == (room.UNLIMITED, 15 * 10**8)


def test_memory_is_that_of_the_address_space(machine, monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (4 * 10**9, 8 * 10**9))
    assert (room.machine_memory(), room.free_memory()) == (4 * 10**9, 4 * 10**9 - 1_024_000_000)
    assert room.left_by_limits() == (4 * 10**9 - 1_024_000_000, room.UNLIMITED)


def test_room_on_the_disk_is_that_of_the_folder_above(folder, monkeypatch):
    free = {folder.resolve(): SimpleNamespace(free=17)}
    monkeypatch.setattr(room.shutil, "disk_usage", free.__getitem__)
    assert room.free_disk(folder / "not" / "yet") == 17


def test_a_file_system_without_locks_is_read(folder, monkeypatch, caplog):
    """What HDF5 says there, and of a file that another program writes, which is said; any other failure is one."""
    path, whole = virtual(folder / "a.h5", str(holding(folder / "b.h5"))), h5py.File
    said = f"unable to lock file, errno = {errno.ENOLCK}, error message = 'No locks available'"

    def unlocked(*args, locking: bool = True, **kwargs):
        if locking:
            raise OSError(said)
        return whole(*args, locking=False, **kwargs)

    monkeypatch.setattr(h5py, "File", unlocked)
    assert np.array_equal(read(path), VALUES)
    assert not caplog.records
    said = "unable to lock file, errno = 11, error message = 'Resource temporarily unavailable'"
    assert np.array_equal(read(path), VALUES)
    assert "a.h5 is open for writing elsewhere" in caplog.text
    said = "unable to lock file, errno = 5, error message = 'Input/output error'"
    with pytest.raises(InputError, match="Input/output error"):
        read(path)
