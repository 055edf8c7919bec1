"""`io.read`: which format a path holds, what is given for it, and a format that is added."""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from helpers.cli import holosplat
from holosplat import io
from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io import formats
from holosplat.io.atomic import write_json
from holosplat.io.formats import loader_of
from holosplat.io.images import write_tiff
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.scan import Exposures, Scan
from holosplat_bench.formats.nerf_synthetic import NerfOptions, write_nerf_synthetic, write_png
from holosplat_bench.formats.r2_gaussian import R2Options, write_r2_gaussian

N, SHAPE = 4, (9, 11)
ADDING = Path(__file__).parents[2] / "docs" / "adding.md"


def a_scan(times: np.ndarray | None = None) -> Scan:
    views = Views(rotation_y(40.0 * np.arange(N)), np.zeros((N, 2)), SHAPE, 1e-6)
    exposures = Exposures(views, 20.0, 0.1, 0.0, np.zeros(N) if times is None else times)  # type: ignore[arg-type]
    frames = 0.5 + np.random.default_rng(0).random((N, *SHAPE), dtype=np.float32)
    return Scan(frames, exposures, np.arange(N) == 3)


@pytest.fixture
def places(tmp_path: Path) -> Path:
    """A folder with the same scan in every format."""
    scan = a_scan()
    write_scan(tmp_path / "scan.bin", scan)
    write_tiff(tmp_path / "stack", scan)
    write_tiff(tmp_path / "files", scan, "files")
    write_nerf_synthetic(tmp_path / "nerf", scan, NerfOptions(seed_points=10))
    thickness = 1e-6 * np.ones(scan.frames.shape)
    write_r2_gaussian(tmp_path / "r2", scan, thickness, 1e-7, R2Options(seed_points=10))
    return tmp_path


FORMATS = {
    "scan.bin": "nxtomo",
    "stack": "tiff",
    "stack/scan.json": "tiff",
    "stack/frames.tif": "tiff",
    "files": "tiff",
    "nerf": "nerf-synthetic",
    "r2": "r2-gaussian",
}


def test_the_format_is_told_from_the_content(places):
    assert {name: loader_of(places / name).name for name in FORMATS} == FORMATS


def test_every_format_is_read(places):
    for name, kind in FORMATS.items():
        found = io.read(places / name)
        np.testing.assert_array_equal(found.views.rotations, a_scan().views.rotations, err_msg=name)
        if kind != "r2-gaussian":  # which has line integrals
            np.testing.assert_allclose(found.frames, a_scan().frames, atol=2e-5, err_msg=name)


def a_run(folder: Path, scan: Path, time_frame: int | str | None = None) -> Path:
    folder.mkdir()
    write_json(folder / "config.json", {})
    write_json(folder / "source.json", {"scan": str(scan), "time_frame": time_frame})
    return folder


def test_a_run_folder_gives_its_scan_at_its_time(tmp_path):
    scan = a_scan(np.array([0.0, 0.0, 1.0, 1.0]))
    write_scan(tmp_path / "series.nxs", scan)
    for name, time_frame, wanted in (("a", 1, scan.at_instant(1)), ("b", "all", scan.as_static()), ("c", None, scan)):
        found = io.read(a_run(tmp_path / name, tmp_path / "series.nxs", time_frame))
        np.testing.assert_array_equal(found.frames, wanted.frames)
        np.testing.assert_array_equal(found.exposures.time, wanted.exposures.time)


@pytest.mark.parametrize(
    ("scan", "time_frame", "said"),
    [
        ("none.nxs", None, r"source\.json: scan must name the run's scan, but .*none\.nxs is not there"),
        ("run", None, "is not there or none"),
        ("series.nxs", "last", "time_frame must be a number, 'all' or null, but it is 'last'"),
        ("series.nxs", 7, "instants are counted from 0 to 0, but 7"),
    ],
)
def test_a_run_without_its_scan_is_named(tmp_path, scan, time_frame, said):
    write_scan(tmp_path / "series.nxs", a_scan())
    with pytest.raises(InputError, match=said):
        io.read(a_run(tmp_path / "run", tmp_path / scan, time_frame))


def test_images_beside_the_scan_of_another_format_are_not_read(tmp_path):
    """A folder is one of images where no other format recognises it."""
    write_scan(tmp_path / "scan.nxs", a_scan())
    run = a_run(tmp_path / "run", tmp_path / "scan.nxs")
    write_png(run / "preview.png", np.zeros(SHAPE), "grey16")
    assert loader_of(run).name == "run"


def test_what_is_no_scan_is_told_what_is_known(places):
    (places / "empty").mkdir()
    (places / "text.nxs").write_text("no HDF5")
    shutil.copy(places / "r2/meta_data.json", places / "nerf")
    every = (*formats.LOADERS, *formats.ADDED.values())
    everything = "; ".join(re.escape(f"{loader.mark} ({loader.name})") for loader in every)
    for path, message in (
        (places / "none", "no such file or folder"),
        (places / "text.nxs", f"none of what is known: {everything}"),
        (places / "empty", f"none of what is known: {everything}"),
        (places / "nerf", "ambiguous: nerf-synthetic and r2-gaussian"),
    ):
        with pytest.raises(InputError, match=message):
            io.read(path)


def test_what_a_format_says_itself_is_not_given(places):
    with pytest.raises(InputError, match="energy_kev, black: not for a source in tiff; leave it away"):
        io.read(places / "stack", {"energy_kev": 20.0, "black": 0.0})


def test_nothing_else_is_in_the_room():
    with pytest.raises(AttributeError, match="no attribute 'write'"):
        io.write  # type: ignore[attr-defined]  # noqa: B018


# --- adding one ---------------------------------------------------------------------------------------------


def loaded(path: Path, text: str) -> ModuleType:
    """The module of the room `io` that `text` is, written to `path`."""
    path.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"holosplat.io.{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_loader_is_one_file_and_one_line(tmp_path, monkeypatch):
    """The file is that of docs/adding.md, word by word; `io.read` and a command then know the format."""
    section = ADDING.read_text(encoding="utf-8").split("## A loader\n")[1]
    code = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert code is not None
    scan, path = a_scan(), tmp_path / "mine.npz"
    np.savez(path, frames=scan.frames, angles=40.0 * np.arange(N))
    with pytest.raises(InputError, match="none of what is known"):
        io.read(path)
    archive = loaded(tmp_path / "archive.py", code[1])
    monkeypatch.setattr(formats, "LOADERS", (*formats.LOADERS, archive.LOADER))
    found = io.read(path, {"energy_kev": 20.0, "distance": 0.1, "pixel_size": 1e-6})
    np.testing.assert_array_equal(found.frames, scan.frames)
    with pytest.raises(InputError, match="energy_kev must be given too"):
        io.read(path)
    with pytest.raises(InputError, match=r"a NumPy archive \(\.npz\) \(archive\)"):
        io.read(tmp_path)
    said = ("--energy-kev", 20, "--distance", 0.1, "--pixel-size", 1e-6)
    outcome = holosplat("convert", path, tmp_path / "scan.nxs", "--to", "nxtomo", *said)
    assert outcome.code == 0, outcome.err
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.nxs").frames, scan.frames)
    np.testing.assert_allclose(read_scan(tmp_path / "scan.nxs").views.rotations, scan.views.rotations, atol=1e-12)
