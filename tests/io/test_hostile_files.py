"""Files that nobody vouches for: refused in one sentence, before anything of another file or beyond memory is read."""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.io import guard, hdf5_guard, read_scan, write_scan
from holosplat.io.formats import read, read_as
from holosplat.io.guard import read_array, require_memory, xml_fault
from holosplat.io.reading import Reading, Told, read_angles
from holosplat.io.stacks import stack_of
from holosplat.io.vtk import read_meshes
from holosplat.scan import Exposures, Scan
from holosplat.tables import read_table

DATA = "entry/instrument/detector/data"
SHAPE = (2, 13, 17)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "good.nxs"
    frames = np.linspace(0.9, 1.1, int(np.prod(SHAPE)), dtype=np.float32).reshape(SHAPE)
    views = Views.evenly_spaced(SHAPE[0], SHAPE[1:], 1e-6)
    write_scan(path, Scan(frames, Exposures.of(views, 20.0, 0.1), np.zeros(SHAPE[0], dtype=bool)))
    return path


@pytest.fixture(autouse=True)
def nobody_is_vouched_for(monkeypatch):
    monkeypatch.setattr(hdf5_guard, "_vouched", set())


def evil(good: Path, folder: Path, make) -> Path:
    """`good` with other frames."""
    path = folder / "evil.nxs"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        del file[DATA]
        make(file)
    return path


def of_external_storage(file: h5py.File) -> None:
    file.create_dataset(DATA, SHAPE, "f4", external=[(str(Path(file.filename).parent / "secret"), 0, 2**30)])


def by_external_link(file: h5py.File) -> None:
    file[DATA] = h5py.ExternalLink("other.h5", "/a")


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:] = h5py.VirtualSource("other.h5", "a", SHAPE)
    file.create_virtual_dataset(DATA, layout)


@pytest.mark.parametrize("make", [of_external_storage, by_external_link, virtual])
def test_values_of_other_files_are_not_followed_unless_that_is_allowed(good, tmp_path, make):
    values = np.full(SHAPE, 0.75, dtype=np.float32)
    (tmp_path / "secret").write_bytes(values.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["a"] = values
    path = evil(good, tmp_path, make)
    with pytest.raises(
        InputError, match=r"evil\.nxs must hold its own values, but /entry/.* another file; .*--allow-ext"
    ):
        read_scan(path)
    allowed = Reading(Told(allow_external=True))
    assert np.array_equal(read_as(path, allowed).in_memory().frames, values)
    assert allowed.as_table() == {"allow_external": True}


@pytest.mark.parametrize(
    ("shape", "chunks", "said"),
    [((4_000_000, 1000, 2500), (1, 100, 100), "declares 4e"), ((10**12, 3, 3), (1000, 3, 3), "declares 3.6e")],
)
def test_declared_sizes_are_held_against_the_file(good, tmp_path, shape, chunks, said):
    path = evil(good, tmp_path, lambda file: file.create_dataset(DATA, shape, "f4", chunks=chunks))
    with pytest.raises(InputError, match=f"{said}.*, but holds .*damaged, or no honest file"):
        read_scan(path)


def test_well_packed_frames_are_no_lie(tmp_path):
    """All alike, as dark ones may be: deflate makes them a thousand times smaller."""
    with h5py.File(tmp_path / "dark.h5", "w") as file:
        frames = file.create_dataset("a", (20, 1000, 1000), "f4", chunks=(4, 1000, 1000), compression="gzip")
        for start in range(0, 20, 4):
            frames[start : start + 4] = 0
    with h5py.File(tmp_path / "dark.h5") as file:
        hdf5_guard.require_own(file, tmp_path / "dark.h5")


def test_nesting_and_numbers_of_entries_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "deep.h5"
    with h5py.File(path, "w") as file:
        file.create_group("/".join("a" * 100))
    with h5py.File(path) as file, pytest.raises(InputError, match="nested more than 64 deep"):
        hdf5_guard.require_own(file, path)
    monkeypatch.setattr(hdf5_guard, "MOST", 50)
    with h5py.File(path) as file, pytest.raises(InputError, match="at most 50 entries"):
        hdf5_guard.require_own(file, path)


def test_a_file_is_looked_through_once_and_again_where_it_changed(good, tmp_path, monkeypatch):
    """But one that changed within the last second each time: its times may not tell the next change."""
    path, looks, look = tmp_path / "scan.nxs", [], hdf5_guard._others
    shutil.copy(good, path)
    monkeypatch.setattr(hdf5_guard, "_known", {})
    monkeypatch.setattr(hdf5_guard, "_others", lambda *asked: looks.append(asked) or look(*asked))

    def opened() -> int:
        with h5py.File(path) as file:
            hdf5_guard.require_own(file, path)
        return len(looks)

    monkeypatch.setattr(hdf5_guard, "AGED", 10**15)
    assert (opened(), opened()) == (1, 2)
    monkeypatch.setattr(hdf5_guard, "AGED", 0)
    assert (opened(), opened()) == (3, 3)
    with h5py.File(path, "r+") as file:
        file["entry/elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    with pytest.raises(InputError, match="is a link to another file"):
        opened()


def test_what_memory_cannot_hold_is_refused_before_it_is_read():
    with pytest.raises(InputError, match=r"frames takes 1.15e\+09 GB, but this machine has"):
        require_memory("frames", 1 << 60)


@pytest.mark.parametrize("kind", ["pipe", "folder", "nothing", "loop"])
def test_only_regular_files_are_opened(tmp_path, kind):
    """A named pipe would be waited for without end."""
    path = tmp_path / "table.json"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    for reader in (read_table, read_angles, lambda p: read_meshes([p], "um"), stack_of):
        with pytest.raises(InputError, match=r"must (be|hold)"):
            reader(path)


@pytest.mark.parametrize(("name", "text"), [("a.json", '{"a": ' + "[" * 100_000), ("a.toml", "a = " + "[" * 100_000)])
def test_tables_are_not_nested_without_end(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match="nested too deeply"):
        read_table(path)


def test_meshes_declare_what_they_hold(tmp_path):
    """VTK itself would ask for the memory, and abort; or descend into tags until its stack ends."""
    head, tail = '<VTKFile type="PolyData"><PolyData>', "</PolyData></VTKFile>"
    counts = '<Piece NumberOfPoints="1000000000000" NumberOfPolys="1"></Piece>'
    deep = "<a>" * 100_000 + "</a>" * 100_000
    for inner, said in ((counts, "declares 1000000000000 points"), (deep, "nested more than 64 deep")):
        (tmp_path / "evil.vtp").write_text(head + inner + tail)
        with pytest.raises(InputError, match=said):
            read_meshes([tmp_path / "evil.vtp"], "um")
    assert xml_fault(b"<VTKFile>" + b"<a><b/></a>" * 1000 + b"<AppendedData>_" + b"<x>" * 100) == ""


def test_an_image_is_what_its_name_says(tmp_path):
    """A PostScript file that is called .png is not given to an interpreter."""
    path = tmp_path / "r_0000.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\nshowpage\n")
    with pytest.raises(InputError, match="must be a complete image, but it is damaged or none"):
        stack_of(path)


def test_pages_in_a_circle_end(tmp_path):
    path = tmp_path / "circle.tif"
    tifffile.imwrite(path, np.zeros(SHAPE, dtype=np.float32), photometric="minisblack", metadata=None)
    content = bytearray(path.read_bytes())
    first = struct.unpack_from("<I", content, 4)[0]
    following = first + 2 + 12 * struct.unpack_from("<H", content, first)[0]
    second = struct.unpack_from("<I", content, following)[0]
    struct.pack_into("<I", content, second + 2 + 12 * struct.unpack_from("<H", content, second)[0], first)
    path.write_bytes(content)
    with pytest.raises(InputError, match="they run in a circle"):
        stack_of(path)


def test_arrays_declare_what_they_hold(tmp_path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**4, 1000)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(100))
    with pytest.raises(InputError, match=r"a\.npy must be a NumPy array .*it declares 4e\+13 bytes"):
        stack_of(path)


def test_an_array_in_a_file_with_holes_is_held_against_the_memory(tmp_path, monkeypatch):
    """Such a file is as long as it says, and takes nothing of the disk."""
    np.save(tmp_path / "a.npy", np.zeros(500))
    assert read_array(tmp_path / "a.npy", "numbers").size == 500
    monkeypatch.setattr(guard, "machine_memory", lambda: 3999)
    with pytest.raises(InputError, match=r"a\.npy takes 4e-06 GB, but this machine has 4e-06 GB of memory for it"):
        read_array(tmp_path / "a.npy", "numbers")


def test_archives_declare_what_they_hold(tmp_path):
    """A directory that says more than deflate can pack."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, counts=np.zeros(SHAPE, dtype=np.float32))
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 24, 0xFFFFFFF0)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npz declares 4\.29e\+09 bytes of values, but holds"):
        read(path)


def test_hidden_files_are_nobodys_frames_or_bodies(tmp_path):
    """What a killed process was writing."""
    tifffile.imwrite(tmp_path / "a.tif", np.zeros(SHAPE[1:], dtype=np.float32))
    shutil.copy(tmp_path / "a.tif", tmp_path / ".b~0123abcd-1-0123abcd.tif")
    assert stack_of(tmp_path).shape == (1, *SHAPE[1:])
    (tmp_path / ".cell00.vtk").write_text("")
    with pytest.raises(InputError, match="holds none"):
        read_meshes([tmp_path], "um")
