"""Bodies that move: interpolation, periodic boxes, and which files show what at what time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holosplat.beamline.series import SeriesFiles, Timing, held_out, read_series
from holosplat.beamline.simulate import Filling, Shutter
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io.paraview import find_snapshots
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.materials import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, MeshSeries
from holosplat.volume import Object

GLASS = DeltaBeta(1e-6, 1e-9)
UM = 1e-6
BOX_UM = 20.0


def ball(centre, radius=3.0, name="ball", subdivisions=1) -> TriangleMesh:
    """A ball about `centre`, lengths in µm."""
    vertices, faces = icosphere(subdivisions)
    return TriangleMesh(UM * (radius * vertices + np.asarray(centre, dtype=float)), faces, name)


def series(*centres, times=None) -> MeshSeries:
    """Snapshots of one ball each, at the given centres [µm]."""
    scenes = tuple(MeshScene.of_one_material([ball(c, name=f"ball_{n}")], GLASS) for n, c in enumerate(centres))
    return MeshSeries(scenes, np.arange(len(centres)) * 1.0 if times is None else np.array(times))


def centre(scene: MeshScene) -> np.ndarray:
    return scene.meshes[0].vertices.mean(0) / UM


# --- between snapshots --------------------------------------------------------------------------------------


def test_vertices_move_straight_between_uneven_times():
    moving = series((0, 1, 2), (4, 1, -2), (4, 9, -2), times=[2.0, 3.0, 7.0])
    assert isinstance(moving, Object)
    for time, wanted in ((2, (0, 1, 2)), (2.25, (1, 1, 1)), (3, (4, 1, -2)), (6, (4, 7, -2)), (7, (4, 9, -2))):
        np.testing.assert_allclose(centre(moving.at(time)), wanted, atol=1e-9)
    np.testing.assert_allclose(moving.at(2.5).meshes[0].volume, moving.at(2).meshes[0].volume, rtol=1e-9)
    low, high = moving.bounds
    np.testing.assert_allclose(low / UM, (-3, -2, -5), atol=0.5)
    np.testing.assert_allclose(high / UM, (7, 12, 5), atol=0.5)


def test_the_volume_is_right_to_second_order_in_the_turn():
    """Straight lines between poses that differ by an angle: the loss falls by four where the angle is halved."""
    body, lost = ball((0, 0, 0), subdivisions=2), []
    stretched = TriangleMesh(body.vertices * np.array([2, 1, 1]), body.faces)
    for angle in (0.4, 0.2, 0.1):
        turned = stretched.transformed(Rotation.from_euler("z", angle).as_matrix(), np.zeros(3))
        scenes = tuple(MeshScene((mesh,), (GLASS,)) for mesh in (stretched, turned))
        half = MeshSeries(scenes, np.array([0.0, 1.0])).at(0.5).meshes[0]
        lost.append(1 - half.volume / stretched.volume)
    orders = np.log2(np.array(lost[:-1]) / np.array(lost[1:]))
    assert np.all(np.abs(orders - 2) < 0.05), orders


def test_a_series_is_projected_and_voxelised_as_it_is_first():
    moving = series((0, 0, 0), (5, 0, 0))
    views = Views.from_angles([0, 50], (13, 17), UM)
    grid = Grid.centred((9, 11, 13), UM)
    first = moving.at(0)
    assert np.array_equal(moving.project(views)[1], first.project(views)[1])
    assert np.array_equal(moving.voxelise(grid).delta, first.voxelise(grid).delta)
    wide = Views.from_angles([0], (40, 14), UM)
    assert moving.missing_field(wide) == pytest.approx(max(m.vertices[:, 0].max() for m in moving.at(1).meshes) - 7e-6)


def test_a_body_is_followed_through_the_sides_of_a_periodic_box():
    """x is folded at 20 µm, there and back; y is not periodic, and its steps stay."""
    x = np.array([16, 18, 19, 21, 18, 17, 16.0])
    y = np.array([0, 8, 16, 24, 32, 40, 48.0])
    folded = series(*zip(np.mod(x, BOX_UM), y, np.zeros(7)))
    unfolded = folded.unfolded(UM * np.array([BOX_UM, 0, 0]))
    found = np.array([centre(scene) for scene in unfolded.snapshots])
    np.testing.assert_allclose(found[:, 0], x, atol=1e-9)
    np.testing.assert_allclose(found[:, 1], y, atol=1e-9)
    unfolded.moved(np.array([1, 2, 3])).require_continuous()
    with pytest.raises(InputError, match=r"ball_3 jumps by 18 µm along x .*--period"):
        folded.require_continuous()
    with pytest.raises(InputError, match="period must not be negative"):
        folded.unfolded(np.array([-1.0, 0, 0]))
    with pytest.raises(InputError, match=r"at least as long as the bodies, .* m along x, but it is 2e-11 m; mind"):
        folded.unfolded(np.array([20e-12, 0, 0]))


def test_series_that_cannot_be_are_refused():
    one, other = (
        MeshScene.of_one_material([ball((0, 0, 0))], GLASS),
        MeshScene.of_one_material([ball((1, 0, 0))], GLASS),
    )
    finer = MeshScene.of_one_material([ball((0, 0, 0), subdivisions=2, name="finer")], GLASS)
    rewired = TriangleMesh(other.meshes[0].vertices, other.meshes[0].faces[::-1], "rewired")
    for scenes, times, words in (
        ((), [], "at least one snapshot"),
        ((one, other), [0.0, 0.0], r"must grow, but the one numbered 1 .* at 0 s"),
        ((one, other), [0.0, np.nan], "snapshot times"),
        ((one, other), [0.0], "snapshot times"),
        ((one, finer), [0.0, 1.0], r"finer must have the triangles of ball \(80 on 42 vertices\).* 320 on 162"),
        ((one, MeshScene((rewired,), (GLASS,))), [0.0, 1.0], "rewired .* joins them otherwise"),
        ((one, MeshScene(one.meshes * 2, (GLASS, GLASS))), [0.0, 1.0], "holds 1 and another 2"),
        ((one, MeshScene(other.meshes, (DeltaBeta(2e-6, 0),))), [0.0, 1.0], "made of"),
    ):
        with pytest.raises(InputError, match=words):
            MeshSeries(scenes, np.array(times))
    for time in (-0.1, 1.1):
        with pytest.raises(InputError, match=r"between the first and the last snapshot, 0 and 1 s"):
            MeshSeries((one, other), np.array([0.0, 1.0])).at(time)


# --- files --------------------------------------------------------------------------------------------------


def written(folder: Path, bodies=("a", "b"), numbers=(0, 1, 2), header="t=%gus") -> Path:
    """Numbered snapshots 4 µs apart of bodies that move along y by 2 µm a snapshot; header: how they say the time."""
    for k, body in enumerate(bodies):
        for n in numbers:
            mesh = ball((10 * k, 2 * n, 0), name=f"{body} {header % (4 * n)}" if header else body)
            write_mesh(folder / f"{body}_{n:03d}.vtk", mesh, "um")
    return folder


def collection(path: Path, entries) -> Path:
    lines = "".join(f'<DataSet timestep="{time}" part="0" file="{file}"/>' for time, file in entries)
    path.write_text(f'<?xml version="1.0"?><VTKFile type="Collection"><Collection>{lines}</Collection></VTKFile>')
    return path


def test_numbered_files_are_matched_by_body_and_timed_by_their_headers(tmp_path):
    found = find_snapshots([written(tmp_path)])
    assert [s.time for s in found] == pytest.approx([0, 4e-6, 8e-6])
    assert [[f.name for f in s.files] for s in found] == [[f"a_{n:03d}.vtk", f"b_{n:03d}.vtk"] for n in range(3)]
    shuffled = find_snapshots(sorted(tmp_path.iterdir(), reverse=True), interval=0.5)
    assert [s.files for s in shuffled] == [s.files for s in found]
    assert [s.time for s in shuffled] == [0, 0.5, 1.0]
    sparse = find_snapshots([f for f in tmp_path.iterdir() if "001" not in f.name], interval=0.5)
    assert [s.time for s in sparse] == [0, 1.0]


def test_a_collection_says_its_times(tmp_path):
    """In its unit; a header that says a time with its unit is believed instead, and so is an interval."""
    written(tmp_path, header="")
    entries = [(0.5 * n, f"{body}_{n:03d}.vtk") for body in "ba" for n in (2, 0, 1)]
    pvd = collection(tmp_path / "all.pvd", entries)
    assert [s.time for s in find_snapshots([pvd])] == [0, 0.5, 1.0]
    assert [s.time for s in find_snapshots([pvd], time_unit="us")] == pytest.approx([0, 0.5e-6, 1e-6])
    assert [s.time for s in find_snapshots([pvd], interval=3)] == [0, 3, 6]
    assert [f.name for f in find_snapshots([pvd])[2].files] == ["a_002.vtk", "b_002.vtk"]
    written(tmp_path)
    assert [s.time for s in find_snapshots([pvd])] == pytest.approx([0, 4e-6, 8e-6])


def test_snapshots_that_cannot_be_are_refused(tmp_path):
    folder = written(tmp_path, header="")
    files = sorted(folder.iterdir())
    (folder / "cell.vtk").write_bytes(files[0].read_bytes())
    pvd = collection(folder / "x.pvd", [(0, "a_000.vtk"), (0, "a_001.vtk")])
    for paths, kind, words in (
        (files, {}, "a_000.vtk does not say its time .*--snapshot-interval"),
        (files, {"interval": 0.0}, "snapshot interval must be a positive number"),
        (files[:-1], {"interval": 1.0}, r"b_000.vtk has no match beside a_002.vtk"),
        ([*files, folder / "cell.vtk"], {}, "cell.vtk must end with the number"),
        ([pvd, files[0]], {}, "must be given alone"),
        ([pvd], {}, "a_001.vtk and .*a_000.vtk are the same body"),
        (files, {"time_unit": "s"}, "goes with a collection"),
        ([folder / "none.pvd"], {}, "there is no such file"),
        ([collection(folder / "e.pvd", [])], {}, "must name at least one file"),
        ([collection(folder / "f.pvd", [("soon", "a_000.vtk")])], {}, "timestep of 'a_000.vtk' must be a number"),
        ([collection(folder / "g.pvd", [(0, "gone.vtk")])], {}, "names 'gone.vtk'"),
        ([collection(folder / "h.pvd", [(0, "a_000.vtk")])], {"time_unit": "week"}, "time unit"),
    ):
        with pytest.raises(InputError, match=words):
            find_snapshots(paths, **kind)
    (folder / "i.pvd").write_text("<VTKFile><Coll")
    with pytest.raises(InputError, match=r"i\.pvd must be a readable"):
        find_snapshots([folder / "i.pvd"])
    written(tmp_path, bodies=("a",))
    written(tmp_path, bodies=("b",), header="t=1%gms")
    with pytest.raises(InputError, match="must be of one time"):
        find_snapshots(files)
    written(tmp_path, header="t=-%gus")
    with pytest.raises(InputError, match=r"a_001\.vtk, at -4e-06 s, is not after a_000\.vtk, at -?0 s"):
        find_snapshots(files)


def test_times_of_frames():
    shutter = Shutter(1e-6, 4)
    np.testing.assert_allclose(shutter.offsets, np.array([-3, -1, 1, 3]) * 0.125e-6)
    np.testing.assert_allclose(Timing(1e6).times(3e-6), np.arange(4) * 1e-6)
    np.testing.assert_allclose(Timing(1e6, 2, 0.5e-6).times(3e-6), [0.5e-6, 1.5e-6])
    np.testing.assert_allclose(Timing(1e6, shutter=shutter).times(3e-6), 0.375e-6 + np.arange(3) * 1e-6)
    for timing, length, words in (
        (Timing(1e6, 5), 3e-6, "room for 4 frames .* 5 are asked"),
        (Timing(1e6, start=4e-6), 3e-6, "room for 0 frames"),
        (Timing(1e6, start=0.0, shutter=shutter), 3e-6, "at least 3.75e-07 s"),
    ):
        with pytest.raises(InputError, match=words):
            timing.times(length)
    for bad, words in (
        (lambda: Timing(0), "frame_rate"),
        (lambda: Timing(1, 0), "frames must be at least 1"),
        (lambda: Timing(1, start=-1.0), "start"),
        (lambda: Shutter(1e-6), "both"),
        (lambda: Shutter(0, 3), "both"),
        (lambda: Shutter(-1e-6, 3), "exposure"),
        (lambda: Shutter(1e-6, 0), "pulses"),
    ):
        with pytest.raises(InputError, match=words):
            bad()


def test_views_or_times_are_held_out():
    views = held_out(np.array([False, True]), 2, 3, "views")
    assert views.tolist() == [False, True] * 3
    times = held_out(np.array([False, False, True]), 2, 3, "times")
    assert times.tolist() == [False] * 4 + [True] * 2


def test_a_series_is_read_centred_and_starts_with_the_first_frame(tmp_path):
    """Only the snapshots in need are read; the field's centre is the middle of what they sweep."""
    folder = written(tmp_path, numbers=range(6))
    read, times = read_series([folder], Filling(), 20.0, Timing(0.5e6, 3, 6e-6))
    np.testing.assert_allclose(times, [0, 2e-6, 4e-6], atol=1e-15)
    assert [m.name for scene in read.snapshots for m in scene.meshes[:1]] == ["a_001.vtk", "a_002.vtk", "a_003.vtk"]
    np.testing.assert_allclose(read.times, [-2e-6, 2e-6, 6e-6], atol=1e-15)
    # y runs over 2 … 6 µm in these snapshots: 3 µm at the first frame is 1 µm before the middle.
    np.testing.assert_allclose(centre(read.at(0)), (-5, -1, 0), atol=1e-6)
    placed, _ = read_series([folder], Filling(), 20.0, Timing(0.5e6, 1, 6e-6), SeriesFiles(origin=(1.0, 1.0, 1.0)))
    np.testing.assert_allclose(centre(placed.at(0)), (-1, 2, -1), atol=1e-6)


def test_cells_of_espresso_flow_through_the_periodic_channel(espresso_rbc):
    """Cell 10 leaves the box of 80 µm between snapshots 19 and 20; all move at 0.036 to 0.054 m/s (their README)."""
    timing = Timing(2e5, 4, 19 * 17.73055e-6)
    folded = SeriesFiles(period=(80.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"rbc10_020.vtk jumps by 79\.\d+ µm along x"):
        read_series([espresso_rbc / "vtk"], Filling(), 20.0, timing)
    found, times = read_series([espresso_rbc / "vtk"], Filling(), 20.0, timing, folded)
    assert len(times) == 4
    assert len(found.snapshots[0].meshes) == 16
    first, last = (np.array([m.vertices.mean(0) for m in found.at(t).meshes]) for t in (times[0], times[-1]))
    speed = (last - first)[:, 0] / (times[-1] - times[0])
    assert np.all((speed > 0.030) & (speed < 0.060)), speed
    between = np.array([m.volume for m in found.at(times[1]).meshes])
    assert np.all(np.abs(between / 90.75e-18 - 1) < 0.01)
    (raw,) = read_meshes(espresso_rbc / "vtk/rbc10_019.vtk", "um")
    assert found.snapshots[0].meshes[10].name == raw.name
