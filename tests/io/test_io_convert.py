"""Formats that others read: what is written comes back, and means the same in the others' conventions.

The readers of those conventions here are written from the public descriptions of the layouts, and share nothing with
the writers. What is said of damaged folders is in test_io_convert_damage.py, R²-Gaussian in
test_io_r2_gaussian.py, the command line in test_cli_convert.py.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io.images import read_tiff, write_tiff
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.scan import Exposures, Scan
from holosplat_bench.formats.nerf_synthetic import (
    GivenOptics,
    NerfOptions,
    hull_points,
    read_nerf_synthetic,
    uniform_points,
    write_nerf_synthetic,
)

N, H, W = 6, 7, 10
PIXEL = 3.2e-6


def scan(rotations: np.ndarray | None = None, shifts: float = 1e-6, shape: tuple[int, int] = (H, W)) -> Scan:
    """A scan in which every number is different, with poses of any orientation."""
    rng = np.random.default_rng(0)
    rotations = Rotation.random(N, random_state=1).as_matrix() if rotations is None else rotations
    views = Views(rotations, rng.normal(size=(N, 2)) * shifts, shape, PIXEL)
    exposures = Exposures(views, 20.1, 0.1 + 0.01 * np.arange(N), 0.1 * np.arange(N), 1e-6 * np.arange(N))
    return Scan(rng.uniform(0.5, 1.5, (N, *shape)), exposures, np.arange(N) % 3 == 1, {"of": "é\nü", "seed": "0"})


def same_exposures(a: Scan, b: Scan) -> None:
    """All but the frames is equal to the last bit."""
    assert np.array_equal(a.views.rotations, b.views.rotations)
    assert np.array_equal(a.views.shifts, b.views.shifts)
    assert (a.views.shape, a.views.pixel_size) == (b.views.shape, b.views.pixel_size)
    np.testing.assert_array_equal(a.exposures.energy_kev, b.exposures.energy_kev)
    for name in ("distance", "psf_sigma_px", "time"):
        assert np.array_equal(getattr(a.exposures, name), getattr(b.exposures, name))
    assert np.array_equal(a.is_test, b.is_test)
    assert a.provenance == b.provenance


def read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def without_ours(folder: Path, *names: str) -> Path:
    """The folder as another program would have written it: nothing of ours in the tables."""
    for name in names:
        table = read(folder / name)
        table.pop("holosplat")
        for frame in table["frames"]:
            frame.pop("holosplat")
        (folder / name).write_text(json.dumps(table))
    return folder


# --- TIFF ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["stack", "files"])
@pytest.mark.parametrize("count", [N, 1])
def test_tiff_gives_everything_back(tmp_path, layout, count):
    write_scan(tmp_path / "scan.nxs", scan()[:count])
    before = read_scan(tmp_path / "scan.nxs")
    write_tiff(tmp_path / "out", before, layout)
    write_scan(tmp_path / "back.nxs", read_tiff(tmp_path / "out"))
    after = read_scan(tmp_path / "back.nxs")
    same_exposures(before, after)
    assert np.array_equal(before.frames, after.frames)
    files = sorted(p.name for p in (tmp_path / "out").glob("*.tif"))
    assert files == (["frames.tif"] if layout == "stack" else [f"frame_{n:04d}.tif" for n in range(count)])
    page = tifffile.imread(tmp_path / "out" / files[0], key=0)
    assert page.dtype == np.float32
    assert np.array_equal(page, before.frames[0])


def test_a_scan_json_written_by_hand_may_be_short(tmp_path):
    """Angles, one distance for all, 16-bit counts; shift, blur, time and split left out."""
    frames = np.arange(2 * H * W, dtype=np.uint16).reshape(2, H, W)
    tifffile.imwrite(tmp_path / "mine.tif", frames, photometric="minisblack", metadata=None)
    table = {"format": "holosplat TIFF 1", "file": "mine.tif", "pixel_size_m": PIXEL, "energy_kev": 20}
    table |= {"distance_m": 0.1, "frames": [{"angle_deg": 0}, {"angle_deg": 30, "distance_m": 0.2}]}
    (tmp_path / "scan.json").write_text(json.dumps(table))
    found = read_tiff(tmp_path)
    assert np.array_equal(found.frames, frames.astype(np.float32))
    assert np.array_equal(found.views.rotations, rotation_y([0, 30]))
    assert found.exposures.distance.tolist() == [0.1, 0.2]
    assert not found.exposures.time.any()
    assert not found.views.shifts.any()
    assert not found.is_test.any()


# --- NeRF-synthetic -----------------------------------------------------------------------------------------


def blender_pixel(table: dict, n: int, point: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(x, y) in pixels from the image's upper left corner at which camera `n` sees a point of the world.

    The convention of the Blender layout: matrices take the camera's axes (x right, y up, looking along -z) to the
    world, and `camera_angle_x` is the angle over the image's width.
    """
    camera = np.linalg.inv(np.array(table["frames"][n]["transform_matrix"])) @ np.append(point, 1.0)
    focal = 0.5 * shape[1] / np.tan(0.5 * table["camera_angle_x"])
    x, y, z = camera[:3]
    assert z < 0, "the point lies behind the camera"
    return np.array([0.5 * shape[1] + focal * x / -z, 0.5 * shape[0] - focal * y / -z])


def our_pixel(views: Views, n: int, point: np.ndarray) -> np.ndarray:
    """The same for a point [m] of the object, by docs/conventions.md; pixel (i, j) has its centre at (j, i) + ½."""
    lab = views.rotations[n] @ point
    return (lab[:2] - views.shifts[n]) / views.pixel_size + 0.5 * np.array(views.shape[::-1])


@pytest.mark.parametrize(("png", "levels"), [("grey16", 65535), ("rgba8", 255)])
def test_nerf_gives_back_poses_exactly_and_intensities_to_the_bit_depth(tmp_path, png, levels):
    before = scan()
    write_nerf_synthetic(tmp_path / "out", before, NerfOptions(png=png, seed_points=9))
    after = read_nerf_synthetic(tmp_path / "out")
    same_exposures(before, after)
    low, high = before.train().frames.min(), before.train().frames.max()
    error = np.abs(after.frames - before.frames.clip(low, high)).max()
    assert error < 0.501 * (high - low) / levels + 1e-7
    assert error > 0.2 * (high - low) / levels, "it was not rounded to these levels"
    with Image.open(tmp_path / "out/train/r_0000.png") as image:
        assert image.mode == {"grey16": "I;16", "rgba8": "RGBA"}[png]
        assert image.size == (W, H)


def test_black_and_white_are_those_of_the_training_frames(tmp_path):
    measured = scan()
    measured.frames[measured.is_test] += 2.0
    write_nerf_synthetic(tmp_path / "out", measured, NerfOptions(seed_points=9))
    split = {
        s: [np.asarray(Image.open(p)) for p in sorted((tmp_path / "out" / s).iterdir())] for s in ("train", "test")
    }
    assert (np.min(split["train"]), np.max(split["train"])) == (0, 65535)
    assert np.min(split["test"]) == 65535
    head = read(tmp_path / "out/transforms_train.json")["holosplat"]
    assert head["low"] == float(measured.train().frames.min())
    assert head["high"] == float(measured.train().frames.max())


def test_frames_without_contrast_come_back(tmp_path):
    flat = replace(scan(), frames=np.full((N, H, W), 0.7))
    write_nerf_synthetic(tmp_path / "out", flat, NerfOptions(seed_points=9))
    assert np.array_equal(read_nerf_synthetic(tmp_path / "out").frames, flat.frames)


def test_the_layout_is_what_its_readers_look_for(tmp_path):
    """Three splits with images below the folder, named without their suffix; validation is the test's copy."""
    measured = scan()
    write_nerf_synthetic(tmp_path / "out", measured, NerfOptions(seed_points=9))
    splits = {s: read(tmp_path / f"out/transforms_{s}.json") for s in ("train", "test", "val")}
    assert splits["val"] == splits["test"]
    assert [len(splits[s]["frames"]) for s in ("train", "test")] == [len(measured.train()), len(measured.test())]
    for split in splits.values():
        for frame in split["frames"]:
            assert (tmp_path / "out" / (frame["file_path"] + ".png")).is_file()
            pose = np.array(frame["transform_matrix"])
            assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
            assert np.linalg.det(pose[:3, :3]) > 0


def test_a_perspective_camera_sees_what_the_beam_casts(tmp_path):
    """Their difference is the perspective: lateral offset × depth / distance, so of first order in 1 / distance.

    In the plane through the origin they agree, shifts of the detector included.
    """
    measured, scale = scan(), 2 / (W * PIXEL)
    points = np.random.default_rng(5).uniform(-0.7, 0.7, (20, 3)) / scale
    train = measured.train().views
    worst = []
    for distance in (100.0, 200.0):
        folder = tmp_path / f"{distance:g}"
        write_nerf_synthetic(folder, measured, NerfOptions(camera_distance=distance, seed_points=9))
        table = read(folder / "transforms_train.json")
        errors = []
        for n in range(len(train)):
            for point in points:
                flat = point - (train.rotations[n, 2] @ point) * train.rotations[n, 2]
                assert np.allclose(blender_pixel(table, n, flat * scale, (H, W)), our_pixel(train, n, flat), atol=1e-9)
                difference = blender_pixel(table, n, point * scale, (H, W)) - our_pixel(train, n, point)
                aside, depth = our_pixel(train, n, point) - [W / 2, H / 2], train.rotations[n, 2] @ point * scale
                assert np.allclose(difference, -aside * depth / (distance + depth), atol=1e-9)
                errors.append(np.abs(difference).max())
        worst.append(max(errors))
    assert worst[0] < 0.5 * W * 1.3 / 100
    assert 1.9 < worst[0] / worst[1] < 2.1


def test_rays_of_a_nerf_reader_are_the_beam(tmp_path):
    """Rays as NeRF's loader makes them meet our pixel centres above the origin, and run along the beam within 0.7°."""
    measured, scale = scan(), 2 / (W * PIXEL)
    write_nerf_synthetic(tmp_path / "out", measured, NerfOptions(seed_points=9))
    table = read(tmp_path / "out/transforms_train.json")
    train = measured.train().views
    focal = 0.5 * W / np.tan(0.5 * table["camera_angle_x"])
    i, j = np.meshgrid(np.arange(H) + 0.5, np.arange(W) + 0.5, indexing="ij")
    directions = np.stack([(j - W / 2) / focal, -(i - H / 2) / focal, -np.ones_like(i)], -1)
    for n, frame in enumerate(table["frames"]):
        pose = np.array(frame["transform_matrix"])
        rays, origin = directions @ pose[:3, :3].T, pose[:3, 3]
        beam = train.rotations[n, 2]
        met = origin + rays * (-(origin @ beam) / (rays @ beam))[..., None]
        lab = met @ train.rotations[n].T / scale
        x = (j - W / 2) * PIXEL + train.shifts[n, 0]
        y = (i - H / 2) * PIXEL + train.shifts[n, 1]
        assert np.allclose(lab[..., 0], x, atol=1e-12)
        assert np.allclose(lab[..., 1], y, atol=1e-12)
        assert np.allclose(rays / np.linalg.norm(rays, axis=-1, keepdims=True), beam, atol=0.0125)


def test_folders_of_other_programs_are_read_with_what_they_do_not_say(tmp_path):
    measured = scan()
    write_nerf_synthetic(tmp_path / "out", measured, NerfOptions(seed_points=9))
    own = read_nerf_synthetic(tmp_path / "out")
    head = read(tmp_path / "out/transforms_train.json")["holosplat"]
    folder = without_ours(tmp_path / "out", "transforms_train.json", "transforms_test.json")
    with pytest.raises(InputError, match="does not say the photon energy"):
        read_nerf_synthetic(folder)
    found = read_nerf_synthetic(folder, GivenOptics(20.1, 0.3, PIXEL, head["low"], head["high"]))
    order = np.concatenate([np.flatnonzero(~measured.is_test), np.flatnonzero(measured.is_test)])
    assert np.allclose(found.frames, own.frames[order], atol=1e-6)
    assert np.abs(found.views.rotations - measured.views.rotations[order]).max() < 1e-9
    assert np.abs(found.views.shifts - measured.views.shifts[order]).max() < 1e-9 * PIXEL * W
    assert np.array_equal(found.is_test, measured.is_test[order])
    assert found.exposures.distance.tolist() == [0.3] * N


# --- points to start from -----------------------------------------------------------------------------------


def balls(centres: np.ndarray, radius: float, views: Views) -> np.ndarray:
    """Thickness [V, H, W] [m] of balls, from the closed form."""
    h, w = views.shape
    y, x = np.meshgrid(np.arange(h) + 0.5 - h / 2, np.arange(w) + 0.5 - w / 2, indexing="ij")
    lab = np.einsum("vij,bj->vbi", views.rotations, centres)
    dx = x * PIXEL + (views.shifts[:, :1] - lab[..., 0])[..., None, None]
    dy = y * PIXEL + (views.shifts[:, 1:] - lab[..., 1])[..., None, None]
    return 2 * np.sqrt((radius**2 - dx**2 - dy**2).clip(0)).sum(1)


def test_a_hull_encloses_the_balls_and_little_else():
    turned = Rotation.random(15, random_state=2).as_matrix()
    views = Views(turned, np.random.default_rng(0).normal(size=(15, 2)) * PIXEL, (41, 50), PIXEL)
    centres = np.array([[12.0, 5.0, -9.0], [-11.0, -8.0, 4.0]]) * PIXEL
    points = hull_points(balls(centres, 6 * PIXEL, views), views, 4000)
    nearest = np.linalg.norm(points[:, None] - centres, axis=-1).min(1)
    assert np.mean(nearest < 7.5 * PIXEL) > 0.9
    for centre in centres:  # all directions are there
        near = points[np.linalg.norm(points - centre, axis=1) < 8 * PIXEL] - centre
        assert len(near) > 500
        assert np.linalg.norm(near.mean(0)) < 1.5 * PIXEL
    with pytest.raises(InputError, match="no shadow"):
        hull_points(np.zeros((15, 41, 50)), views, 10)


@pytest.mark.parametrize("known", [False, True])
def test_points_are_written_in_the_scene(tmp_path, known):
    measured = scan(shape=(41, 50))
    thickness = balls(np.array([[7.0, 3.0, -5.0]]) * PIXEL, 8 * PIXEL, measured.views) if known else None
    write_nerf_synthetic(tmp_path / "out", measured, NerfOptions(seed_points=500), thickness)
    header, body = (tmp_path / "out/points3d.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").split("\n")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 500"]
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    rows = np.frombuffer(body, np.dtype([(n, "<f4") for n in names[:6]] + [(n, "u1") for n in names[6:]]))
    assert len(rows) == 500
    found = np.column_stack([rows["x"], rows["y"], rows["z"]]) / (2 / (50 * PIXEL))
    views = measured.train().views
    train = ~measured.is_test
    expected = uniform_points(views, 500) if thickness is None else hull_points(thickness[train], views, 500)
    assert np.allclose(found, expected, atol=1e-6 * PIXEL * 50)
