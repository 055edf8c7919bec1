"""Volumes as specimens: HDF5 as it is, TIFF images with what the user says of them."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.formats import StackMeaning, read_specimen
from holosplat.io.volumes import write_volume
from holosplat.matter import DeltaBeta
from holosplat.volume import Volume

PAGES = np.arange(3 * 5 * 4, dtype=np.uint16).reshape(3, 5, 4)
MEANING = StackMeaning(2e-6, DeltaBeta(1e-8, 1e-11))


def test_one_file_of_many_pages_or_many_of_one(tmp_path):
    tifffile.imwrite(tmp_path / "all.tif", PAGES, photometric="minisblack")
    for n, page in enumerate(PAGES):
        tifffile.imwrite(tmp_path / f"slice_{n}.tiff", page)
    whole = read_specimen([tmp_path / "all.tif"], MEANING)
    parts = read_specimen([tmp_path / f"slice_{n}.tiff" for n in (2, 0, 1)], MEANING)
    assert whole.grid == parts.grid == Grid.centred((5, 3, 4), 2e-6)
    assert np.array_equal(whole.delta, parts.delta)
    assert whole.delta[4, 1, 2] == pytest.approx(1e-8 * PAGES[1, 4, 2])
    assert whole.beta == pytest.approx(whole.delta / 1000)
    along = read_specimen([tmp_path / "all.tif"], StackMeaning(2e-6, DeltaBeta(1e-8, 0), "z"))
    assert along.grid.shape == (3, 5, 4)
    assert along.delta[1, 4, 2] == pytest.approx(1e-8 * PAGES[1, 4, 2])


def test_hdf5_says_it_itself(tmp_path):
    volume = Volume(PAGES * 1e-9, PAGES * 1e-12, Grid.centred((3, 5, 4), 1e-6))
    write_volume(tmp_path / "v.h5", volume)
    assert np.array_equal(read_specimen([tmp_path / "v.h5"], None).delta, volume.delta)


def test_what_cannot_be_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", PAGES[0])
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((5, 4, 3), np.uint8), photometric="rgb")
    tifffile.imwrite(tmp_path / "nan.tif", np.full((5, 4), np.nan, np.float32))
    (tmp_path / "broken.tif").write_bytes(b"II*\0 nothing")
    for names, meaning, match in (
        (["a.tif"], None, "of a specimen, --voxel-size says it"),
        (["rgb.tif"], MEANING, "must hold grey images of numbers"),
        (["nan.tif"], MEANING, "finite numbers"),
        (["broken.tif"], MEANING, "damaged or none|must hold grey images"),
        (["none.tif"], MEANING, "there is none"),
        (["a.tif", "b.h5"], MEANING, r"are of TIFF images, but .*b\.h5 is none"),
        (["a.h5", "b.h5"], None, "one file, but there are 2"),
        (["a.h5"], MEANING, "leave them out where files say it"),
        (["a.png"], MEANING, r"a\.png is none"),
        (["a.png"], None, r"ends with \.h5, \.hdf5, .*\.mrc, by which its format is chosen"),
    ):
        with pytest.raises(InputError, match=match):
            read_specimen([tmp_path / name for name in names], meaning)
    with pytest.raises(InputError, match="voxel_size must be at most"):
        StackMeaning(2.0, DeltaBeta(1e-8, 0))
