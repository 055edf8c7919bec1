"""Files that declare, or unpack to, more than they hold: one sentence before anything is allocated."""

from __future__ import annotations

import base64
import io
import json
import zipfile
import zlib

import numpy as np
import pytest
import tifffile
import torch

from holosplat.beamline.grow import Growth, SeriesFolder
from holosplat.beamline.misalignment import Directions
from holosplat.checks import InputError, as_written
from holosplat.io.guard import blocks_fault, read_array, require_inflated
from holosplat.io.images import _pages
from holosplat.io.stacks import stack_of
from holosplat.io.vtk import read_meshes
from holosplat.workflows.run_folder import RunFolder

HUGE = 10**12
LEGACY = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n"


def header_of(shape: tuple[int, ...], held: int) -> bytes:
    """A .npy file that declares `shape`, and holds so many bytes."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue() + bytes(held)


@pytest.mark.parametrize("shape", [(HUGE, 3, 3), (4, 3, 3), (1 << 62, 3, 3)])
def test_rotations_declare_what_they_hold(tmp_path, shape):
    path = tmp_path / "r.npy"
    path.write_bytes(header_of(shape, 100))
    with pytest.raises(InputError, match=r"r\.npy must be rotation matrices .* damaged or none"):
        Directions(rotations=path).on((5, 13), 1e-6)


def test_an_array_is_read_whole(tmp_path):
    values = np.random.default_rng(1).normal(size=(2, 3, 5))
    np.save(tmp_path / "a.npy", values)
    assert np.array_equal(read_array(tmp_path / "a.npy", "an array"), values)


def test_archives_declare_what_their_arrays_hold(tmp_path):
    """The state of grow: numpy itself asks for the memory of a header before it looks for values."""
    growth = Growth(cells=1, frequency=3)
    folder = SeriesFolder(tmp_path)
    with zipfile.ZipFile(folder.state, "w") as archive:
        archive.writestr("nodes.npy", header_of((HUGE, 3), 10))
    with pytest.raises(InputError, match="damaged"):
        folder.read_state(growth, growth.suspension())


@pytest.mark.parametrize("numbers", [[0.1, 0.0], [0.1, -1.0], [-1.0, 0.1], [0.1, np.inf], [np.nan, 0.1], [0.1]])
def test_a_state_has_a_step_ahead(tmp_path, numbers):
    """A step of zero would be taken without end."""
    growth = Growth(cells=1, frequency=3)
    suspension, folder = growth.suspension(), SeriesFolder(tmp_path)
    nodes = np.zeros((1, len(suspension.membrane.mesh.vertices), 3))
    np.savez(folder.state, nodes=nodes, numbers=np.array([0.1, 0.2]), counts=np.array([0, 1, 0]))
    assert folder.read_state(growth, suspension) is not None
    np.savez(folder.state, nodes=nodes, numbers=np.array(numbers), counts=np.array([0, 1, 0]))
    with pytest.raises(InputError, match="start anew"):
        folder.read_state(growth, suspension)


def test_strips_unpack_to_what_they_declare(tmp_path, monkeypatch):
    """A deflated strip of an image of a few pixels that would fill the memory."""
    monkeypatch.setattr("holosplat.io.stacks.SMALL", 1000)
    path, image = tmp_path / "a.tif", np.zeros((5, 7), dtype=np.float32)
    tifffile.imwrite(path, image, compression="zlib")
    assert np.array_equal(_pages(path, 1)[0], image)
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        place, tag = page.dataoffsets[0], page.tags["StripByteCounts"].valueoffset
    bomb, content = zlib.compress(bytes(1 << 20)), bytearray(path.read_bytes())
    content[tag : tag + 4] = len(bomb).to_bytes(4, "little")
    path.write_bytes(content[:place] + bomb + content[place:])
    for reader in (lambda: _pages(path, 1), lambda: stack_of(path)):
        with pytest.raises(InputError, match="unpacks to more than the"):
            reader()


def test_what_is_no_deflate_is_left_to_others():
    require_inflated("x", b"no deflate", 10)
    require_inflated("x", zlib.compress(bytes(10)), 10)
    with pytest.raises(InputError, match="more than the 9 bytes"):
        require_inflated("x", zlib.compress(bytes(10)), 9)


def test_pages_declare_what_they_hold(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((5, 7), dtype=np.float32))
    with tifffile.TiffFile(path) as file:
        places = [file.pages[0].tags[name].valueoffset for name in ("ImageWidth", "ImageLength")]
    content = bytearray(path.read_bytes())
    for place in places:
        content[place : place + 2] = (60_000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"declares 1\.44e\+10 bytes of values, but holds"):
        stack_of(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.vtk", f"{LEGACY}POINTS {HUGE} float\n0 0 0\n"),
        ("a.vtk", f"{LEGACY}POINTS 1 float\n0 0 0\nPOINT_DATA 1\nFIELD x 1\nevil 3 {HUGE} double\n0\n"),
        ("a.vtk", f"{LEGACY}POINTS 1 float\n0 0 0\nPOLYGONS 1 {HUGE}\n"),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex {HUGE}\nproperty float x\nend_header\n0\n"),
        ("a.vtp", '<VTKFile type="PolyData"><PolyData NumberOfComponents="70000"/></VTKFile>'),
        (
            "a.vtp",
            f'<VTKFile type="PolyData"><!--<AppendedData--><P NumberOfPoints="{HUGE}"/><AppendedData/></VTKFile>',
        ),
    ],
)
def test_meshes_of_all_kinds_declare_what_they_hold(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match="declares"):
        read_meshes([tmp_path / name], "um")


@pytest.mark.parametrize("raw", [True, False])
def test_compressed_blocks_declare_what_they_hold(raw):
    """VTK makes room for a block before it unpacks it."""
    head = (
        b'<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64" compressor="vtkZLibDataCompressor">'
    )
    for size, fault in ((100, False), (1 << 50, True)):
        blocks = np.array([1, size, 0, 20], dtype="<u8").tobytes()
        inside = b'<DataArray format="binary">' + base64.b64encode(blocks) + b"</DataArray>"
        encoding, text = (b"raw", blocks) if raw else (b"base64", base64.b64encode(blocks))
        beside = b'<DataArray format="appended" offset="0"/><AppendedData encoding="' + encoding + b'">_' + text
        assert bool(blocks_fault(head + inside)) == fault
        assert bool(blocks_fault(head + beside)) == fault


@pytest.mark.parametrize("state", [{"stage": -1}, {"fit": {"step": -5}}, {"timing": {"seconds": float("nan")}}, ["x"]])
def test_checkpoints_count_up(tmp_path, state):
    folder = RunFolder(tmp_path / "run")
    folder.begin({})
    folder.save_checkpoint({"stage": 0, "fit": {"step": 5, "best": float("inf")}})
    assert folder.load_checkpoint()["stage"] == 0
    torch.save({"run": folder.name(), "state": state}, folder.checkpoint)
    with pytest.raises(InputError, match=r"checkpoint\.pt must be a checkpoint, but it"):
        folder.load_checkpoint()


@pytest.mark.parametrize("value", [5, "x", [], None])
def test_parts_of_a_run_are_tables(tmp_path, value):
    folder = RunFolder(tmp_path / "run")
    folder.begin({"method": {}})
    folder.config.write_text(json.dumps({"method": value}))
    with pytest.raises(InputError, match="method is no table"):
        folder.read_config()


def test_what_we_wrote_is_named_when_it_is_garbled(tmp_path):
    with pytest.raises(InputError, match=r"a\.json must be .*, but it lacks or garbles 'x'"), as_written("a.json"):
        {}["x"]
    with pytest.raises(RuntimeError, match="not enough memory"), as_written("a.json"):
        raise RuntimeError("not enough memory: you tried to allocate")
