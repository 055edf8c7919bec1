"""Conditions that users of other programs reported, rebuilt: each folder is read right, said, or refused by name."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.io.formats import read_as
from holosplat.io.reading import Reading, Told

ODD = Path(__file__).resolve().parents[3] / "shared/data/odd_files"
BEAM = {"energy_kev": 20.0, "distance": 0.1, "pixel_size": 3.2e-6}
OWN = dict.fromkeys(BEAM)
"""Nothing is told."""
ANGLES = {"angles": "tif_imagej_hyperstack/angles.txt"}
APART = {"flats": "nx_separate_flats/flats.h5", "darks": "nx_separate_flats/darks.npy"}
READ = {
    "bad_dark/a.nxs": ({}, "unlike the other darks, frame 4 is left out"),
    "folder_golden": ({"angles": "folder_golden/angles.csv"}, "first GR_0.0_000.tif at 0°, last GR_58.7229_007.tif"),
    "half_acquisition/half_esrf.nxs": (OWN, "axis at column 7.5 are joined, .* to 8 frames of 96 columns"),
    "nxtomo_lib_cone/a.nx": (OWN, "magnification of 11.*the axis is at column 20.5 of 56"),
    "tif_imagej_hyperstack/frames.tif": (ANGLES, "8 projections .*frames.tif, image 7 at 157.5°"),
    "vds_missing/a.nxs": ({"allow_external": True}, ""),
    "dead_pixels/a.nxs": ({}, r"pixels whose flats are not brighter than the darks \(2\) .* have no weight"),
    "dead_pixels/dead_row.nxs": ({}, r"pixels whose flats .*\(103\)"),
    "dead_pixels/nan.nxs": ({}, r"pixels that are not above 0, no numbers or saturated \(1 in 1 of 8 frames\)"),
    "dead_pixels/nan_masked.nxs": ({}, r"pixels that the file marks as defective \(1\) are filled .* have no weight"),
    "nx_separate_flats/proj.nxs": (APART, ""),
    "nx_angle_zeros/a.nxs": ({}, "all 8 frames look from one side"),
    "folder_names_case": (ANGLES, "3 flats, 2 darks"),
}
REFUSED = {
    "vds_missing/c.nxs": ({}, "its values in another file; if you trust both, add --allow-external"),
    "vds_missing/short.nxs": ({"allow_external": True}, r"for 3 of 13 it has none \(10, 11, 12"),
    "vds_missing/d.nxs": ({"allow_external": True}, "raw_0002.h5, which is neither there nor beside it"),
}
OF_ANGLES = {
    **{"decimal_comma": "a point before the decimals", "two_cols_nohdr": "a line holds 2 numbers"},
    "radians": "look like radians",
}
"""Files of angles that are refused."""

pytestmark = pytest.mark.skipif(not ODD.is_dir(), reason="the files are not here")


def read(name: str, **told: object):
    """The scan, of what is told beside it; files by their names in the folder."""
    files = {key: ODD / str(told[key]) for key in ("angles", "flats", "darks") if key in told}
    return read_as(ODD / name, Reading(Told(**{**BEAM, **told, **files})))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", READ)
def test_what_can_be_read_is_read_and_said(name, caplog):
    caplog.set_level("INFO", "holosplat")
    told, words = READ[name]
    frames = read(name, **told).frames
    assert np.isfinite(frames).all()
    assert 0.9 < np.median(frames) < 1.1
    assert re.search(words, " ".join(caplog.messages))


@pytest.mark.parametrize("name", REFUSED)
def test_what_lacks_its_data_is_refused(name):
    told, words = REFUSED[name]
    with pytest.raises(InputError, match=words):
        read(name, **told)


@pytest.mark.parametrize("file", sorted((ODD / "angles_files").glob("*.txt")), ids=lambda file: file.stem)
def test_angles_are_read_or_refused(file):
    told = {"angles": f"angles_files/{file.name}"}
    if words := OF_ANGLES.get(file.stem):
        with pytest.raises(InputError, match=words):
            read("folder_names_case", **told)
        return
    rotations = read("folder_names_case", **told).views.rotations
    np.testing.assert_allclose(np.rad2deg(np.arctan2(rotations[:, 0, 2], rotations[:, 0, 0])), np.arange(8) * 22.5)


@pytest.mark.parametrize("name", ["h5_bitshuffle/bitshuffle.nxs", "h5_bitshuffle/blosc.nxs", "h5_bitshuffle/lz4.nxs"])
def test_filters_are_read_by_their_package_or_named(name):
    if find_spec("hdf5plugin"):
        assert 0.9 < np.median(read(name).frames) < 1.1
        return
    with pytest.raises(InputError, match=r"filters that HDF5 does not have here: .*holosplat\[codecs\]"):
        read(name)
