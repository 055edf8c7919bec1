"""Every format of volumes comes back as it was written, and opens in readers that are not ours."""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io import volumes
from holosplat.io.formats import FORMATS, of_time, read_volume_file, write_volume_file
from holosplat.io.plain_values import HEADER, write_xdmf
from holosplat.io.volumes import Contents
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import VoxelGrid
from holosplat.units import wavelength
from holosplat.volume import Volume

GRID = Grid((5, 7, 4), (1e-6, 2.5e-6, 3e-6), (-3e-5, 1e-6, 4e-6))
"""Unequal counts and voxels, away from the origin."""
MATTER = Matter((DeltaBeta(4e-7, 2e-10),))
WHOLE = [suffix for suffix in FORMATS if suffix not in (".h5", ".hdf5", ".zarr")]


def voxels(seed: int = 0) -> VoxelGrid:
    return VoxelGrid(torch.rand(1, *GRID.shape, generator=torch.Generator().manual_seed(seed)), GRID, MATTER)


def written(path: Path, seed: int = 0) -> Volume:
    """The volume that was written at `path`, in slabs of one row."""
    obj = voxels(seed)
    write_volume_file(path, obj, GRID)
    return obj.voxelise(GRID)


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_written_is_read(suffix, tmp_path, monkeypatch):
    monkeypatch.setattr(volumes, "SLAB_VOXELS", 1)
    true = written(tmp_path / f"v{suffix}")
    found = read_volume_file(tmp_path / f"v{suffix}")
    np.testing.assert_array_equal(found.delta, true.delta)
    np.testing.assert_array_equal(found.beta, true.beta)
    np.testing.assert_allclose(found.grid.voxel_size, GRID.voxel_size, rtol=2e-7)
    np.testing.assert_allclose(found.grid.origin, GRID.origin, rtol=2e-7)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        p.name for p in FORMATS[suffix].files(tmp_path / f"v{suffix}")
    )


@pytest.mark.parametrize("suffix", FORMATS)
def test_where_delta_is_not_known_mu_stands_in_its_place(suffix, tmp_path):
    """µ = 4πβ/λ under its own name; what asks for δ is refused, for µ is none."""
    obj, path = voxels(), tmp_path / f"v{suffix}"
    of = Contents.of(False, 20.0)
    mu = of.of_volume(obj.voxelise(GRID))["mu_per_m"]
    np.testing.assert_allclose(mu, 4 * np.pi * obj.voxelise(GRID).beta / wavelength(20.0), rtol=1e-6)
    write_volume_file(path, obj, GRID, of=of)
    held = b"".join(one.read_bytes() for one in tmp_path.rglob("*") if one.is_file())
    assert b"mu_per_m" in held
    assert b"delta" not in held
    with pytest.raises(InputError, match="must hold δ, but it holds the attenuation coefficient µ"):
        read_volume_file(path)


def test_names_of_times_keep_both_suffixes():
    names = {"v.h5": "v_t0002.h5", "v.ome.tif": "v_t0002.ome.tif", "v.ome.zarr": "v_t0002.ome.zarr", "b": "b_t0002"}
    assert {name: of_time(Path(name), 2).name for name in names} == names


# --- other readers ------------------------------------------------------------------------------------------


def by_vtk(reader, path: Path):
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def test_vti_opens_in_vtk_with_both_arrays(tmp_path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    true = written(tmp_path / "v.vti")
    image = by_vtk(vtkXMLImageDataReader(), tmp_path / "v.vti")
    assert image.GetDimensions() == (4, 7, 5)
    assert image.GetSpacing() == pytest.approx((1, 2.5, 3))
    assert image.GetOrigin() == pytest.approx((-30, 1, 4))
    assert image.GetFieldData().GetAbstractArray("length_unit").GetValue(0) == "um"
    for name in ("delta", "beta"):
        values = vtk_to_numpy(image.GetPointData().GetArray(name)).reshape(GRID.shape)
        np.testing.assert_array_equal(values, getattr(true, name))


def test_vti_that_paraview_saved_again_is_read(tmp_path):
    """Compressed, and as text."""
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader, vtkXMLImageDataWriter

    true = written(tmp_path / "v.vti")
    for ascii_text in (False, True):
        writer = vtkXMLImageDataWriter()
        writer.SetInputData(by_vtk(vtkXMLImageDataReader(), tmp_path / "v.vti"))
        writer.SetFileName(str(tmp_path / "w.vti"))
        if ascii_text:
            writer.SetDataModeToAscii()
        writer.Write()
        found = read_volume_file(tmp_path / "w.vti")
        np.testing.assert_allclose(found.beta, true.beta, rtol=1e-6)
        np.testing.assert_allclose(found.grid.origin, GRID.origin, rtol=1e-9)


def test_nrrd_opens_in_pynrrd_and_vtk(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    from vtkmodules.vtkIOImage import vtkNrrdReader

    true = written(tmp_path / "v.nrrd")
    for name, file in (("delta", "v.nrrd"), ("beta", "v.beta.nrrd")):
        values, header = nrrd.read(str(tmp_path / file), index_order="C")
        np.testing.assert_array_equal(values, getattr(true, name))
        assert header["content"] == name
        assert header["space units"] == ["um"] * 3
        np.testing.assert_allclose(header["space directions"], np.diag([1, 2.5, 3]))
        np.testing.assert_allclose(header["space origin"], [-30, 1, 4])
    wide = replace(GRID, shape=(5, 7, 12))  # it takes few columns for components
    write_volume_file(tmp_path / "w.nrrd", voxels(), wide)
    image = by_vtk(vtkNrrdReader(), tmp_path / "w.nrrd")
    assert image.GetScalarComponentAsDouble(2, 4, 3, 0) == voxels().voxelise(wide).delta[3, 4, 2] > 0
    assert image.GetSpacing() == pytest.approx((1, 2.5, 3))


def test_nrrd_that_another_program_packed_is_read(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    true = written(tmp_path / "v.nrrd")
    for name in ("v.nrrd", "v.beta.nrrd"):
        values, header = nrrd.read(str(tmp_path / name))
        nrrd.write(str(tmp_path / name), values.astype(">f8"), {**header, "type": "double", "encoding": "gzip"})
    found = read_volume_file(tmp_path / "v.nrrd")
    np.testing.assert_array_equal(found.beta, true.beta)
    assert found.grid.shape == GRID.shape


def test_mrc_is_valid_and_opens_in_mrcfile(tmp_path):
    mrcfile = pytest.importorskip("mrcfile")
    true = written(tmp_path / "v.mrc")
    for name, file in (("delta", "v.mrc"), ("beta", "v.beta.mrc")):
        assert mrcfile.validate(tmp_path / file)
        with mrcfile.open(tmp_path / file) as opened:
            np.testing.assert_array_equal(opened.data, getattr(true, name))
            assert opened.voxel_size.tolist() == pytest.approx((1e4, 2.5e4, 3e4))
            assert opened.header.origin.tolist() == pytest.approx((-3e5, 1e4, 4e4))
            assert opened.is_volume()
            assert name in opened.get_labels()[0]


def test_mrc_of_the_other_byte_order_is_read(tmp_path):
    true = written(tmp_path / "v.mrc")
    for name in ("v.mrc", "v.beta.mrc"):
        content = (tmp_path / name).read_bytes()
        head = np.frombuffer(content[:1024], HEADER).astype(HEADER.newbyteorder(">"))
        head["stamp"] = b"\x11\x11"
        values = np.frombuffer(content[1024:], "<f4").astype(">f4")
        (tmp_path / name).write_bytes(head.tobytes() + values.tobytes())
    np.testing.assert_array_equal(read_volume_file(tmp_path / "v.mrc").delta, true.delta)


def test_hdf5_says_units_and_axes(tmp_path):
    written(tmp_path / "v.h5")
    with h5py.File(tmp_path / "v.h5") as file:
        for place in (file, file["delta"], file["beta"]):
            assert {k: place.attrs[k] for k in ("voxel_size_units", "origin_units", "axes")} == {
                "voxel_size_units": "m",
                "origin_units": "m",
                "axes": "z, y, x",
            }
        assert file["delta"].attrs["units"] == "1"
        assert [dimension.label for dimension in file["delta"].dims] == ["z", "y", "x"]


def test_xdmf_opens_all_times_in_vtk_wherever_the_folder_goes(tmp_path):
    xdmf = pytest.importorskip("vtkmodules.vtkIOXdmf2")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    made, times = tmp_path / "made & <first>", (0.0, 8.86e-7, 2e-6)
    made.mkdir()
    steps = [(time, made / f"v & w_t{k:04d}.h5") for k, time in enumerate(times)]
    true = [written(path, seed) for seed, (_, path) in enumerate(steps)]
    write_xdmf(made / "v.xdmf", GRID, steps)
    moved = made.rename(tmp_path / "moved")
    reader = xdmf.vtkXdmfReader()
    reader.SetFileName(str(moved / "v.xdmf"))
    reader.UpdateInformation()
    assert reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) == pytest.approx(times)
    for time, volume in zip(times, true):
        reader.UpdateTimeStep(time)
        image = reader.GetOutputDataObject(0)
        assert image.GetSpacing() == pytest.approx((1, 2.5, 3))
        assert image.GetOrigin() == pytest.approx((-30, 1, 4))
        values = vtk_to_numpy(image.GetPointData().GetArray("beta")).reshape(GRID.shape)
        np.testing.assert_array_equal(values, volume.beta)


# --- files that are damaged, or of nobody's making ------------------------------------------------------------


@pytest.mark.parametrize("suffix", WHOLE)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_a_file_that_is_cut_off_is_refused(suffix, share, tmp_path):
    path = tmp_path / f"v{suffix}"
    written(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_volume_file(path)


def edited(path: Path, change: Callable[[bytes], bytes]) -> None:
    before = path.read_bytes()
    path.write_bytes(change(before))
    assert path.read_bytes() != before


def many(content: bytes) -> bytes:
    """An MRC file that declares 10¹² values."""
    head = np.frombuffer(content[:1024], HEADER).copy()
    head["n"] = head["m"] = 10_000
    return head.tobytes() + content[1024:]


def packed(content: bytes) -> bytes:
    """An NRRD file whose values unpack to a thousand times of what it declares."""
    head = content.partition(b"\n\n")[0].replace(b"encoding: raw", b"encoding: gzip")
    return head + b"\n\n" + gzip.compress(bytes(4 * 140 * 1000))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("v.vti", lambda c: c.replace(b"0 3 0 6 0 4", b"0 99999 0 99999 0 99999"), "declares"),
        ("v.vti", lambda c: c.replace(b'"delta" format', b'"delta" NumberOfComponents="9999" format'), "declares"),
        ("v.vti", lambda c: c.replace(b"0 3 0 6 0 4", b"0 3 0 6 x 4"), "extents of six whole numbers"),
        ("v.vti", lambda c: c.replace(b"length_unit", b"other_names"), "field data other_names"),
        ("v.vti", lambda c: c.replace(b"117 109 0", b"117 117 0"), "unknown unit 'uu'"),
        ("v.vti", lambda c: c.replace(b'Name="beta"', b'Name="thing"'), "point data delta, thing"),
        ("v.vti", lambda c: c.replace(b"ImageData", b"PolyData"), "another file"),
        ("v.nrrd", lambda c: c.replace(b"sizes: 4 7 5", b"sizes: 40000 70000 50000"), "as its header declares"),
        (
            "v.nrrd",
            lambda c: c.replace(b"encoding: raw", b"data file: /etc/passwd\nencoding: raw"),
            "hold its values itself",
        ),
        ("v.nrrd", lambda c: c.replace(b"(1.0,0.0,0.0)", b"(1.0,0.1,0.0)"), "axes that are not turned"),
        ("v.nrrd", lambda c: c.replace(b'"um"', b'"bananas"'), "unknown unit 'bananas'"),
        ("v.nrrd", lambda c: c.replace(b"type: float", b"type: block"), "lacks or garbles 'block'"),
        ("v.nrrd", lambda c: c.replace(b"(1.0,0.0,0.0)", b"(nan,0.0,0.0)"), "not turned"),
        ("v.nrrd", packed, "unpack to the 560 bytes"),
        ("v.tif", lambda c: c.replace(b'SizeX="4"', b'SizeX="5"'), "images of the size that it declares"),
        ("v.mrc", many, "as its header declares"),
        ("v.mrc", lambda c: c[:12] + b"\1" + c[13:], "mode 1"),
        ("v.mrc", lambda c: c[:208] + b"none" + c[212:], "must be an MRC2014 file"),
        ("v.mrc", lambda c: c[:1024] + np.float32(np.nan).tobytes() + c[1028:], "finite"),
    ],
)
def test_what_is_declared_must_be_there(name, change, said, tmp_path):
    written(tmp_path / name)
    edited(tmp_path / name, change)
    with pytest.raises(InputError, match=re.escape(said)):
        read_volume_file(tmp_path / name)


@pytest.mark.parametrize("suffix", [".nrrd", ".mrc"])
def test_both_files_are_needed_and_belong_together(suffix, tmp_path):
    written(tmp_path / f"v{suffix}")
    other = replace(GRID, voxel_size=(2e-6,) * 3)
    write_volume_file(tmp_path / f"w{suffix}", voxels(), other)
    (tmp_path / f"w.beta{suffix}").rename(tmp_path / f"v.beta{suffix}")
    with pytest.raises(InputError, match="must be of the same voxels"):
        read_volume_file(tmp_path / f"v{suffix}")
    (tmp_path / f"v.beta{suffix}").unlink()
    with pytest.raises(InputError, match=r"holds one array; its β must lie beside it as v\.beta"):
        read_volume_file(tmp_path / f"v{suffix}")


def test_a_zarr_of_other_channels_or_sizes_is_refused(tmp_path):
    written(tmp_path / "v.zarr")
    about = tmp_path / "v.zarr" / "0" / ".zarray"
    said = json.loads(about.read_text())
    about.write_text(json.dumps(said | {"shape": [2, 10**6, 10**6, 10**6]}))
    with pytest.raises(InputError, match="GB of memory"):
        read_volume_file(tmp_path / "v.zarr")
    about.write_text(json.dumps(said | {"compressor": {"id": "blosc9"}}))
    with pytest.raises(InputError, match="damaged or none"):
        read_volume_file(tmp_path / "v.zarr")
    about.write_text(json.dumps(said))
    edited(tmp_path / "v.zarr" / ".zattrs", lambda content: content.replace(b"beta", b"gama"))
    with pytest.raises(InputError, match="channels"):
        read_volume_file(tmp_path / "v.zarr")


@pytest.mark.parametrize("name", ["v.npy", "v", "v.raw", "v.nxs"])
def test_other_suffixes_are_refused_with_those_that_are_known(name, tmp_path):
    for act in (lambda path: written(path), read_volume_file):
        with pytest.raises(InputError, match=r"\.h5, \.hdf5, \.tif, \.tiff, \.zarr, \.vti, \.nrrd, \.mrc, by which"):
            act(tmp_path / name)
    assert not list(tmp_path.iterdir())
