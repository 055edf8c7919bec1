"""What other programs read: OME-Zarr, STL, glTF and splats, each by a reader that is not ours."""

from __future__ import annotations

import builtins
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numcodecs import get_codec

from helpers.splats import cloud
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io import ome
from holosplat.io.ome import halved, levels_of, write_ome_zarr
from holosplat.io.solids import CONSTANT, DEPTH, PLAY_S, write_glb, write_moving_glb, write_splats, write_stl
from holosplat.matter import DeltaBeta, Matter
from holosplat.mesh import TriangleMesh
from holosplat.representations import GaussianCloud, MovingSurfaces, TimeBasis, VoxelGrid
from holosplat.representations.gaussians import raw_of
from holosplat.specimens.red_cells import icosphere

PIXEL = 2e-6
MATTER = Matter((DeltaBeta(4e-7, 2e-10),))
GRID = Grid((5, 71, 66), (1e-6, 2e-6, 3e-6), (-3e-5, 1e-6, 4e-6))


# --- OME-Zarr -----------------------------------------------------------------------------------------------


def voxels() -> VoxelGrid:
    """Random voxels on an uneven raster."""
    return VoxelGrid(torch.rand(1, *GRID.shape, generator=torch.Generator().manual_seed(0)), GRID, MATTER)


def by_hand(folder: Path, level: str) -> np.ndarray:
    """An array of Zarr's version 2 by its specification: JSON, and one compressed file a chunk."""
    about = json.loads((folder / level / ".zarray").read_text())
    codec = get_codec(about["compressor"])
    shape, chunks = about["shape"], about["chunks"]
    found = np.full(shape, about["fill_value"], about["dtype"])
    counts = [-(-n // c) for n, c in zip(shape, chunks)]
    for index in np.ndindex(*counts):
        path = folder / level / about["dimension_separator"].join(map(str, index))
        if path.is_file():
            block = np.frombuffer(codec.decode(path.read_bytes()), about["dtype"]).reshape(chunks, order=about["order"])
            place = tuple(slice(i * c, min((i + 1) * c, n)) for i, c, n in zip(index, chunks, shape))
            found[place] = block[tuple(slice(0, p.stop - p.start) for p in place)]
    return found


def test_ome_zarr_holds_both_channels_at_all_levels(tmp_path, monkeypatch):
    monkeypatch.setattr(ome, "SLAB_VOXELS", 1)  # a row of chunks at a time
    obj = voxels()
    write_ome_zarr(tmp_path / "v.ome.zarr", obj, GRID)
    true = obj.voxelise(GRID)
    first, second = (by_hand(tmp_path / "v.ome.zarr", level) for level in "01")
    np.testing.assert_array_equal(first, np.stack([true.delta, true.beta]))
    assert second.shape == (2, 3, 36, 33)
    np.testing.assert_allclose(second[0, 1, 4, 6], true.delta[2:4, 8:10, 12:14].mean(), rtol=1e-6)
    np.testing.assert_array_equal(second, halved(first))
    about = json.loads((tmp_path / "v.ome.zarr" / ".zattrs").read_text())
    image = about["multiscales"][0]
    assert [axis["name"] for axis in image["axes"]] == list("czyx")
    assert {axis.get("unit") for axis in image["axes"][1:]} == {"micrometer"}
    scale, place = image["datasets"][0]["coordinateTransformations"]
    np.testing.assert_allclose(scale["scale"], [1, 3, 2, 1])
    np.testing.assert_allclose(place["translation"], [0, 4, 1, -30])
    scale, place = image["datasets"][1]["coordinateTransformations"]
    np.testing.assert_allclose(scale["scale"], [1, 6, 4, 2])
    np.testing.assert_allclose(place["translation"], [0, 5.5, 2, -29.5])
    assert [c["label"] for c in about["omero"]["channels"]] == ["delta", "beta"]
    assert about["omero"]["channels"][1]["window"]["max"] == true.beta.max()


def test_levels_halve_down_to_one_chunk():
    assert levels_of((300, 128, 5)) == [(300, 128, 5), (150, 64, 3), (75, 32, 2), (38, 16, 1)]


def test_ome_zarr_without_its_package_says_how_to_get_it(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "zarr":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"holosplat\[zarr\]"):
        write_ome_zarr(tmp_path / "v.zarr", voxels(), GRID)
    assert not list(tmp_path.iterdir())


# --- bodies -------------------------------------------------------------------------------------------------


def bodies() -> list[TriangleMesh]:
    """Two balls of 7 and 5 µm, apart."""
    points, faces = icosphere(2)
    places = ((7e-6, (1e-5, -4e-6, 3e-6)), (5e-6, (-1e-5, 6e-6, 0.0)))
    return [TriangleMesh(r * points + np.array(c), faces, f"body{k:03d}") for k, (r, c) in enumerate(places)]


def test_stl_holds_all_bodies_in_micrometres(tmp_path):
    write_stl(tmp_path / "b.stl", bodies())
    found = trimesh.load_mesh(tmp_path / "b.stl")
    assert found.is_watertight
    parts = sorted(found.split(), key=lambda part: -part.volume)
    assert [part.volume for part in parts] == pytest.approx([1e18 * body.volume for body in bodies()], rel=1e-5)
    assert parts[0].center_mass == pytest.approx([10, -4, 3], abs=1e-4)
    assert b"lengths in um" in (tmp_path / "b.stl").read_bytes()[:80]


def test_glb_has_a_node_a_body_in_metres_with_y_up(tmp_path):
    write_glb(tmp_path / "b.glb", bodies(), [MATTER] * 2)
    scene = trimesh.load_scene(tmp_path / "b.glb")
    assert sorted(scene.graph.nodes_geometry) == ["body000", "body001"]
    for body in bodies():
        turn, name = scene.graph[body.name]
        found = scene.geometry[name].copy().apply_transform(turn)
        assert found.volume == pytest.approx(body.volume, rel=1e-4, abs=0)
        middle = body.vertices.mean(axis=0) * np.array([1, -1, -1])
        assert found.center_mass == pytest.approx(middle, abs=1e-10)


def document(path: Path) -> dict:
    """The JSON part of a GLB file."""
    content = path.read_bytes()
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


def test_glb_says_what_each_body_is_of_and_when_it_moves(tmp_path):
    other = Matter.one(-3e-7, -1e-10)
    write_glb(tmp_path / "b.glb", bodies(), [other, MATTER])
    said = document(tmp_path / "b.glb")
    own = [said["materials"][mesh["primitives"][0]["material"]]["extras"] for mesh in said["meshes"]]
    assert own == [{"delta": -3e-7, "beta": -1e-10}, {"delta": MATTER.delta, "beta": MATTER.beta}]
    write_glb(tmp_path / "b.glb", bodies(), [MATTER] * 2)
    assert len(document(tmp_path / "b.glb")["materials"]) == 1
    write_moving_glb(tmp_path / "m.glb", moving(), [1e-6, 9e-6])
    assert document(tmp_path / "m.glb")["animations"][0]["extras"] == {"first_s": 1e-6, "last_s": 9e-6}


def moving() -> MovingSurfaces:
    """The balls on curved ways in two pieces of time."""
    shapes = bodies()
    rng = np.random.default_rng(1)
    paths = [body.vertices + 4e-6 * rng.normal(size=(4, 1, 3)) for body in shapes]
    return MovingSurfaces.of_bodies(paths, [b.faces for b in shapes], TimeBasis(1e-6, 9e-6, 2, 2), PIXEL, MATTER)


def by_vtk(path: Path, seconds: float) -> list[np.ndarray]:
    """Points of each body as VTK plays the animation at a time of the film."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataIterator
    from vtkmodules.vtkIOGeometry import vtkGLTFReader

    reader = vtkGLTFReader()
    reader.SetFileName(str(path))
    reader.ApplyDeformationsToGeometryOn()
    reader.SetFrameRate(0)  # any time, not frames
    reader.UpdateInformation()
    assert reader.GetAnimationDuration(0) == pytest.approx(PLAY_S)
    reader.EnableAnimation(0)
    reader.UpdateTimeStep(seconds)
    found = reader.GetOutputDataObject(0).NewIterator()
    assert isinstance(found, vtkCompositeDataIterator)
    points = []
    while not found.IsDoneWithTraversal():
        points.append(vtk_to_numpy(found.GetCurrentDataObject().GetPoints().GetData()).copy())
        found.GoToNextItem()
    return points


@pytest.mark.parametrize("share", [0.0, 0.25, 0.8125, 1.0])
def test_a_moving_glb_is_where_the_bodies_are(share, tmp_path):
    obj, times = moving(), np.linspace(1e-6, 9e-6, 5)
    write_moving_glb(tmp_path / "m.glb", obj, times.tolist())
    played = by_vtk(tmp_path / "m.glb", PLAY_S * share)
    true = obj.bodies(float(times[0] + share * np.ptp(times)))
    assert len(played) == len(true) == 2
    for points, body in zip(played, true):
        np.testing.assert_allclose(points, body.vertices * np.array([1, -1, -1]), atol=1e-9)


# --- splats -------------------------------------------------------------------------------------------------


def gaussians(channels: int = 1) -> GaussianCloud:
    centres, scales, quaternions, amplitudes = cloud("ordinary", channels, 60)
    matter = MATTER if channels == 1 else Matter.several((4e-7, 2e-10), (1e-7, 1e-10))
    return GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.05)), PIXEL, matter)


def test_splats_have_the_layout_and_units_of_viewers(tmp_path):
    obj = gaussians()
    write_splats(tmp_path / "g.ply", obj)
    raw = trimesh.load(tmp_path / "g.ply").metadata["_ply_raw"]["vertex"]
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    assert list(raw["properties"]) == names
    rows = raw["data"]
    assert len(rows) == len(obj)
    np.testing.assert_allclose(rows["y"].ravel(), 2 * obj.centres[:, 1], rtol=1e-6)
    np.testing.assert_allclose(np.exp(rows["scale_2"].ravel()), 2 * obj.scales[:, 2], rtol=1e-5)
    turned = np.stack([rows[f"rot_{k}"].ravel() for k in range(4)], axis=1)
    assert np.linalg.norm(turned, axis=1) == pytest.approx(1.0)
    assert (np.sum(turned * obj.quaternions.numpy(), axis=1) > 0).all()
    assert 0.5 + CONSTANT * rows["f_dc_0"].ravel() == pytest.approx(0.9)


def test_a_round_gaussian_is_as_deep_as_it_is_thick(tmp_path):
    """One alone has the optical depth that is asked for, whatever its size; one half as dense has half of it."""
    one = torch.ones(1, 3)
    turns, log = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 3.0).log()
    far = torch.cat([0 * one, 60 * one])
    obj = GaussianCloud((far, log, turns, raw_of(torch.tensor([[1.0], [0.5]]))), PIXEL, MATTER)
    write_splats(tmp_path / "g.ply", obj)
    logits = trimesh.load(tmp_path / "g.ply").metadata["_ply_raw"]["vertex"]["data"]["opacity"].ravel()
    depth = -np.log(1 - 1 / (1 + np.exp(-logits.astype(float))))
    assert depth[1] == pytest.approx(0.5 * depth[0], rel=1e-5)
    assert depth[0] == pytest.approx(DEPTH, rel=0.05)  # the thickest pixel of the image


def test_two_materials_have_two_colours_and_none_is_refused(tmp_path):
    obj = gaussians(2)
    write_splats(tmp_path / "g.ply", obj)
    data = trimesh.load(tmp_path / "g.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert np.ptp(data["f_dc_0"]) > 0.5
    none = obj.replaced(p[:0] for p in obj.parameters().values())
    with pytest.raises(InputError, match="at least one Gaussian"):
        write_splats(tmp_path / "n.ply", none)
