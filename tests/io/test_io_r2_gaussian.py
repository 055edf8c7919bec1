"""R²-Gaussian's folders: the same object, seen from the same sides in its convention and in ours.

Its convention is written down here from the public description of the layout, and shares nothing with the writer.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.matter import Matter
from holosplat.optics import retrieve_thickness
from holosplat.representations.gaussians import GaussianCloud, raw_of
from holosplat.scan import Exposures, Scan
from holosplat.units import wavenumber
from holosplat_bench.formats.r2_gaussian import R2Options, read_r2_gaussian, write_r2_gaussian

PIXEL = 3.2e-6
ANGLES = np.array([-20.0, 10.0, 35.0, 75.0, 110.0, 200.0])
N = len(ANGLES)
DELTA = 1e-7


def blob(centre: tuple[float, float, float], sigma: float) -> GaussianCloud:
    """One round Gaussian of matter with peak DELTA; centre and sigma in pixels."""
    position = torch.tensor([centre])
    spread = torch.full((1, 3), float(np.log(sigma)))
    return GaussianCloud(
        (position, spread, torch.tensor([[1.0, 0, 0, 0]]), raw_of(torch.ones(1))[:, None]),
        PIXEL,
        Matter.one(DELTA, 1e-10),
    )


def r2_camera(world: np.ndarray, angle: float) -> np.ndarray:
    """Points or directions of the world in the camera's axes (x right, y down, z ahead) of R²-Gaussian.

    Camera to world: turned by -90° about x, 90° about z and `angle` about z, all about fixed axes.
    """
    turn = Rotation.from_euler("z", angle) * Rotation.from_euler("z", 90, degrees=True)
    return (turn * Rotation.from_euler("x", -90, degrees=True)).inv().apply(world)


def r2_lines(world: np.ndarray, sigma: float, angle: float, side: int) -> np.ndarray:
    """[side, side]: line integrals of a round Gaussian at `world`, as R²-Gaussian projects in parallel beam.

    The image covers [-1, 1]² of the camera's x, along the columns, and y, down the rows.
    """
    camera = r2_camera(world, angle)
    centres = (2 * np.arange(side) + 1) / side - 1
    square = (centres - camera[0]) ** 2 + (centres[:, None] - camera[1]) ** 2
    return np.sqrt(2 * np.pi) * sigma * np.exp(-0.5 * square / sigma**2)


def views_about_y(shape: tuple[int, int], shift: tuple[float, float]) -> Scan:
    """Frames of noise at unevenly spaced angles, of which the last two are held out; the shift is in pixels."""
    views = Views(rotation_y(ANGLES), np.tile(np.array(shift) * PIXEL, (N, 1)), shape, PIXEL)
    exposures = Exposures(views, 20.1, np.full(N, 0.1), np.full(N, 0.3), 1e-6 * np.arange(N))
    return Scan(np.random.default_rng(0).uniform(0.5, 1.5, (N, *shape)), exposures, np.arange(N) >= 4)


def read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("centre", [(4.0, 2.0, -3.0), (-3.0, -4.0, -5.0), (1.0, 3.0, 5.0)])
@pytest.mark.parametrize("shape", [(29, 32), (32, 27), (31, 31)])
def test_r2_gaussian_sees_the_same_object_from_the_same_sides(tmp_path, centre, shape):
    """Their projection of a blob that lies where their volume has it is the image written: no axis is flipped.

    The points to start from lie in the shadow's inner part (a tenth of the peak: 2.15 σ) in all views.
    """
    sigma, measured = 2.2, views_about_y(shape, (0, 1.3))
    cloud = blob(centre, sigma)
    thickness = cloud.project(measured.views)[1].detach().numpy() / DELTA
    truth = cloud.voxelise(Grid.of_views(measured.views))
    write_r2_gaussian(tmp_path / "out", measured, thickness, DELTA, R2Options(truth, 400))
    meta = read(tmp_path / "out/meta_data.json")
    density = np.load(tmp_path / "out" / meta["vol"])
    side = meta["scanner"]["nVoxel"][0]
    assert density.shape == (side,) * 3
    assert meta["scanner"]["nDetector"] == [side, side]
    assert density.max() == pytest.approx(1, abs=0.1)
    axis = (2 * np.arange(side) + 1) / side - 1  # voxel centres; the array is indexed [x, y, z]
    world = np.array([(density.sum(others) * axis).sum() for others in ((1, 2), (0, 2), (0, 1))]) / density.sum()
    start = np.load(tmp_path / "out/init_out.npy")
    assert start.shape == (400, 4)
    for entry in meta["proj_train"] + meta["proj_test"]:
        image = np.load(tmp_path / "out" / entry["file_path"])
        expected = r2_lines(world, 2 * sigma / side, entry["angle"], side)
        assert np.abs(image - expected).max() < 0.03 * expected.max()
        if entry in meta["proj_train"]:
            aside = r2_camera(start[:, :3] - world, entry["angle"])[:, :2]
            assert np.linalg.norm(aside, axis=1).max() < (2.15 * sigma + 1.5) * 2 / side


def test_r2_gaussian_comes_back_as_an_absorber(tmp_path):
    """Poses exactly, line integrals as transmission; phase retrieval of a pure absorber finds them again."""
    measured = views_about_y((29, 32), (0, 1.3))
    thickness = blob((4.0, 2.0, -3.0), 2.2).project(measured.views)[1].detach().numpy() / DELTA
    write_r2_gaussian(tmp_path / "out", measured, thickness, DELTA, R2Options(seed_points=9))
    assert not np.load(tmp_path / "out/vol_gt.npy").any()
    back = read_r2_gaussian(tmp_path / "out")
    assert np.array_equal(back.views.rotations, measured.views.rotations)
    assert np.array_equal(back.views.shifts, measured.views.shifts)
    assert np.array_equal(back.exposures.time, measured.exposures.time)
    assert np.array_equal(back.is_test, measured.is_test)
    unit = 16 * PIXEL
    assert np.allclose(-np.log(back.frames), thickness / unit, atol=1e-6)
    beta = float(back.provenance["beta_of_density_1"])
    assert beta == pytest.approx(1 / (2 * wavenumber(20.1) * unit), rel=1e-5)
    found = retrieve_thickness(torch.from_numpy(back.frames), PIXEL, back.exposures.distance, 20.1, beta, beta)
    assert np.allclose(found.numpy(), thickness, atol=1e-4 * thickness.max())


def test_r2_gaussian_folders_of_others_are_read(tmp_path):
    """A blob where their convention has it, at `-y, z, -x` of their world (angles the same), casts what was read."""
    measured = views_about_y((32, 32), (0, 0))
    centre = (4.0, 2.0, -3.0)
    thickness = blob(centre, 2.2).project(measured.views)[1].detach().numpy() / DELTA
    write_r2_gaussian(tmp_path / "out", measured, thickness, DELTA, R2Options(seed_points=9))
    folder, meta = tmp_path / "out", read(tmp_path / "out/meta_data.json")
    for entry in (meta, *meta["proj_train"], *meta["proj_test"]):
        entry.pop("holosplat")
    (folder / "meta_data.json").write_text(json.dumps(meta))
    with pytest.raises(InputError, match="say them by --energy-kev and --pixel-size"):
        read_r2_gaussian(folder)
    found = read_r2_gaussian(folder, 20.0, PIXEL)
    lines = blob(centre, 2.2).project(found.views)[1].detach().numpy() / DELTA / (16 * PIXEL)
    assert np.allclose(-np.log(found.frames), lines, atol=1e-5)
    assert found.is_test.tolist() == [False] * 4 + [True] * 2
    assert float(found.provenance["beta_of_density_1"]) == pytest.approx(
        1 / (2 * wavenumber(20.0) * 16 * PIXEL), rel=1e-5
    )


def test_r2_gaussian_refuses_what_it_cannot_say(tmp_path):
    lines, tilted = np.ones((N, 7, 10)), views_about_y((7, 10), (0, 0))
    turned = replace(tilted.views, rotations=Rotation.random(N, random_state=1).as_matrix())
    uneven = replace(tilted.views, shifts=np.arange(2.0 * N).reshape(N, 2) * [0, PIXEL])
    for views in (turned, uneven):
        scan = replace(tilted, exposures=replace(tilted.exposures, views=views))
        with pytest.raises(InputError, match="one angle a view"):
            write_r2_gaussian(tmp_path / "out", scan, lines, DELTA)
    with pytest.raises(InputError, match=r"up to 0\.2 pixels beside"):
        write_r2_gaussian(tmp_path / "out", views_about_y((7, 10), (0.2, 0)), lines, DELTA)
    assert not (tmp_path / "out").exists()
