"""How a scan is read: what is said beside its files, and which part of it is taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io.atomic import write_json
from holosplat.io.formats import read, read_as, run_reading, run_source
from holosplat.io.images import write_tiff
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Part, Reading, Told, read_angles
from holosplat.scan import Exposures, Scan
from holosplat.workflows.provenance import scan_hash

N, SHAPE, PIXEL = 7, (9, 13), 1e-6


def a_scan(times: np.ndarray | None = None) -> Scan:
    views = Views(rotation_y(20.0 * np.arange(N)), np.zeros((N, 2)), SHAPE, PIXEL)
    exposures = Exposures(views, 20.0, 0.1, 0.0, np.zeros(N) if times is None else times)  # type: ignore[arg-type]
    frames = np.arange(N * SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(N, *SHAPE)
    return Scan(frames, exposures, np.arange(N) == 3)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_scan(tmp_path / "scan.nxs", a_scan())
    return tmp_path / "scan.nxs"


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("0:7:3", [0, 3, 6]), ("3,5", [3, 5]), ("5,3,3", [3, 5]), ("::2", [0, 2, 4, 6]), ("-1,0:2", [0, 1, 6])],
)
def test_views_are_chosen_by_numbers_and_ranges(text, numbers):
    found = Part(views=text).of(a_scan())
    np.testing.assert_array_equal(found.frames, a_scan().frames[numbers])
    np.testing.assert_array_equal(found.views.rotations, a_scan().views.rotations[numbers])
    np.testing.assert_array_equal(found.is_test, np.array(numbers) == 3)


def test_held_out_views_are_chosen_beside_the_others():
    all_others = Part(test_views="1:7:3").of(a_scan())
    assert (len(all_others), all_others.is_test.tolist()) == (N, [False, True, False, False, True, False, False])
    both = Part(views="0:7:2", test_views="1,2").of(a_scan())
    np.testing.assert_array_equal(both.frames, a_scan().frames[[0, 1, 2, 4, 6]])
    assert both.is_test.tolist() == [False, True, True, False, False]


def test_a_part_is_cropped_and_then_binned_and_frames_are_not_read_before_they_are_used(file):
    part = Part(views="2:5", crop="1:8,3:12", bin=2)
    found, whole = read_as(file, Reading(part=part)), a_scan()
    assert found.views.pixel_size == 2 * PIXEL
    np.testing.assert_array_equal(found[[1]].frames, whole.frames[[3], 1:7, 3:11].reshape(1, 3, 2, 4, 2).mean((2, 4)))
    everything = read_as(file, Reading(part=Part(crop=":,:")))
    np.testing.assert_array_equal(everything.frames, whole.frames)
    from_the_end = read_as(file, Reading(part=Part(crop="-4:,:-6")))
    np.testing.assert_array_equal(from_the_end.frames, whole.frames[:, -4:, :-6])


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ({"views": "7"}, "--views counts what there is from 0 to 6, but it says 7"),
        ({"views": "a"}, "--views must be made of whole numbers"),
        ({"views": "0:9:0"}, "cannot go in steps of 0"),
        ({"views": "5:0:-1"}, "--views must go forwards"),
        ({"views": "8:9"}, "'8:9' names none of the 7"),
        ({"views": "1:2:3:4"}, "ranges are written start:stop:step"),
        ({"test_views": "-8"}, "--test-views counts"),
        ({"crop": "0:5"}, "--crop must be ROWS,COLUMNS"),
        ({"crop": "3,0:5"}, "rows and columns are written start:stop"),
        ({"crop": "0:10,0:5"}, "must keep some of the 9 rows, but it says '0:10'"),
        ({"crop": "0:5,6:6"}, "must keep some of the 13 columns"),
        ({"crop": "0:5:2,0:5"}, "use --bin for larger pixels"),
        ({"bin": 0}, "bin must be at least 1, but it is 0"),
        ({"bin": 10}, "are binned by 1 to [0-9]+, but not by 10"),
    ],
)
def test_a_part_that_is_not_there_is_refused(part, said):
    with pytest.raises(InputError, match=said):
        Part(**part).of(a_scan())


def test_what_is_said_goes_before_what_the_file_says(file, tmp_path):
    (tmp_path / "angles.txt").write_text("# degrees\n" + "\n".join(f"{-3.5 * n}" for n in range(N)))
    told = Told(energy_kev=12.0, distance=0.3, pixel_size=2e-6, angles=tmp_path / "angles.txt", axis_column=5.25)
    found = read_as(file, Reading(told))
    assert (found.exposures.one_energy("it"), found.views.pixel_size) == (12.0, 2e-6)
    assert set(found.exposures.distance) == {0.3}
    np.testing.assert_allclose(found.views.rotations, rotation_y(-3.5 * np.arange(N)), atol=1e-12)
    np.testing.assert_allclose(found.views.shifts, [[0.75 * 2e-6, 0]] * N)
    back = read_as(file, Reading(replace(told, sense="anticlockwise")))
    np.testing.assert_allclose(back.views.rotations, rotation_y(3.5 * np.arange(N)), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "option", "told"),
    [
        ("instrument/beam/incident_energy", "--energy-kev", Told(energy_kev=20.0)),
        ("instrument/detector/distance", "--distance", Told(distance=0.1)),
        ("sample/rotation_angle", "--angles FILE", None),
    ],
)
def test_what_a_file_lacks_is_asked_for_by_the_option_that_helps(file, tmp_path, name, option, told):
    with h5py.File(file, "r+") as opened:
        del opened["entry"][name], opened["entry/sample/view_rotation"]
        opened["entry/data"].pop("rotation_angle")
    with pytest.raises(InputError, match=f"missing; say it by {option}"):
        read(file)
    if told is None:
        (tmp_path / "angles.txt").write_text(", ".join(str(20.0 * n) for n in range(N)))
        told = Told(angles=tmp_path / "angles.txt")
    found = read_as(file, Reading(told))
    np.testing.assert_allclose(found.views.rotations, a_scan().views.rotations, atol=1e-12)
    np.testing.assert_array_equal(found.exposures.distance, a_scan().exposures.distance)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must hold the frames' angles in degrees, but it holds none"),
        ("0 1\n2 3", "must hold one angle a line, .* but a line holds 2 numbers"),
        ("0\nten", "but it holds 'ten'"),
        ("0\nnan", "holds .nan."),
        (None, "there is no such file"),
    ],
)
def test_a_file_that_holds_no_angles_is_refused(tmp_path, text, said):
    path = tmp_path / "angles.txt"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_angles(path)


def test_angles_of_another_number_are_refused(file, tmp_path):
    (tmp_path / "angles.txt").write_text("0\n1\n")
    with pytest.raises(InputError, match="one angle for each of the 7 frames, but there are 2"):
        read_as(file, Reading(Told(angles=tmp_path / "angles.txt")))


def test_a_run_reads_its_scan_again_as_it_read_it(tmp_path, file):
    """All that differs from the default stands in source.json; what is said anew goes before it."""
    angles = tmp_path / "angles.txt"
    angles.write_text(" ".join(str(n) for n in range(N)))
    reading = Reading(Told(distance=0.2, angles=angles, axis_column=6.5), Part(crop="0:6,:", bin=2, test_views="1"))
    run = tmp_path / "run"
    run.mkdir()
    write_json(run / "config.json", {})
    write_json(run / "source.json", run_source(file, reading))
    assert run_reading(run) == reading
    wanted = read_as(file, reading)
    np.testing.assert_array_equal(read(run).frames, wanted.frames)
    np.testing.assert_array_equal(read(run).views.shifts, wanted.views.shifts)
    said = Reading(Told(distance=0.3)).over(run_reading(run))
    assert said == Reading(replace(reading.told, distance=0.3), reading.part)


@pytest.mark.parametrize("old", [False, True], ids=["", "without pixels"])
def test_a_run_gives_its_scan_where_it_found_the_frames(tmp_path, file, old):
    """Pixels, too, where a magnification was found; runs of old have none."""
    run, planned = tmp_path / "run", read(file)
    run.mkdir()
    shifts, turned = planned.views.shifts + 0.3 * PIXEL, planned.views.rotations[::-1]
    sizes, distance = planned.views.pixel_sizes * np.linspace(0.99, 1.02, N), planned.exposures.distance * 1.1
    found = {"rotations": turned, "shifts": shifts, "distance": distance} | ({} if old else {"pixel_sizes": sizes})
    write_json(run / "config.json", {})
    write_json(run / "source.json", run_source(file, Reading()))
    write_json(run / "summary.json", {"geometry": {name: value.tolist() for name, value in found.items()}})
    views = read(run).views
    np.testing.assert_array_equal(views.rotations, turned)
    np.testing.assert_array_equal(views.shifts, shifts)
    np.testing.assert_allclose(views.pixel_sizes, planned.views.pixel_sizes if old else sizes, rtol=1e-12)
    np.testing.assert_array_equal(read(run).exposures.distance, distance)


def test_a_damaged_reading_of_a_run_is_named(tmp_path, file):
    run = tmp_path / "run"
    run.mkdir()
    for table, said in (({"bin": "two"}, "reading.bin must be"), ({"zoom": 2}, "reading.zoom is not known")):
        write_json(run / "source.json", {"scan": str(file), "time_frame": None, "reading": table})
        with pytest.raises(InputError, match=said):
            run_reading(run)


def test_a_time_is_taken_before_frames_are_counted():
    series = a_scan(np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]))
    found = Part(time_frame=1, views="0,2").of(series)
    np.testing.assert_array_equal(found.frames, series.frames[[3, 5]])
    assert not found.exposures.time.any()


def test_widths_are_said_beside_files_and_kept_by_them(file, tmp_path):
    """A source of 4 µm at 0.2 m and a distance of 0.1 m blurs by 2 µm: two pixels beside those of the detector."""
    said = Told(bandwidth=0.03, source_size=4e-6, source_distance=0.2, psf_sigma_px=1.5)
    placed = said.placed(a_scan())
    assert placed.exposures.bandwidth == pytest.approx(np.full(N, 0.03))
    assert placed.exposures.psf_sigma_px == pytest.approx(np.full(N, 2.5))
    write_scan(tmp_path / "again.nxs", placed)
    write_tiff(tmp_path / "images", placed)
    for path in ("again.nxs", "images"):
        kept = read(tmp_path / path)
        assert kept.exposures.bandwidth == pytest.approx(np.full(N, 0.03))
        assert scan_hash(kept) != scan_hash(a_scan())
    assert not read(file).exposures.bandwidth.any()


def test_widths_said_as_ranges_are_left_open():
    said = Told(bandwidth="0.01:0.1", source_size="1e-6:4e-6", source_distance=0.5, psf_sigma_px="0.2:1")
    assert said.uncertain() == {"bandwidth": (0.01, 0.1), "source_angle": (2e-6, 8e-6), "psf_sigma_px": (0.2, 1.0)}
    assert said.at_middle() == Told(source_distance=0.5)
    assert said.found({"bandwidth": 0.03, "psf_sigma_px": 0.0}) == Told(
        bandwidth=0.03, source_distance=0.5, psf_sigma_px=0.0
    )
    with pytest.raises(InputError, match="--source-size needs --source-distance"):
        Told(source_size=1e-6).placed(a_scan())
