"""Simulation frame by frame: motion, blur, noise and memory; misaligned beamlines; volumes in slabs."""

from __future__ import annotations

import tracemalloc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import holosplat.io.volumes as volumes
from holosplat.beamline.misalignment import GEOMETRIES, Directions, Misalignment
from holosplat.beamline.simulate import Shutter, Simulation, _Sharp, simulate, simulated_frames
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.io.nxtomo import read_scan, scan_writer, write_scan
from holosplat.io.volumes import read_volume, write_voxels
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.model import measure
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, MeshSeries

PIXEL = 1e-6
SHAPE = (31, 44)
VELOCITY = np.array([2e-3, -1e-3, 1.5e-3])
"""Of the ball [m/s]."""
GLASS = DeltaBeta(1e-6, 1e-9)
CONTACT = 1e-9
"""A distance [m] too short for fringes."""


def ball(radius: float, centre=(0.0, 0.0, 0.0), matter=GLASS) -> MeshScene:
    vertices, faces = icosphere(3)
    return MeshScene((TriangleMesh(radius * vertices + np.asarray(centre), faces),), (matter,))


def moving_ball(matter=GLASS) -> MeshSeries:
    """At (-5, 3, -4) µm when it begins, for 5 ms."""
    begin = np.array([-5e-6, 3e-6, -4e-6])
    return MeshSeries(
        (ball(4e-6, begin, matter), ball(4e-6, begin + 5e-3 * VELOCITY, matter)),
        np.array([0.0, 5e-3]),
    )


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of (x, y) [m] under the weights `image` [H, W]."""
    h, w = image.shape
    axes = ((np.arange(w) + 0.5 - w / 2) * PIXEL, (np.arange(h) + 0.5 - h / 2) * PIXEL)
    mass = (image.sum(0), image.sum(1))
    mean = np.array([(a * m).sum() / m.sum() for a, m in zip(axes, mass)])
    return mean, np.array([((a - c) ** 2 * m).sum() / m.sum() for a, m, c in zip(axes, mass, mean)])


def views_of(*angles: float) -> Exposures:
    return Exposures.of(Views.from_angles(list(angles), SHAPE, PIXEL), 20.0, 0.02)


# --- motion -------------------------------------------------------------------------------------------------


def test_a_moving_ball_is_where_it_should_be_in_every_frame():
    """Seen along z it moves by (vx, vy), along x by (vz, vy); the views of one time agree on y."""
    exposures = views_of(0, 90).repeated(np.arange(4) * 1e-3)
    assert exposures.time.tolist() == [0, 0, 1e-3, 1e-3, 2e-3, 2e-3, 3e-3, 3e-3]
    scan = simulate(moving_ball(), exposures, oversample=2)
    assert scan.is_series
    for frame, time, rotation in zip(scan.frames, exposures.time, exposures.views.rotations):
        wanted = rotation @ (np.array([-5e-6, 3e-6, -4e-6]) + time * VELOCITY)
        mean, _ = moments((frame - 1.0) ** 2)
        np.testing.assert_allclose(mean, wanted[:2], atol=0.05 * PIXEL)


def test_blur_is_as_long_as_the_way_during_the_exposure():
    """A weak absorber in contact: N flashes over a way L widen its shadow by L² (1 - 1/N²) / 12, about its middle."""
    exposures = Exposures.of(Views.from_angles([0], SHAPE, PIXEL), 20.0, CONTACT).repeated(np.array([2.5e-3]))
    matter, obj = DeltaBeta(0.0, 1e-9), moving_ball(DeltaBeta(0.0, 1e-9))
    assert obj.snapshots[0].materials == (matter,)
    sharp = moments(1 - simulate(obj, exposures).frames[0].astype(float))
    for duration, pulses in ((2e-3, 2), (4e-3, 5)):
        how = Shutter(duration, pulses)
        mean, variance = moments(1 - simulate(obj, exposures, shutter=how).frames[0].astype(float))
        way = VELOCITY[:2] * duration
        np.testing.assert_allclose(mean, sharp[0], atol=0.01 * PIXEL)
        np.testing.assert_allclose(variance - sharp[1], way**2 * (1 - pulses**-2) / 12, rtol=0.01, atol=3e-14)


def test_a_blurred_frame_is_the_mean_of_the_intensities_at_its_pulses():
    exposures, shutter = views_of(0, 35).repeated(np.array([2e-3])), Shutter(1e-3, 3)
    blurred = simulate(moving_ball(), exposures, oversample=2, shutter=shutter)
    parts = [
        simulate(moving_ball(), replace(exposures, time=exposures.time + dt), oversample=2).frames
        for dt in (-1e-3 / 3, 0.0, 1e-3 / 3)
    ]
    np.testing.assert_allclose(blurred.frames, np.mean(parts, axis=0), atol=1e-6)
    assert blurred.provenance["pulses"] == "3"
    assert blurred.provenance["exposure_s"] == "0.001"


def test_times_before_or_after_the_snapshots_are_refused():
    with pytest.raises(InputError, match="first and the last snapshot"):
        simulate(moving_ball(), views_of(0).repeated(np.array([5.1e-3])), oversample=1)


def test_a_series_is_told_from_a_turning_object_and_cut_by_time(tmp_path):
    """Through a file: its times, the frames of one, and all as if nothing moved."""
    exposures = views_of(0, 60).repeated(np.array([0, 1e-3, 4e-3]))
    scan = simulate(moving_ball(), exposures, oversample=1, is_test=np.tile([False, True], 3))
    write_scan(tmp_path / "s.nxs", scan)
    read = read_scan(tmp_path / "s.nxs")
    assert read.is_series
    assert read.instants.tolist() == [0, 1e-3, 4e-3]
    last = read.at_instant(2)
    np.testing.assert_array_equal(last.frames, scan.frames[4:])
    assert (last.is_series, len(last), last.is_test.tolist()) == (False, 2, [False, True])
    assert not read.as_static().is_series
    turned = replace(views_of(0, 60, 120), time=np.arange(3.0))
    assert not Scan(np.ones((3, *SHAPE)), turned, np.zeros(3, bool)).is_series  # each side at its own time
    film = views_of(10).repeated(np.arange(3.0))
    assert Scan(np.ones((3, *SHAPE)), film, np.zeros(3, bool)).is_series
    for index in (-1, 3):
        with pytest.raises(InputError, match=r"from 0 to 2, but -?\d is asked"):
            read.at_instant(index)


# --- numerics and memory ------------------------------------------------------------------------------------


def test_single_precision_is_within_1e_4_of_the_contrast():
    """Against waves in float64, of a strong object: 30 rad, and β of either sign; two and three materials."""
    scene = ball(6e-6, matter=DeltaBeta(2.5e-5, -1e-8))
    scene = MeshScene((*scene.meshes, *ball(2e-6, (3e-6, 1e-6, 0)).meshes), (*scene.materials, DeltaBeta(-4e-6, 2e-7)))
    third = MeshScene((*scene.meshes, *ball(1e-6).meshes), (*scene.materials, DeltaBeta(1e-6, 0.0)))
    for obj in (scene, third):
        taken = replace(views_of(20), psf_sigma_px=np.array([0.6]))
        frame = next(simulated_frames(obj, taken, Simulation(oversample=3)))
        exact = measure(_Sharp(obj, taken), taken, 3, torch.float64)[0].numpy()
        assert np.linalg.norm(exact - 1) > 1
        assert np.linalg.norm(frame - exact) < 2e-5 * np.linalg.norm(exact - 1)


def test_materials_may_be_many_and_add_up():
    """One, two or three kinds of matter take other ways through the projector, to the same lines and voxels."""
    materials = (DeltaBeta(1e-6, 2e-9), DeltaBeta(3e-6, -1e-9), DeltaBeta(-2e-6, 5e-9))
    parts = [ball(4e-6, (2e-6 * n, -1e-6 * n, 0), m) for n, m in enumerate(materials)]
    views, grid = Views.from_angles([0, 40], (15, 22), PIXEL), Grid.centred((12, 11, 16), PIXEL)
    for count in (1, 2, 3):
        scene = MeshScene(tuple(p.meshes[0] for p in parts[:count]), materials[:count])
        whole, sums = scene.project(views), [part.project(views) for part in parts[:count]]
        assert len(whole.materials) == min(count, 2)
        for c in (0, 1):
            np.testing.assert_allclose(whole[c], sum(s[c] for s in sums), rtol=1e-9, atol=1e-21)
        volume, voxels = scene.voxelise(grid), [part.voxelise(grid) for part in parts[:count]]
        for name in ("delta", "beta"):
            total = sum(getattr(v, name) for v in voxels)
            np.testing.assert_allclose(getattr(volume, name), total, atol=1e-6 * np.abs(total).max())


def test_noise_is_the_same_frame_by_frame_and_all_at_once(tmp_path):
    exposures = views_of(0, 30, 60)
    how = Simulation(photons_per_pixel=500.0, seed=4, oversample=1)
    frames = list(simulated_frames(ball(5e-6), exposures, how))
    scan = simulate(ball(5e-6), exposures, photons_per_pixel=500.0, seed=4, oversample=1)
    assert np.array_equal(scan.frames, frames)
    assert not np.array_equal(frames[0], next(simulated_frames(ball(5e-6), exposures[[0]], replace(how, seed=5))))
    for bad, words in (({"photons_per_pixel": 0.0}, "photons_per_pixel"), ({"seed": -1}, "seed")):
        with pytest.raises(InputError, match=words):
            Simulation(**bad)


def test_frames_stream_to_the_file(tmp_path):
    """Of 40 frames never more than two are alive, and what is allocated is what it is for 5."""
    peaks = []
    for count in (5, 5, 40):  # the first one loads what is loaded once
        exposures = views_of(0, 20, 40, 60, 80).repeated(np.arange(count // 5) * 5e-4)
        alive: list[weakref.ref[np.ndarray]] = []
        tracemalloc.start()
        with scan_writer(tmp_path / "s.nxs", exposures, np.zeros(count, bool), {}) as add:
            for frame in simulated_frames(ball(4e-6), exposures, Simulation(oversample=1)):
                alive = [one for one in alive if one() is not None] + [weakref.ref(frame)]
                assert len(alive) <= 2
                add(frame)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert read_scan(tmp_path / "s.nxs").frames.shape == (count, *SHAPE)
    assert peaks[2] < peaks[1] + 8 * SHAPE[0] * SHAPE[1] * 4  # eight frames, where 35 more were made


# --- files --------------------------------------------------------------------------------------------------


def write(path, frames) -> None:
    """Frames to a file of two exposures; an exception among them is raised when its turn comes."""
    with scan_writer(path, views_of(0, 1), np.zeros(2, bool), {}) as add:
        for frame in frames:
            if not isinstance(frame, np.ndarray):
                raise frame
            add(frame)


@pytest.mark.parametrize("fault", [KeyboardInterrupt, InputError, ZeroDivisionError])
def test_an_interrupted_file_leaves_what_was_there(tmp_path, fault):
    (tmp_path / "s.nxs").write_text("mine")
    with pytest.raises(fault):
        write(tmp_path / "s.nxs", [np.ones(SHAPE), fault])
    assert [p.name for p in tmp_path.iterdir()] == ["s.nxs"]
    assert (tmp_path / "s.nxs").read_text() == "mine"


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([np.ones(SHAPE)], "2 exposures needs as many frames, but there are 1"),
        ([np.ones(SHAPE)] * 3, "2 exposures takes as many frames"),
        ([np.ones(SHAPE[::-1])], r"frame must have the shape \(31, 44\)"),
        ([np.full(SHAPE, np.nan)], "finite"),
    ],
)
def test_frames_that_do_not_fit_are_refused(tmp_path, frames, words):
    with pytest.raises(InputError, match=words):
        write(tmp_path / "s.nxs", frames)
    assert list(tmp_path.iterdir()) == []


def test_a_volume_in_slabs_is_the_volume(tmp_path, monkeypatch):
    """Uneven voxels, an odd number of rows, a last slab that is thinner; no slab is larger than it may be."""
    scene = ball(4e-6, (1e-6, -1e-6, 2e-6))
    grid, done, sizes = Grid((13, 23, 17), (1e-6, 0.5e-6, 0.9e-6), (-7e-6, -6e-6, -4e-6)), [], []

    class Counted(MeshScene):
        def voxelise(self, grid):
            sizes.append(int(np.prod(grid.shape)))
            return super().voxelise(grid)

    monkeypatch.setattr(volumes, "SLAB_VOXELS", 5 * 13 * 17 + 100)
    write_voxels(tmp_path / "v.h5", Counted(scene.meshes, scene.materials), grid, done.append)
    assert sizes == [5 * 13 * 17] * 4 + [3 * 13 * 17]
    assert done == pytest.approx([5 / 23, 10 / 23, 15 / 23, 20 / 23, 1])
    read, whole = read_volume(tmp_path / "v.h5"), scene.voxelise(grid)
    assert read.grid == grid
    np.testing.assert_allclose(read.delta, whole.delta, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(read.beta, whole.beta, rtol=1e-5, atol=1e-15)
    assert whole.delta.max() == pytest.approx(1e-6)
    with pytest.raises(KeyboardInterrupt):
        write_voxels(tmp_path / "w.h5", scene, grid, interrupt)
    assert [p.name for p in tmp_path.iterdir()] == ["v.h5"]


def interrupt(fraction: float) -> None:
    raise KeyboardInterrupt


# --- where views look from ----------------------------------------------------------------------------------


def test_tilted_views():
    angles, tilts = np.array([0.0, 23.8, -70, 135]), np.array([0, 4.0, -6, 90])
    found = rotation_tilted(angles, tilts)
    np.testing.assert_allclose(
        found, Rotation.from_euler("yx", np.stack([angles, tilts], 1), degrees=True).as_matrix(), atol=1e-12
    )
    beam = found[1].T @ [0, 0, 1]  # in the object frame
    assert np.rad2deg(np.arcsin(beam[1])) == pytest.approx(4.0)
    with pytest.raises(InputError, match="one tilt for each of the 4 angles, but there are 3"):
        rotation_tilted(angles, tilts[:3])
    with pytest.raises(InputError, match="tilt"):
        rotation_tilted([0.0], [np.inf])


def test_known_geometries():
    angles = {name: Directions(geometry=name).on((4, 6), PIXEL) for name in GEOMETRIES}
    for name, wanted in (
        ("thesis16", np.arange(16) * 11.25),
        ("xmpi_2beam", [0, 23.8]),
        ("xmpi_3beam", [0, 30, 48]),
    ):
        np.testing.assert_allclose(
            angles[name].rotations, Views.from_angles(wanted, (4, 6), PIXEL).rotations, atol=1e-12
        )
    for bad, words in (
        (Directions(), "exactly one"),
        (Directions(views=3, geometry="thesis16"), "exactly one"),
        (Directions(views=3, tilts_deg=(1.0,)), "--tilts-deg needs --angles-deg"),
        (Directions(angles_deg=(1.0, 2.0), tilts_deg=(1.0,)), "one tilt for each of the 2"),
    ):
        with pytest.raises(InputError, match=words):
            bad.on((4, 6), PIXEL)


# --- misalignment -------------------------------------------------------------------------------------------


def many(count: int) -> Exposures:
    views = Views(Rotation.random(count, rng=1).as_matrix(), np.full((count, 2), 3e-6), SHAPE, 2 * PIXEL)
    return Exposures.of(views, 20.0, 0.1)


def test_errors_have_the_size_that_was_asked_for():
    nominal = many(4000)
    true = Misalignment(1.5, 0.2, 0.01, seed=3).true_exposures(nominal)
    shifts = (true.views.shifts - nominal.views.shifts) / (2 * PIXEL)
    turns = Rotation.from_matrix(true.views.rotations @ nominal.views.rotations.swapaxes(1, 2)).as_rotvec(degrees=True)
    stretch = true.distance / nominal.distance - 1
    for found, sigma in ((shifts, 1.5), (turns, 0.2), (stretch[:, None], 0.01)):
        np.testing.assert_allclose(found.std(0), sigma, rtol=0.05)
        assert np.all(np.abs(found.mean(0)) < 5 * sigma / np.sqrt(len(found)))
    assert np.abs(np.corrcoef(np.concatenate([shifts, turns, stretch[:, None]], 1).T) - np.eye(6)).max() < 0.08


def test_each_kind_of_error_is_drawn_apart():
    nominal = many(5)
    whole = Misalignment(1.0, 0.5, 0.02, seed=1).true_exposures(nominal)
    shifted = Misalignment(1.0, seed=1).true_exposures(nominal)
    np.testing.assert_array_equal(whole.views.shifts, shifted.views.shifts)
    np.testing.assert_allclose(shifted.views.rotations, nominal.views.rotations, atol=1e-15)
    assert np.array_equal(shifted.distance, nominal.distance)
    other = Misalignment(1.0, 0.5, 0.02, seed=2).true_exposures(nominal)
    assert not np.allclose(other.views.shifts, whole.views.shifts)
    assert not np.allclose(other.distance, whole.distance)
    none = Misalignment().true_exposures(nominal)
    assert np.array_equal(none.views.shifts, nominal.views.shifts)


def test_turns_are_about_the_axes_of_the_lab():
    """Whatever the pose, the same seed turns the beamline by the same."""
    error = Misalignment(rotation_deg=0.5, seed=4)
    tilted, straight = many(5), views_of(*[0.0] * 5)
    turns = [
        error.true_exposures(nominal).views.rotations @ nominal.views.rotations.swapaxes(1, 2)
        for nominal in (tilted, straight)
    ]
    np.testing.assert_allclose(turns[0], turns[1], atol=1e-12)


def test_a_detector_shifted_by_whole_pixels_shifts_the_frame():
    """A detector moved to the right by 3 pixels and up by 2 sees the ball as much further left and lower."""
    straight = views_of(25)
    moved = replace(straight, views=replace(straight.views, shifts=PIXEL * np.array([[3.0, -2.0]])))
    frame, other = (simulate(ball(4e-6), e, oversample=2).frames[0] for e in (straight, moved))
    np.testing.assert_allclose(other[2:, :-3], frame[:-2, 3:], atol=1e-4)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"shift_px": -1.0}, "misalignment shift_px must lie between 0 and 1000, but it is -1"),
        ({"rotation_deg": 50.0}, "rotation_deg"),
        ({"distance": 0.2}, "distance must lie between 0 and 0.1"),
        ({"distance": np.nan}, "distance"),
        ({"seed": -1}, "seed"),
    ],
)
def test_errors_that_cannot_be_are_refused(bad, words):
    with pytest.raises(InputError, match=words):
        Misalignment(**bad)
