"""Objects in few bytes: what comes back, how near, how large the file is, and what is refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import tifffile
import torch

from helpers.splats import cloud
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.objects import COMPACT as FORMAT
from holosplat.io.objects import Steps, read_object, steps_of, write_compact, write_object
from holosplat.io.ome import write_ome_tiff
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import GaussianCloud, MovingSurfaces, Stored, SurfaceMesh, VoxelGrid
from holosplat.representations.flow import TimeBasis
from holosplat.representations.gaussians import raw_of
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume

PIXEL = 1e-6
MATTER = Matter((DeltaBeta(4e-7, 2e-10),))
GRID = Grid.centred((25, 31, 40), PIXEL)


def gaussians(count: int = 400) -> GaussianCloud:
    """Gaussians of one material."""
    centres, scales, quaternions, amplitudes = cloud("ordinary", 1, count)
    return GaussianCloud((0.6 * centres, scales.log(), quaternions, raw_of(amplitudes.abs() + 0.1)), PIXEL, MATTER)


def surface() -> SurfaceMesh:
    """A ball."""
    points, faces = icosphere(3)
    return SurfaceMesh(torch.from_numpy(9.0 * points + 0.3), torch.from_numpy(faces.copy()), PIXEL, MATTER)


def moving() -> MovingSurfaces:
    """The ball on a way."""
    still = surface()
    paths = torch.stack([still.vertices, still.vertices + 1.7])
    body = torch.zeros(len(still.faces), dtype=torch.int64)
    return MovingSurfaces(paths, still.faces, body, TimeBasis(0.0, 1e-6, 1), PIXEL, MATTER)


def voxels() -> VoxelGrid:
    """A ball of voxels, with an empty surrounding."""
    z, y, x = (axis / PIXEL for axis in GRID.axes()[::-1])
    values = np.clip(9 - np.sqrt(x**2 + y[:, None] ** 2 + z[:, None, None] ** 2), 0, 1)[None]
    return VoxelGrid(torch.from_numpy(values).float(), GRID, MATTER)


KINDS = {"gaussians": gaussians, "surfaces": surface, "moving-surfaces": moving, "voxels": voxels}


def volume_of(obj: Stored) -> np.ndarray:
    return obj.voxelise(GRID).delta


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_comes_back_nearly_and_the_nearer_the_finer_the_steps(kind, tmp_path):
    obj = KINDS[kind]()
    true, errors, sizes = volume_of(obj), [], []
    for place in (1 / 128, 1 / 32, 1 / 4):
        write_compact(tmp_path / "c.h5", obj, steps_of(place))
        back = read_object(tmp_path / "c.h5")
        assert (back.kind, back.described) == (obj.kind, obj.described)
        errors.append(np.linalg.norm(volume_of(back) - true) / np.linalg.norm(true))
        sizes.append((tmp_path / "c.h5").stat().st_size)
    assert errors[1] < 0.01
    assert errors[0] < 0.5 * errors[1] < errors[2]
    assert sizes[0] > sizes[1] > sizes[2]
    if kind in ("surfaces", "moving-surfaces"):
        assert torch.equal(back.state()["faces"], obj.state()["faces"])


@pytest.mark.parametrize("kind", KINDS)
def test_places_are_off_by_half_a_step_at_most(kind, tmp_path):
    obj, steps = KINDS[kind](), Steps()
    write_compact(tmp_path / "c.h5", obj, steps)
    back = read_object(tmp_path / "c.h5")
    name = {"gaussians": "centres", "surfaces": "vertices", "moving-surfaces": "coefficients", "voxels": "values"}[kind]
    before, after = (np.asarray(o.state()[name].double()).reshape(-1, o.state()[name].shape[-1]) for o in (obj, back))
    if kind == "gaussians":  # their order is another
        near = np.linalg.norm(before[:, None] - after, axis=2).argmin(axis=1)
        assert sorted(near) == list(range(len(before)))
        after = after[near]
    step = steps.of(name, before)
    assert step
    assert np.abs(after - before).max() <= 0.5 * step + 1e-6


def test_it_takes_less_than_a_third_of_the_plain_file(tmp_path):
    """Random Gaussians and small bodies compress less than those of a run (docs/data/compact.csv)."""
    fitted = gaussians(20_000)
    with torch.no_grad():
        fitted.log_scales.mul_(0.2)
    for obj in (fitted, surface(), moving(), voxels()):
        write_object(tmp_path / "plain.h5", obj)
        write_compact(tmp_path / "compact.h5", obj, Steps())
        plain, small = ((tmp_path / f"{name}.h5").stat().st_size for name in ("plain", "compact"))
        assert plain > 3 * small, obj.kind


def test_a_cloud_without_gaussians_is_no_trouble(tmp_path):
    none = gaussians().replaced(p[:0] for p in gaussians().parameters().values())
    write_compact(tmp_path / "c.h5", none, Steps())
    assert len(read_object(tmp_path / "c.h5").state()["centres"]) == 0


@pytest.mark.parametrize("place", [0.0, -1.0, 2.0, float("nan")])
def test_steps_without_sense_are_refused(place):
    with pytest.raises(InputError, match="step must"):
        steps_of(place)


@pytest.mark.parametrize(
    ("name", "value"), [("step", -1.0), ("step", np.inf), ("step", "fine"), ("dtype", "O"), ("dtype", "nothing")]
)
def test_files_that_say_nothing_sensible_are_refused(name, value, tmp_path):
    write_compact(tmp_path / "c.h5", gaussians(), Steps())
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        assert file.attrs["format"] == FORMAT
        del file["centres"].attrs[name]
        file["centres"].attrs[name] = value
    with pytest.raises(InputError, match="centres"):
        read_object(tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        del file["centres"].attrs[name]
    with pytest.raises(InputError, match=r"centres must be a tensor with its step, type and differences"):
        read_object(tmp_path / "c.h5")


def test_an_ome_tiff_holds_both_channels_and_the_size_of_voxels(tmp_path):
    grid = Grid((3, 5, 7), (1e-6, 2e-6, 3e-6), (0.0, 0.0, 0.0))
    values = np.random.default_rng(0).random((2, 3, 5, 7))
    write_ome_tiff(tmp_path / "v.ome.tif", Volume(values[0], values[1], grid))
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.series[0].axes == "CZYX"
        np.testing.assert_array_equal(file.asarray(), values.astype(np.float32))
        said = file.ome_metadata
    assert said is not None
    for text in ('PhysicalSizeX="1.0"', 'PhysicalSizeY="2.0"', 'PhysicalSizeZ="3.0"', 'Name="delta"', 'Name="beta"'):
        assert text in said
