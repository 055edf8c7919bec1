"""HDF5 files in which datasets and attributes hold nothing: they have a type, and a null dataspace."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.cli import holosplat, refused, worked
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.io import read_scan
from holosplat.io.arrays import LOADER
from holosplat.io.formats import read
from holosplat.io.hdf5 import attribute_numbers, attribute_text
from holosplat.io.nxtomo import write_scan
from holosplat.io.volumes import read_volume, write_volume
from holosplat.scan import Exposures, Scan
from holosplat.volume import Volume

DATA = "entry/instrument/detector/data"
NOTHING = r"must hold numbers, but it holds nothing \(a null dataspace\); write them, or take it out of the file"


def nulled(path: Path, name: str, attribute: str = "") -> Path:
    """A copy in which a dataset, or an attribute of it, holds nothing."""
    copy = Path(shutil.copy(path, path.parent / f"null{path.suffix}"))
    with h5py.File(copy, "r+") as file:
        if attribute:
            file[name].attrs[attribute] = h5py.Empty("f8")
        else:
            attributes = dict(file[name].attrs)
            del file[name]
            file.create_dataset(name, data=h5py.Empty("f8")).attrs.update(attributes)
    return copy


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    """Four frames of 5 × 7 pixels."""
    path = tmp_path_factory.mktemp("scan") / "scan.nxs"
    exposures = Exposures.of(Views.evenly_spaced(4, (5, 7), 1e-6), 20.0, 0.1)
    write_scan(path, Scan(np.ones((4, 5, 7), np.float32), exposures, np.zeros(4, bool), {}))
    return path


@pytest.fixture(scope="module")
def volume(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("volume") / "volume.h5"
    values = np.ones((3, 4, 5), np.float32)
    write_volume(path, Volume(1e-7 * values, 1e-10 * values, Grid.centred((3, 4, 5), 1e-6)))
    return path


def test_commands_say_that_frames_are_missing(scan, tmp_path):
    path = nulled(scan, DATA)
    worked(holosplat("check", path))
    out = tmp_path / "out"
    for command in (["convert", path, out, "--to", "tiff"], ["reconstruct", path, "--material", "water", "--out", out]):
        refused(holosplat(*command), f"/{DATA} must hold numbers, but it holds nothing")
    assert not out.exists()


@pytest.mark.parametrize(
    "name",
    [
        DATA,
        "entry/instrument/detector/image_key",
        "entry/instrument/detector/x_pixel_size",
        "entry/instrument/beam/incident_energy",
        "entry/sample/view_rotation",
        "entry/split",
    ],
)
def test_datasets_of_a_scan(scan, name):
    with pytest.raises(InputError, match=f"/{name} " + NOTHING):
        read_scan(nulled(scan, name))


@pytest.mark.parametrize("way", ["plain", "virtual"])
@pytest.mark.parametrize("name", ["entry/instrument/detector/distance", "entry/sample/view_rotation"])
def test_datasets_that_were_never_written(scan, tmp_path, name, way):
    """HDF5 gives zeros for them: a scan in contact, say."""
    path = Path(shutil.copy(scan, tmp_path / "scan.nxs"))
    with h5py.File(path, "r+") as file:
        shape = file[name].shape
        del file[name]
        if way == "plain":
            file.create_dataset(name, shape, "f8")
        else:
            file.create_virtual_dataset(name, h5py.VirtualLayout(shape, "f8"))
    with pytest.raises(InputError, match=f"/{name} must be written, but it has no data"):
        read_scan(path)


def test_what_is_not_read_may_hold_nothing(scan):
    assert len(read_scan(nulled(scan, "entry/definition"))) == 4


def test_a_unit_that_says_nothing_is_none(scan):
    """As if it were not there: the unit is that of the SI."""
    found = read_scan(nulled(scan, "entry/instrument/detector/distance", "units"))
    assert found.exposures.distance[0] == pytest.approx(0.1)


def test_volumes(volume):
    with pytest.raises(InputError, match="/delta " + NOTHING):
        read_volume(nulled(volume, "delta"))
    with pytest.raises(InputError, match="@voxel_size must hold numbers, but it holds nothing"):
        read_volume(nulled(volume, "delta", "voxel_size"))


def test_plain_arrays(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["counts"] = np.ones((4, 5, 7))
    assert LOADER.recognises(tmp_path / "a.h5")
    path = nulled(tmp_path / "a.h5", "counts")
    assert not LOADER.recognises(path)
    with pytest.raises(InputError, match=r"null\.h5"):
        read(path)


def test_attributes():
    assert attribute_text(h5py.Empty("f8")) is None
    with pytest.raises(InputError, match="@a must hold numbers, but it is 'x'"):
        attribute_numbers("@a", "x", (1,))
