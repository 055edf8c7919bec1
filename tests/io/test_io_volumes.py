"""Volume files, and writing a file whole or not at all."""

from __future__ import annotations

import os

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.atomic import atomic_path
from holosplat.io.volumes import read_volume, write_volume
from holosplat.volume import Volume

GRID = Grid((3, 4, 5), (1e-6, 2e-6, 3e-6), (-1e-6, 0.5e-6, 7e-6))


def volume() -> Volume:
    rng = np.random.default_rng(0)
    return Volume(rng.normal(size=GRID.shape) * 1e-7, rng.normal(size=GRID.shape) * 1e-10, GRID)


def spoilt(path, change) -> None:
    """A good file, changed."""
    write_volume(path, volume())
    with h5py.File(path, "a") as file:
        change(file)


def put(file, name, value) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file[name] = value
    file[name].attrs.update(attributes)


def everywhere(name, value):
    """Sets (or, for None, removes) an attribute on the root and both datasets."""

    def change(file):
        for place in (file, file["delta"], file["beta"]):
            if value is None:
                del place.attrs[name]
            else:
                place.attrs[name] = value

    return change


def test_everything_comes_back(tmp_path):
    write_volume(tmp_path / "v.h5", volume())
    back = read_volume(tmp_path / "v.h5")
    assert back.grid == GRID
    assert np.array_equal(back.delta, volume().delta)
    assert np.array_equal(back.beta, volume().beta)
    assert [p.name for p in tmp_path.iterdir()] == ["v.h5"]


def test_grid_stands_on_the_datasets_and_the_root(tmp_path):
    write_volume(tmp_path / "v.h5", volume())
    with h5py.File(tmp_path / "v.h5") as file:
        for place in (file, file["delta"], file["beta"]):
            assert place.attrs["voxel_size"].tolist() == list(GRID.voxel_size)
            assert place.attrs["origin"].tolist() == list(GRID.origin)
        assert file["delta"].dtype == file["beta"].dtype == np.float32


@pytest.mark.parametrize("kept", ["/", "delta", "beta"])
def test_one_place_is_enough_and_one_number_means_cubes(tmp_path, kept):
    def change(file):
        for place in ("/", "delta", "beta"):
            if place != kept:
                del file[place].attrs["voxel_size"], file[place].attrs["origin"]
        file[kept].attrs["voxel_size"] = 2e-6

    spoilt(tmp_path / "v.h5", change)
    assert read_volume(tmp_path / "v.h5").grid == Grid(GRID.shape, (2e-6,) * 3, GRID.origin)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.pop("delta"), "/delta must be there"),
        (lambda f: f.pop("beta"), "/beta must be there"),
        (lambda f: put(f, "delta", np.zeros((4, 5), "f4")), r"/delta must have the shape \[Z, Y, X\]"),
        (lambda f: put(f, "beta", np.zeros((3, 4, 6), "f4")), "same shape"),
        (lambda f: put(f, "delta", np.full(GRID.shape, np.nan)), "/delta must hold finite"),
        (lambda f: put(f, "beta", np.full(GRID.shape, b"x")), "/beta must hold numbers"),
        (lambda f: put(f, "beta", np.zeros(GRID.shape, "c8")), "/beta must hold numbers"),
        (everywhere("voxel_size", None), "voxel_size .*missing"),
        (everywhere("voxel_size", -1e-6), "voxel_size must be a positive"),
        (everywhere("voxel_size", 0.0), "voxel_size must be a positive"),
        (everywhere("voxel_size", 3.2), "voxel_size must lie between"),
        (everywhere("voxel_size", [1e-6, 1e-6]), "voxel_size must have the shape"),
        (everywhere("voxel_size", "one"), "voxel_size must hold numbers"),
        (everywhere("origin", None), "origin .*missing"),
        (everywhere("origin", 0.0), "origin must have the shape"),
        (everywhere("origin", [0.0, np.nan, 0.0]), "origin must hold finite"),
        (lambda f: f["beta"].attrs.update(voxel_size=5e-6), "voxel_size must be the same"),
    ],
)
def test_wrong_fields_are_named(tmp_path, change, said):
    spoilt(tmp_path / "v.h5", change)
    with pytest.raises(InputError, match=said) as error:
        read_volume(tmp_path / "v.h5")
    assert "v.h5: " in str(error.value)


def test_files_that_are_no_volumes(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_volume(tmp_path / "none.h5")
    path = tmp_path / "v.h5"
    write_volume(path, volume())
    whole = path.read_bytes()
    for cut in range(0, len(whole), len(whole) // 30):
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"v\.h5 must be"):
            read_volume(path)


def test_atomic_path_replaces_whole_files_only(tmp_path):
    target = tmp_path / "file.txt"
    with atomic_path(target) as temporary:
        temporary.write_text("first")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        assert not target.exists()
    assert target.read_text() == "first"

    def fail():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]


def test_atomic_path_writes_through_links_with_the_usual_permissions(tmp_path):
    target, link = tmp_path / "real.txt", tmp_path / "link.txt"
    target.write_text("old")
    link.symlink_to(target)
    with atomic_path(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    mask = os.umask(0)
    os.umask(mask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~mask


def test_atomic_path_needs_a_folder(tmp_path):
    with pytest.raises(InputError, match="existing folder"), atomic_path(tmp_path / "none" / "v.h5"):
        pass
    with pytest.raises(InputError, match="folder; add a file name"), atomic_path(tmp_path):
        pass
