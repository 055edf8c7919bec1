"""Scenes in the layouts of others, read back without the code that wrote them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from holosplat.checks import InputError
from holosplat.geometry import rotation_tilted
from holosplat_bench.training.export import export
from holosplat_bench.training.folder import Dataset
from holosplat_bench.training.options import Ranges
from holosplat_bench.training.sample import Sample, as_scan

ANGLES = (0.0, 70.0, 110.0)
PIXEL, ENERGY, DISTANCE, DELTA, BETA = 0.5e-6, 20.0, 0.05, 3e-7, 4e-10
SIDE = 16


def a_sample(tilt: float = 0.0) -> Sample:
    """A box off the axis in two views for training and one that is held out, with its true thickness."""
    occupancy = np.zeros((SIDE, SIDE, SIDE), np.uint8)
    occupancy[3:7, 5:11, 9:13] = 255
    rotations = rotation_tilted(np.array(ANGLES), np.array([0.0, tilt, 0.0]))
    thickness = np.stack([occupancy.sum(0) / 255] * 3)
    contrast = 0.01 * thickness
    facts = np.array([PIXEL, ENERGY, DISTANCE, 0.3, np.inf, DELTA, BETA, 1.0])
    return Sample(
        contrast.astype(np.float16),
        thickness.astype(np.float16),
        np.full(3, 1e-3, np.float32),
        rotations,
        np.zeros((3, 2)),
        np.array([False, True, False]),
        occupancy,
        facts,
    )


@pytest.fixture
def data(tmp_path, monkeypatch) -> Dataset:
    """Two scenes, of which the second has tilted beams."""
    monkeypatch.setattr(Dataset, "require_whole", lambda self: None)
    monkeypatch.setattr(Dataset, "sample", lambda self, number: a_sample(20.0 * number))
    (tmp_path / "data").mkdir()
    return Dataset(tmp_path / "data", Ranges(), 0, 2)


def table(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_nerf_synthetic_has_png_and_far_cameras_that_look_along_the_beam(data):
    done = export(data, "nerf-synthetic")

    scene = done.folder / "scene-000000"
    train, test = (table(scene / f"transforms_{split}.json") for split in ("train", "test"))
    assert done.count == 2
    assert (len(train["frames"]), len(test["frames"])) == (2, 1)
    image = np.asarray(Image.open(scene / f"{train['frames'][0]['file_path']}.png")).astype(float)
    low, high = train["holosplat"]["low"], train["holosplat"]["high"]
    assert np.allclose(low + (high - low) * image / 65535, 1 + a_sample().contrast[0].astype(float), atol=2e-6)
    pose, turn = np.array(train["frames"][1]["transform_matrix"]), np.deg2rad(ANGLES[2])
    ahead = -pose[:3, 2]
    assert np.allclose(np.abs(ahead), np.abs([np.sin(turn), 0, np.cos(turn)]), atol=1e-9)
    half = 0.5 * train["camera_angle_x"]
    assert np.tan(half) * np.linalg.norm(pose[:3, 3]) == pytest.approx(1.0)  # the field goes from -1 to 1
    assert np.tan(half) < 0.011


def test_r2_gaussian_has_line_integrals_the_truth_and_no_tilted_views(data):
    done = export(data, "r2-gaussian")

    scene = done.folder / "scene-000000"
    meta = table(scene / "meta_data.json")
    assert (done.count, done.left_out) == (1, (1,))
    assert not (done.folder / "scene-000001").exists()
    assert meta["scanner"]["mode"] == "parallel"
    assert meta["bbox"] == [[-1, -1, -1], [1, 1, 1]]
    image = np.load(scene / meta["proj_train"][0]["file_path"])
    volume = np.load(scene / meta["vol"])
    assert volume.shape == (SIDE, SIDE, SIDE)
    along = volume.sum(0) * 2 / SIDE  # at angle 0 the beam runs along x; rows are -z, columns y
    assert np.allclose(image, along.T[::-1], atol=1e-3)
    assert [entry["angle"] for entry in meta["proj_train"]] == pytest.approx(np.deg2rad([ANGLES[0], ANGLES[2]]))


def test_onix_has_attenuation_and_phase_with_poses_and_the_truth(data):
    done = export(data, "onix")

    seen, poses, volumes = (np.load(done.folder / f"{name}.npy") for name in ("projections", "poses", "volumes"))
    said = table(done.folder / "onix.json")
    assert seen.shape == (2, 3, 2, SIDE, SIDE)
    assert said["training_views"] == 2
    k = 2 * np.pi / (12.398419843e-10 / ENERGY)
    assert np.allclose(seen[0, 0, 1], k * DELTA * PIXEL * a_sample().thickness[0], rtol=1e-3)
    assert np.allclose(seen[0, 0, 0] * DELTA, 2 * BETA * seen[0, 0, 1], rtol=1e-5)
    assert np.allclose(poses[0, 0], [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]], atol=1e-12)
    turn = np.deg2rad(ANGLES[2])  # the held-out view stands last
    assert np.allclose(np.abs(poses[0, 1, :3, 2]), np.abs([np.sin(turn), 0, np.cos(turn)]), atol=1e-12)
    assert np.allclose(np.linalg.det(poses[:, :, :3, :3]), 1)
    assert np.array_equal(volumes[0] > 0.5, a_sample().occupancy > 127)
    assert said["scenes"][0]["pixel_size_m"] == PIXEL


def test_what_is_there_or_does_not_fit_is_refused(data, monkeypatch):
    export(data, "onix")
    with pytest.raises(InputError, match="onix is there already"):
        export(data, "onix")
    monkeypatch.setattr(Dataset, "sample", lambda self, number: a_sample(20.0))
    with pytest.raises(InputError, match="draw some with --tilted 0"):
        export(replace(data, count=1), "r2-gaussian")
    assert not (data.folder / "r2-gaussian").exists()


def test_a_scan_of_a_sample_holds_its_frames_and_truth():
    found = as_scan(a_sample())

    assert np.allclose(found.scan.frames - 1, a_sample().contrast, atol=1e-3)
    assert found.scan.exposures.energy_kev[0] == ENERGY
    assert found.truth.delta.max() == pytest.approx(DELTA)
    assert found.truth.beta.max() == pytest.approx(BETA)
    assert found.truth.grid.voxel_size[0] == PIXEL
