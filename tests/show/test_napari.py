"""The plug-in of napari: its manifest, and the layers that its reader gives."""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import holosplat
from holosplat.geometry import Grid
from holosplat.io.objects import write_object
from holosplat.io.volumes import write_volume
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import MovingSurfaces, SurfaceMesh, TimeBasis, VoxelGrid
from holosplat.show.napari import get_reader, layers
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume

ROOT = Path(__file__).resolve().parents[2]
MATTER = Matter((DeltaBeta(4e-7, 2e-10),))
GRID = Grid((3, 5, 7), (1e-6, 2e-6, 3e-6), (-3e-6, 1e-6, 4e-6))


def ball() -> SurfaceMesh:
    points, faces = icosphere(2)
    return SurfaceMesh(torch.from_numpy(9.0 * points), torch.from_numpy(faces.copy()), 2e-6, MATTER)


def test_the_manifest_leads_to_the_reader():
    """Every command of a reader is there, and names a function; the package says where the manifest is."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    package, name = project["entry-points"]["napari.manifest"]["holosplat"].split(":")
    assert package == "holosplat"
    text = (Path(holosplat.__file__).parent / name).read_text(encoding="utf-8")
    manifest = yaml.safe_load(text)
    assert manifest["name"] == project["name"]
    commands = {c["id"]: c["python_name"] for c in manifest["contributions"]["commands"]}
    for reader in manifest["contributions"]["readers"]:
        module, function = commands[reader["command"]].split(":")
        assert getattr(import_module(module), function) is get_reader
        assert reader["accepts_directories"] is True


def test_a_volume_file_becomes_two_images_in_micrometres(tmp_path):
    values = np.random.default_rng(0).random((2, *GRID.shape)).astype(np.float32)
    write_volume(tmp_path / "v.h5", Volume(values[0], values[1], GRID))
    reader = get_reader(str(tmp_path / "v.h5"))
    assert reader is not None
    (delta, options, kind), (beta, _, _) = reader(str(tmp_path / "v.h5"))
    np.testing.assert_array_equal(delta, values[0])
    np.testing.assert_array_equal(beta, values[1])
    assert (kind, options["name"], options["metadata"]["unit"]) == ("image", "v delta", "µm")
    assert options["scale"] == pytest.approx((3, 2, 1))
    assert options["translate"] == pytest.approx((4, 1, -3))


def test_surfaces_become_triangles_with_time_first_where_they_move(tmp_path):
    still = ball()
    write_object(tmp_path / "o.h5", still)
    (((points, faces), options, kind),) = layers(str(tmp_path / "o.h5"))
    assert (kind, options["metadata"]["kind"]) == ("surface", "surfaces")
    np.testing.assert_allclose(points, 2 * still.vertices.numpy()[:, ::-1])
    np.testing.assert_array_equal(faces, still.faces.numpy())
    paths = torch.stack([still.vertices, still.vertices + 1])
    body = torch.zeros(len(still.faces), dtype=torch.int64)
    write_object(tmp_path / "m.h5", MovingSurfaces(paths, still.faces, body, TimeBasis(0, 1e-5, 1), 2e-6, MATTER))
    (((points, faces), _, _),) = layers(str(tmp_path / "m.h5"))
    assert points.shape[1] == 4
    assert len(np.unique(points[:, 0])) == 48
    last = points[points[:, 0] == 47]
    np.testing.assert_allclose(last[:, 1:], 2 * (still.vertices.numpy()[:, ::-1] + 1), atol=1e-9)
    assert faces.max() == len(points) - 1


def test_other_objects_become_images_around_them(tmp_path):
    voxels = VoxelGrid(
        torch.rand(1, 4, 6, 5, generator=torch.Generator().manual_seed(0)), Grid.centred((4, 6, 5), 1e-6), MATTER
    )
    write_object(tmp_path / "o.h5", voxels)
    (delta, options, _), _ = layers(str(tmp_path / "o.h5"))
    assert delta.sum() == pytest.approx(4e-7 * float(voxels.values.sum()), rel=1e-4, abs=0)
    assert options["metadata"]["described"] == voxels.described


def test_what_is_not_ours_is_left_to_others(tmp_path):
    (tmp_path / "text.h5").write_text("no HDF5")
    (tmp_path / "image.tif").write_bytes(b"II")
    for path in (tmp_path, tmp_path / "text.h5", tmp_path / "image.tif", tmp_path / "none.h5"):
        assert get_reader(str(path)) is None
    assert get_reader([str(tmp_path / "a.h5")]) is None
