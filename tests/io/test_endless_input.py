"""Input that would take hours, gigabytes, or never end, and numbers of hundreds of digits: refused in one sentence."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from safetensors.torch import save

from helpers.cli import holosplat, worked
from holosplat.checks import InputError, positive
from holosplat.geometry import Grid
from holosplat.io.beams import MOST_VIEWS, read_beams
from holosplat.io.formats import read_volume_file
from holosplat.io.larger_frames import Tube
from holosplat.io.lock import LOCK, sole_writer, writer_of
from holosplat.io.ome import read_ome_tiff, write_ome_tiff
from holosplat.io.paraview import find_snapshots, read_pvd
from holosplat.io.reading import Reading, ends_of, marked, read_angles
from holosplat.io.stacks import all_images, stack_of
from holosplat.io.table import Table
from holosplat.io.vtk import read_meshes
from holosplat.learning.start import read_weights
from holosplat.matter import MaterialPrior
from holosplat.methods import Gaussians
from holosplat.ranges import COUNT, with_checked_numbers
from holosplat.series.folder import PLAN, SeriesFolder
from holosplat.series.plan import MOST_TIMES, Cut, SeriesPlan, Settings, Source
from holosplat.tables import overridden, read_table
from holosplat.volume import Volume
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.track import TRACKS, read_errors
from holosplat_bench.opponents.fields.weights import read_aligned

DIGITS = "1" + 399 * "0"
LONGER = "1" + 4999 * "0"


@pytest.fixture
def circle(tmp_path) -> Path:
    """A TIFF file whose first page points to itself."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.ones((2, 5, 7), "f4"), photometric="minisblack", metadata=None)
    content = bytearray(path.read_bytes())
    first = struct.unpack_from("<I", content, 4)[0]
    entries = struct.unpack_from("<H", content, first)[0]
    struct.pack_into("<I", content, first + 2 + 12 * entries, first)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("read", [stack_of, all_images])
def test_pages_that_run_in_a_circle_end(circle, read):
    with pytest.raises(InputError, match="but they run in a circle"):
        read(circle)


def test_pipes_in_the_place_of_files_of_a_run_are_not_waited_for(tmp_path):
    for name in ("metrics.csv", TRACKS, "cell_000.vtk", LOCK):
        os.mkfifo(tmp_path / name)
    folder = RunFolder(tmp_path)
    for read in (
        lambda: folder.start_metrics(["step"], keep_until=1),
        lambda: read_errors(folder),
        lambda: find_snapshots([tmp_path / "cell_000.vtk"]),
    ):
        with pytest.raises(InputError, match="but it is a pipe or a device"):
            read()
    assert writer_of(tmp_path) is not None
    with pytest.raises(InputError, match="must have one writer"), sole_writer(tmp_path):
        raise AssertionError("it must not begin")


def test_a_geometry_has_as_many_views_as_can_be_read(tmp_path):
    views = "\n".join("[[view]]\nangle_deg = 0.0" for _ in range(MOST_VIEWS + 1))
    (tmp_path / "a.toml").write_text(f'format = "holosplat geometry 1"\n{views}\n')
    with pytest.raises(InputError, match=f"must have at most {MOST_VIEWS} views, but it has {MOST_VIEWS + 1}"):
        read_beams(tmp_path / "a.toml")


@pytest.mark.parametrize("text", ["[[a]]\n" * 1_000_001, f"a = [{'{},' * 1_000_001}]"])
def test_tables_without_end_are_refused_before_they_are_parsed(tmp_path, monkeypatch, text):
    monkeypatch.setattr("tomllib.loads", lambda _: pytest.fail("it was parsed"))
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match="entries, and at most 2000000 are read"):
        read_table(tmp_path / "a.toml")


def test_json_without_end_is_refused_before_it_is_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr("json.loads", lambda *_, **__: pytest.fail("it was parsed"))
    (tmp_path / "a.json").write_text("[" + "1," * 2_000_001)
    with pytest.raises(InputError, match="entries, and at most 2000000 are read"):
        read_table(tmp_path / "a.json")


@pytest.mark.parametrize(
    "text", [".".join(["a"] * 50_000) + " = 1", f"[{' . '.join(['a'] * 50_000)}]", "a = " + "[" * 50_000]
)
def test_tables_that_are_nested_too_deeply_are_refused(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match="but it is nested too deeply; make it flat"):
        read_table(tmp_path / "a.toml")


def test_a_series_has_as_many_times_as_can_be_looked_at(tmp_path):
    source = Source(tmp_path, (0.0,) * (MOST_TIMES + 1), "", MaterialPrior.unknown())
    plan = SeriesPlan((source,), Settings("reconstruct", Gaussians()), Reading(), Cut(window=16))
    (tmp_path / PLAN).write_text(json.dumps(plan.as_table()))
    with pytest.raises(InputError, match=f"at most {MOST_TIMES} times, but these are {MOST_TIMES + 1}"):
        SeriesFolder(tmp_path).plan()


SIZES = [
    {"image": [16] * 100_000, "features": 12, "volume": [16, 40]},
    {"image": [16, 10**9], "features": 12, "volume": [16, 40]},
    {"image": [16, int(DIGITS)], "features": 12, "volume": [16, 40]},
    {"image": [16, "x"]},
    [],
]
CARDS = [
    {"typical_misfit": {"two": 1.0}},
    {"typical_misfit": {"2": "x"}},
    {"scores": {"2": 3}},
    {"scores": []},
    {"trained_on": {"kinds": [[1]]}},
    {"limits": 3},
    {"unknown": 3},
    [],
]


@pytest.mark.parametrize("what", [{"size": size} for size in SIZES] + [{"card": card} for card in CARDS])
def test_weights_say_a_size_and_a_card_that_they_can_have(tmp_path, what):
    said = {"size": json.dumps({"image": [2, 2], "volume": [2, 2]}), "card": "{}"}
    said |= {name: json.dumps(value) for name, value in what.items()}
    tensors = {"a": torch.ones(40, 40)}
    for version, read in (("1", read_weights), ("aligned 1", lambda path: read_aligned(path, "onix"))):
        path = tmp_path / f"{version}.safetensors"
        path.write_bytes(save(tensors, said | {"holosplat": version, "network": "onix"}))
        with pytest.raises(InputError, match=r"\.safetensors"):
            read(path)


@pytest.mark.parametrize("digits", [DIGITS, LONGER])
def test_numbers_of_hundreds_of_digits_are_refused_everywhere(tmp_path, digits):
    """In files, options, and settings by their path."""
    for name, text in (
        ("a.json", f'{{"a": {digits}}}'),
        ("a.toml", f"a = [-{digits}]"),
        ("b.json", f'{{"a": [{digits}.]}}'),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=name):
            Table.read(tmp_path / name).numbers("a", (1,))
    for assignment in (f"fit.steps={digits}", f"spacing_px={digits}", f"fit.steps=[{digits}]"):
        with pytest.raises(InputError):
            overridden(Gaussians(), [assignment])
    (tmp_path / "angles.txt").write_text(digits)
    (tmp_path / "a.pvd").write_text(
        '<VTKFile type="Collection"><Collection>'
        f'<DataSet timestep="{digits}" file="angles.txt"/></Collection></VTKFile>'
    )
    for read in (
        lambda: marked("--views", digits, 3),
        lambda: marked("--views", f"0:{digits}", 3),
        lambda: ends_of("energy_kev", f"1:{digits}"),
        lambda: ends_of("energy_kev", "1:x"),
        lambda: Tube.parsed(f"1:{digits}:3"),
        lambda: Tube.parsed("1:2:x"),
        lambda: read_angles(tmp_path / "angles.txt"),
        lambda: read_pvd(tmp_path / "a.pvd"),
        lambda: positive("--peak", digits),
    ):
        with pytest.raises(InputError):
            read()


def test_options_of_hundreds_of_digits_are_refused():
    assert COUNT.fault(int(DIGITS)).startswith("must be at most")
    with pytest.raises(InputError, match=r"--seed must be at most .*, but it is a number of 400 digits"):
        with_checked_numbers(_seeded)(int(DIGITS))
    with pytest.raises(InputError, match="must be a positive number"):
        positive("a", int(DIGITS))


def _seeded(seed: int) -> None:
    raise AssertionError(seed)


SUFFIXES = (".nxs", ".tif", ".vtk", ".vti", ".vtu", ".pvd", ".nrrd", ".mrc", ".h5", ".npz", ".png", ".stl", ".zip", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_pipes_in_the_place_of_a_file_of_any_format_are_not_waited_for(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    os.mkfifo(path)
    assert holosplat("info", path).code in (0, 2)
    for read in (read_meshes, read_volume_file, read_pvd):
        with pytest.raises(InputError):
            read(*([path, "um"] if read is read_meshes else [path]))


@pytest.mark.parametrize(
    "content", [b"PK\x05\x06" + b"\xff" * 18, b"PK\x05\x06" + bytes(18), b"PK\x05\x06" + b"\1" * 18]
)
def test_archives_that_are_damaged_are_told_of(tmp_path, content):
    path = tmp_path / "a.zip"
    path.write_bytes(content)
    assert "nothing that can be read" in worked(holosplat("info", path)).out


def test_an_ome_tiff_of_hundreds_of_digits_is_none(tmp_path):
    grid = Grid.centred((2, 3, 4), 1e-6)
    values = np.zeros(grid.shape, np.float32)
    write_ome_tiff(tmp_path / "a.tif", Volume(values, values, grid))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        said = str(file.ome_metadata).replace('SizeZ="2"', f'SizeZ="{DIGITS}"')
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((4, 3, 4), np.float32), description=said.encode(), metadata=None)
    with pytest.raises(InputError, match="another TIFF"):
        read_ome_tiff(tmp_path / "b.tif")
