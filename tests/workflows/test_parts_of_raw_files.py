"""`record`, `correct` and `join` on a part of their scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from helpers.imaging import SHAPE, cells, taken
from holosplat.beamline.record import RecordingOptions, record
from holosplat.beamline.simulate import simulate
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.raw_file import PROJECTION
from holosplat.io.reading import Part, Reading, Told
from holosplat.io.scan_file import open_scan
from holosplat.optics.camera import Camera, Illumination
from holosplat.workflows.correct import CorrectionOptions, correct
from holosplat.workflows.join import join

ROWS, COLUMNS = slice(3, SHAPE[0] - 2), slice(1, SHAPE[1] - 4)
CROP = f"{ROWS.start}:{ROWS.stop},{COLUMNS.start}:{COLUMNS.stop}"


def test_a_part_of_a_raw_file_is_corrected_as_the_whole(tmp_path):
    """Frames are corrected before they are cut: the part of the corrected file."""
    clean, raw, whole, part = (tmp_path / f"{name}.nxs" for name in ("clean", "raw", "whole", "part"))
    exposures = replace(taken(), views=replace(taken().views, shifts=np.zeros((4, 2))))
    write_scan(clean, simulate(cells(), exposures, oversample=2))
    record(clean, raw, RecordingOptions(flats=5, darks=3, seed=1), Camera(), Illumination())
    correct(raw, whole, CorrectionOptions("plain"))
    reading = Reading(Told(distance=0.2, axis_column=11.0), Part(views="1:4", test_views="2", crop=CROP, bin=2))
    done = correct(raw, part, CorrectionOptions("plain"), reading=reading)
    wanted = read_scan(whole)[[1, 2, 3]].cropped(ROWS, COLUMNS).binned(2)
    found = read_scan(part)
    assert done.frames == len(found) == 3
    np.testing.assert_allclose(found.frames, wanted.frames, rtol=0, atol=1e-6)
    assert found.is_test.tolist() == [False, True, False]
    assert set(found.exposures.distance) == {0.2}
    p = taken().views.pixel_size
    np.testing.assert_allclose(
        found.views.shifts - wanted.views.shifts, [[(0.5 * (SHAPE[1] - 1) - 11.0) * p, 0]] * 3, atol=1e-12
    )


def test_a_part_is_recorded_and_parts_are_joined(tmp_path):
    clean, raw, joined = (tmp_path / f"{name}.nxs" for name in ("clean", "raw", "joined"))
    write_scan(clean, simulate(cells(), taken(), oversample=2))
    part = Part(views="0,2", crop=CROP)
    record(clean, raw, RecordingOptions(flats=2, darks=2), Camera(), Illumination(), part=part)
    wanted = read_scan(clean)[[0, 2]].cropped(ROWS, COLUMNS)
    with open_scan(raw) as file:
        assert len(file.numbers(PROJECTION)) == 2
        np.testing.assert_array_equal(file.exposures.views.shifts, wanted.views.shifts)
    join((clean, clean), joined, part=part)
    np.testing.assert_allclose(read_scan(joined).frames[:2], wanted.frames, rtol=0, atol=1e-6)
