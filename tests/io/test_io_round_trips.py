"""Whatever is written comes back: scans, volumes, objects, meshes, images and tables, of any values and names."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from helpers.strategies import NAMES, VIEWS, clouds, images, numbers, scans, vectors
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import read_json, write_json
from holosplat.io.images import read_tiff, write_tiff
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.objects import read_object, write_object
from holosplat.io.volumes import read_volume, write_volume
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.representations import GaussianCloud, Stored, SurfaceMesh, VoxelGrid
from holosplat.scan import Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume
from holosplat_bench.formats.nerf_synthetic import (
    LEVELS,
    NerfOptions,
    grey_range,
    read_nerf_synthetic,
    read_png,
    write_nerf_synthetic,
    write_png,
)
from holosplat_bench.formats.r2_gaussian import R2Options, read_r2_gaussian, write_r2_gaussian

FEW = settings(max_examples=20)
"""For formats of many files."""


@pytest.fixture
def place(tmp_path) -> Callable[[], Path]:
    """A new, empty folder at each call: hypothesis calls a test many times."""
    return lambda: Path(tempfile.mkdtemp(dir=tmp_path))


def assert_same_exposures(found: Scan, scan: Scan) -> None:
    """Bit for bit; texts and the split as well."""
    for name in ("rotations", "shifts", "pixel_size"):
        np.testing.assert_array_equal(getattr(found.views, name), getattr(scan.views, name), err_msg=name)
    for name in ("energy_kev", "distance", "psf_sigma_px", "time"):
        np.testing.assert_array_equal(getattr(found.exposures, name), getattr(scan.exposures, name), err_msg=name)
    np.testing.assert_array_equal(found.is_test, scan.is_test)
    assert found.provenance == scan.provenance


# --- scans --------------------------------------------------------------------------------------------------


@given(scan=scans())
def test_a_scan_comes_back_from_nxtomo(scan, place):
    path = place() / "scan.nxs"
    write_scan(path, scan)
    found = read_scan(path)
    np.testing.assert_array_equal(found.frames, scan.frames)
    assert_same_exposures(found, scan)


@FEW
@given(scan=scans(), layout=st.sampled_from(["stack", "files"]))
def test_a_scan_comes_back_from_tiff(scan, layout, place):
    folder = place() / "scan"
    write_tiff(folder, scan, layout)
    found = read_tiff(folder)
    np.testing.assert_array_equal(found.frames, scan.frames)
    assert_same_exposures(found, scan)


@st.composite
def trained(draw: st.DrawFn, poses: st.SearchStrategy[Views] = VIEWS) -> Scan:
    """A scan with a training frame of more than one value, as the folders for other programs need."""
    scan = draw(scans(poses))
    frames = np.array(scan.frames)
    frames[0].flat[:1] = frames[0].max() + 1
    return Scan(frames, scan.exposures, scan.is_test & (np.arange(len(scan)) > 0), scan.provenance)


@FEW
@given(scan=trained(), png=st.sampled_from(["grey16", "rgba8"]))
def test_a_scan_comes_back_from_nerf_synthetic(scan, png, place):
    """Intensities to half a grey level, and cut off at the least and greatest of the training frames."""
    folder = place() / "scan"
    write_nerf_synthetic(folder, scan, NerfOptions(png=png, seed_points=20))
    found = read_nerf_synthetic(folder)
    low, high = grey_range(scan)
    step, size = (high - low) / LEVELS[png], max(abs(low), abs(high))
    np.testing.assert_allclose(found.frames, np.clip(scan.frames, low, high), rtol=0, atol=0.501 * step + 1e-6 * size)
    assert_same_exposures(found, scan)


@st.composite
def about_y(draw: st.DrawFn) -> Views:
    """Views about y without shifts, as R²-Gaussian has them."""
    count, shape = draw(st.integers(1, 3)), draw(st.tuples(st.integers(2, 9), st.integers(2, 9)))
    return Views.from_angles(draw(vectors(-180.0, 180.0, count)), shape, draw(numbers(1e-7, 1e-5)))


@FEW
@given(scan=trained(about_y()), delta=numbers(1e-9, 1e-5), seed=st.integers(0, 2**32 - 1))
def test_line_integrals_come_back_from_r2_gaussian(scan, delta, seed, place):
    """As the transmission of an absorber; the exposures but for the distance, which is contact."""
    thickness = np.random.default_rng(seed).uniform(0, 5, scan.frames.shape) * scan.views.pixel_size
    folder = place() / "scan"
    write_r2_gaussian(folder, scan, thickness, delta, R2Options(seed_points=20))
    found = read_r2_gaussian(folder)
    unit = 0.5 * scan.views.pixel_size * _side(scan.views.shape)
    np.testing.assert_allclose(-np.log(found.frames), thickness / unit, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.views.rotations, scan.views.rotations, rtol=0, atol=1e-12)
    assert found.views.pixel_size == scan.views.pixel_size
    np.testing.assert_array_equal(found.is_test, scan.is_test)


def _side(shape: tuple[int, int]) -> int:
    """Of the square that holds a frame with its columns in the middle [pixels]."""
    longer = max(shape)
    return longer + (longer - shape[1]) % 2


# --- matter -------------------------------------------------------------------------------------------------


@st.composite
def volumes(draw: st.DrawFn) -> Volume:
    shape = draw(st.tuples(*[st.integers(1, 5)] * 3))
    size, origin = draw(vectors(1e-8, 1e-3, 3)), draw(vectors(-1.0, 1.0, 3))
    values = (draw(arrays(np.float32, shape, elements=numbers(-1e-3, 1e-3, 32))) for _ in range(2))
    return Volume(*values, Grid(shape, tuple(size.tolist()), tuple(origin.tolist())))


@given(volume=volumes())
def test_a_volume_comes_back(volume, place):
    path = place() / "volume.h5"
    write_volume(path, volume)
    found = read_volume(path)
    assert found.grid == volume.grid
    np.testing.assert_array_equal(found.delta, volume.delta)
    np.testing.assert_array_equal(found.beta, volume.beta)


@st.composite
def objects(draw: st.DrawFn) -> Stored:
    """Gaussians or voxels of one, two or free materials, or surfaces, with values of any size."""
    pair, unit = draw(vectors(-1e-5, 1e-5, 2, 2)).tolist(), draw(numbers(1e-9, 1e-3))
    one = Matter.one(*pair[0])
    matter = draw(st.sampled_from([one, Matter.several(*pair), Matter.free(*pair[0])]))
    kind = draw(st.sampled_from(["gaussians", "voxels", "surfaces"]))
    if kind == "gaussians":
        centres, scales, *rest = draw(clouds(channels=len(matter)))
        return GaussianCloud([centres, torch.log(scales), *rest], unit, matter)
    if kind == "voxels":
        grid = draw(volumes()).grid
        readable = st.floats(-(2.0**39), 2.0**39, width=32)  # others are refused where they are read
        values = draw(arrays(np.float32, (len(matter), *grid.shape), elements=readable))
        return VoxelGrid(torch.from_numpy(values), grid, matter)
    sphere, faces = (torch.from_numpy(a.copy()) for a in icosphere(1))
    return SurfaceMesh(sphere * draw(numbers(0.1, 1e3)), faces.long(), unit, one, draw(st.integers(1, 4)))


@given(obj=objects())
def test_an_object_comes_back(obj, place):
    """Bit for bit, of its kind and of the same matter."""
    path = place() / "object.h5"
    write_object(path, obj)
    found = read_object(path)
    assert (type(found), found.matter, found.described) == (type(obj), obj.matter, obj.described)
    state, wanted = found.state(), obj.state()
    assert state.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, torch.Tensor):
            np.testing.assert_array_equal(state[name].numpy(), value.numpy(), err_msg=name)
            assert state[name].dtype == value.dtype
        else:
            assert state[name] == value, name


@given(
    scale=numbers(1e-7, 1e-3),
    bumps=vectors(0.7, 1.3, 42),
    unit=st.sampled_from(["m", "mm", "um", "nm"]),
    name=st.sampled_from(["cell.vtk", "cell.vtp"]),
)
def test_a_mesh_comes_back_in_its_order(scale, bumps, unit, name, place):
    """To the precision that VTK files keep, float32; with its volume, whose sign is the triangles' orientation."""
    sphere, faces = icosphere(1)
    mesh = TriangleMesh(scale * sphere * bumps[: len(sphere), None], faces, "cell")
    path = place() / name
    write_mesh(path, mesh, unit)
    (found,) = read_meshes(path, unit)
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=0, atol=1e-6 * scale)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    assert found.volume == pytest.approx(mesh.volume, rel=1e-5)


# --- images and tables --------------------------------------------------------------------------------------


@given(image=images(least=1, low=-0.5, high=1.5), kind=st.sampled_from(list(LEVELS)))
def test_an_image_comes_back_to_half_a_level(image, kind, place):
    path = place() / "image.png"
    write_png(path, image, kind)
    levels, white = read_png(path)
    assert white == LEVELS[kind]
    np.testing.assert_allclose(levels / white, np.clip(image, 0, 1), rtol=0, atol=0.5001 / white)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | NAMES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


@given(table=st.dictionaries(NAMES, VALUES, max_size=4))
def test_a_table_comes_back_from_json(table, place):
    path = place() / "table.json"
    write_json(path, table)
    assert read_json(path) == table
    assert all(math.isfinite(v) for v in table.values() if isinstance(v, float))
