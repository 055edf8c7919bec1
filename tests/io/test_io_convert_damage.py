"""Folders of other formats that are damaged, incomplete or of the wrong kind: each is named in one clear sentence."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import atomic_folder
from holosplat.io.images import read_tiff, write_tiff
from holosplat.io.solids import write_ply
from holosplat.scan import Exposures, Scan
from holosplat.volume import Volume
from holosplat_bench.formats.nerf_synthetic import GivenOptics, NerfOptions, read_nerf_synthetic, write_nerf_synthetic
from holosplat_bench.formats.r2_gaussian import R2Options, read_r2_gaussian, write_r2_gaussian

N, H, W = 5, 7, 10
READ: dict[str, Callable[[Path], Scan]] = {
    "nerf": read_nerf_synthetic,
    "stack": read_tiff,
    "files": read_tiff,
    "r2": read_r2_gaussian,
}
TABLE = {"nerf": "transforms_train.json", "stack": "scan.json", "files": "scan.json", "r2": "meta_data.json"}
Change = Callable[[dict[str, Any]], object]


def small_scan() -> Scan:
    exposures = Exposures.of(Views.from_angles(np.arange(N) * 36.0, (H, W), 3.2e-6), 20.0, 0.1)
    return Scan(np.random.default_rng(0).uniform(0.5, 1.5, (N, H, W)), exposures, np.arange(N) == 2)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """One folder of each kind, as they are written."""
    path, scan = tmp_path_factory.mktemp("good"), small_scan()
    write_nerf_synthetic(path / "nerf", scan, NerfOptions(seed_points=5))
    write_tiff(path / "stack", scan)
    write_tiff(path / "files", scan, "files")
    write_r2_gaussian(path / "r2", scan, np.ones((N, H, W)), 1e-7, R2Options(seed_points=5))
    return path


@pytest.fixture
def folders(good, tmp_path) -> Path:
    """A copy of them to damage."""
    shutil.copytree(good, tmp_path / "copy")
    return tmp_path / "copy"


def edited(path: Path, change: Change) -> None:
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


def put(name: str, value: Any) -> Change:
    """Set the entry `a.b.0.c` of a table."""

    def change(table: Any) -> None:
        *way, last = (int(key) if key.isdecimal() else key for key in name.split("."))
        for key in way:
            table = table[key]
        table[last] = value

    return change


def take(name: str) -> Change:
    """Remove an entry."""

    def change(table: Any) -> None:
        *way, last = (int(key) if key.isdecimal() else key for key in name.split("."))
        for key in way:
            table = table[key]
        del table[last]

    return change


BAD_TABLES = [
    ("nerf", put("holosplat.format", "other"), "format must be|the same"),
    ("nerf", take("camera_angle_x"), None),
    ("nerf", take("frames"), "frames must be there"),
    ("nerf", put("frames", []), "at least one frame"),
    ("nerf", put("frames.0", 3), "list of tables"),
    ("nerf", put("frames.0.file_path", "./train/none"), "no such file"),
    ("nerf", put("frames.0.file_path", "../stack/frames"), "in the folder"),
    ("nerf", put("frames.0.file_path", 7), "must be a text"),
    ("nerf", take("frames.0.holosplat"), r"frames\[0\].holosplat must be there"),
    ("nerf", put("frames.0.holosplat.index", 1), "0 to 4, each once"),
    ("nerf", put("frames.0.holosplat.time_s", float("nan")), "must be valid JSON, but: NaN is no number"),
    ("nerf", put("frames.1.holosplat.rotation", [[1, 0], [0, 1]]), "shape"),
    ("nerf", put("frames.1.holosplat.rotation", [[1, 0], [0]]), "must hold numbers"),
    ("nerf", put("frames.1.holosplat.rotation", np.diag([1, 1, -1]).tolist()), "proper rotation"),
    ("nerf", put("frames.1.holosplat.distance_m", -1), "propagation distance"),
    ("nerf", lambda table: table["frames"].pop(), "0 to 4, each once"),
    ("stack", put("format", "holosplat TIFF 2"), "must be 'holosplat TIFF 1'"),
    ("stack", take("energy_kev"), "energy_kev must be there"),
    ("stack", put("energy_kev", 20000), "between 1e-06 and 1000"),
    ("stack", put("pixel_size_m", "3 um"), "must hold numbers"),
    ("stack", lambda table: table["frames"].pop(), "must hold 4 pages"),
    ("stack", put("frames", []), "at least one frame"),
    ("stack", put("frames.0.test", 1), "true or false"),
    ("stack", put("provenance", {"a": 1}), "provenance.a must be a text"),
    ("stack", put("provenance", [1]), "provenance must be a table"),
    ("files", put("frames.1.file", "frame_0009.tif"), "no such file"),
    ("files", take("frames.1.file"), "file must be there"),
    ("files", take("frames.1.distance_m"), "distance_m must be there"),
    ("r2", put("scanner.mode", "cone"), "beams are parallel here"),
    ("r2", put("scanner.nDetector", [9, 10]), "shape"),
    ("r2", put("scanner.nDetector", [9.5, 10]), "whole numbers"),
    ("r2", put("proj_train", []), "at least one projection"),
    ("r2", put("holosplat.corner", [5, 0]), "within the projections"),
    ("r2", put("holosplat.format", ""), "format must be"),
    ("r2", put("proj_test.0.file_path", "proj_test/none.npy"), "no such file"),
]


@pytest.mark.parametrize(("kind", "change", "message"), BAD_TABLES)
def test_bad_tables_are_named(folders, kind, change, message):
    edited(folders / kind / TABLE[kind], change)
    if message is None:  # not needed for the way back
        READ[kind](folders / kind)
        return
    with pytest.raises(InputError, match=message) as caught:
        READ[kind](folders / kind)
    assert str(folders / kind) in str(caught.value)


@pytest.mark.parametrize("kind", list(TABLE))
def test_tables_that_are_no_json_are_named(folders, kind):
    table = folders / kind / TABLE[kind]
    table.write_text(table.read_text()[:-40])
    with pytest.raises(InputError, match=TABLE[kind]):
        READ[kind](folders / kind)
    table.unlink()
    with pytest.raises(InputError, match="no such file"):
        READ[kind](folders / kind)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-60])


def holes(path: Path) -> None:
    array = tifffile.imread(path) if path.suffix == ".tif" else np.load(path)
    array[..., 0, 0] = np.nan
    if path.suffix == ".tif":
        tifffile.imwrite(path, array, photometric="minisblack", metadata=None)
    else:
        np.save(path, array)


def eight_bits(path: Path) -> None:
    Image.new("L", (W, H)).save(path)


def other_size(path: Path) -> None:
    if path.suffix == ".png":
        Image.fromarray(np.zeros((H, W + 1), np.uint16)).save(path)
    elif path.suffix == ".npy":
        np.save(path, np.zeros((H, W + 1), np.float32))
    else:
        tifffile.imwrite(path, np.zeros((H, W + 1), np.float32), photometric="minisblack", metadata=None)


def colours(path: Path) -> None:
    tifffile.imwrite(path, np.zeros((H, W, 3), np.uint8), photometric="rgb", metadata=None)


PNG, TIF, NPY = "nerf/train/r_0001.png", "files/frame_0001.tif", "r2/proj_train/proj_train_0001.npy"


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        (PNG, Path.unlink, "no such file"),
        (PNG, cut, "damaged"),
        (PNG, eight_bits, "white at 65535, but it has .* white at 255"),
        (PNG, other_size, "pixels"),
        (TIF, cut, "damaged"),
        (TIF, holes, "NaN"),
        (TIF, other_size, "as the first"),
        (TIF, colours, "grey images"),
        ("stack/frames.tif", cut, "damaged"),
        ("stack/frames.tif", holes, "must hold 5 pages|NaN"),
        (NPY, Path.unlink, "no such file"),
        (NPY, cut, "damaged"),
        (NPY, holes, "NaN"),
        (NPY, other_size, "shape"),
        (NPY, lambda path: np.save(path, np.array([["a"]])), "hold numbers"),
        (NPY, lambda path: np.save(path, np.array([{}]), allow_pickle=True), "damaged"),
    ],
)
def test_bad_images_are_named(folders, name, damage, message):
    damage(folders / name)
    kind = name.split("/")[0]
    with pytest.raises(InputError, match=message):
        READ[kind](folders / kind)


def test_all_images_in_the_wrong_bits_or_size_are_seen(folders):
    for path in (folders / "nerf").glob("t*/*.png"):
        eight_bits(path)
    with pytest.raises(InputError, match="white is 65535, but that of the images is 255"):
        read_nerf_synthetic(folders / "nerf")


def foreign(folders: Path, also: Change = lambda table: None) -> Path:
    """The NeRF folder without what is ours."""
    for name in ("transforms_train.json", "transforms_test.json"):
        edited(folders / "nerf" / name, lambda table: (table.pop("holosplat"), also(table)))
    return folders / "nerf"


OPTICS = GivenOptics(20.0, 0.1, 3.2e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("camera_angle_x", 0.69), "perspective views"),
        (put("camera_angle_x", 0.0), "must be below"),
        (put("frames.0.transform_matrix", np.diag([1.0, 2.0, 1.0, 1.0]).tolist()), "proper rotation|from one distance"),
        (put("frames.0.transform_matrix.2.3", -3000.0), "from one distance"),
        (put("frames.0.transform_matrix.2.3", 100.0), "from one distance"),
        (take("frames.0.transform_matrix"), "transform_matrix must be there"),
    ],
)
def test_cameras_of_others_that_are_not_parallel_are_refused(folders, change, message):
    read_nerf_synthetic(foreign(folders), OPTICS)
    edited(folders / "nerf/transforms_train.json", change)
    table = json.loads((folders / "nerf/transforms_train.json").read_text())
    edited(folders / "nerf/transforms_test.json", put("camera_angle_x", table["camera_angle_x"]))
    with pytest.raises(InputError, match=message):
        read_nerf_synthetic(folders / "nerf", OPTICS)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image.new("RGB", (W, H), (10, 20, 30)), "colours"),
        (Image.new("RGBA", (W, H), (9, 9, 9, 100)), "opaque"),
        (Image.new("P", (W, H)), "grey image of 8 or 16 bits"),
    ],
)
def test_pictures_that_are_no_frames_are_refused(folders, image, message):
    image.save(folders / PNG)
    with pytest.raises(InputError, match=message):
        read_nerf_synthetic(foreign(folders), OPTICS)


def test_what_is_given_is_checked(folders):
    with pytest.raises(InputError, match="says itself"):
        read_nerf_synthetic(folders / "nerf", OPTICS)
    with pytest.raises(InputError, match="says itself"):
        read_r2_gaussian(folders / "r2", energy_kev=20.0)
    with pytest.raises(InputError, match=r"between 0\.1 and 1000"):
        GivenOptics(20_000.0, 0.1, 3.2e-6)
    with pytest.raises(InputError, match="black must be below white"):
        GivenOptics(20.0, 0.1, 3.2e-6, 1.0, 1.0)
    with pytest.raises(InputError, match="camera_distance"):
        NerfOptions(camera_distance=1.0)
    with pytest.raises(InputError, match="seed_points"):
        R2Options(seed_points=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("scanner.sDetector", [2.0, 3.0]), "must be square"),
        (put("scanner.sDetector", [4.0, 4.0]), "as large as"),
        (put("scanner.offDetector", [0.1, 0.0]), "offDetector must be 0"),
        (put("proj_train.0.angle", "30"), "must hold numbers"),
    ],
)
def test_scanners_of_others_that_cannot_be_meant_are_refused(folders, change, message):
    edited(folders / "r2/meta_data.json", lambda table: table.pop("holosplat"))
    read_r2_gaussian(folders / "r2", 20.0, 1e-6)
    edited(folders / "r2/meta_data.json", change)
    with pytest.raises(InputError, match=message):
        read_r2_gaussian(folders / "r2", 20.0, 1e-6)


# --- writing ------------------------------------------------------------------------------------------------


def test_the_truth_must_be_on_the_field_of_view(tmp_path):
    scan = small_scan()
    grid = Grid.of_views(scan.views.refined(2))
    truth = Volume(np.zeros(grid.shape), np.zeros(grid.shape), grid)
    with pytest.raises(InputError, match="grid of the field of view"):
        write_r2_gaussian(tmp_path / "out", scan, np.ones((N, H, W)), 1e-7, R2Options(truth))
    assert not list(tmp_path.iterdir())


def test_folders_are_written_whole_or_not_at_all(tmp_path):
    with contextlib.suppress(KeyboardInterrupt), atomic_folder(tmp_path / "out") as folder:
        (folder / "half").write_text("x")
        raise KeyboardInterrupt
    with pytest.raises(InputError, match="writing it failed"), atomic_folder(tmp_path / "out") as folder:
        (folder / "none" / "file").write_text("x")
    assert not list(tmp_path.iterdir())
    (tmp_path / "out").mkdir()
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "file").write_text("x")
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "file"]


@pytest.mark.parametrize("write", [write_tiff, write_nerf_synthetic])
def test_nothing_is_overwritten(tmp_path, write):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/precious").write_text("x")
    (tmp_path / "file").write_text("x")
    for name in ("out", "file"):
        with pytest.raises(InputError, match="must be new"):
            write(tmp_path / name, small_scan())
    with pytest.raises(InputError, match="existing folder"):
        write(tmp_path / "none/out", small_scan())
    assert {p.name for p in tmp_path.rglob("*")} == {"out", "precious", "file"}


def test_points_that_are_none_are_refused(tmp_path):
    for points, message in ((np.zeros((3, 2)), "shape"), (np.full((3, 3), np.nan), "NaN")):
        with pytest.raises(InputError, match=message):
            write_ply(tmp_path / "points.ply", points)
