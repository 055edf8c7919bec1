"""geometry.toml: written, read, refused, and put onto scans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_tilted
from holosplat.io.atomic import write_json
from holosplat.io.beams import Beams, read_beams, write_beams
from holosplat.io.formats import read, read_as, run_reading, run_source
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Part, Reading, Told
from holosplat.scan import Exposures, Scan

V, SHAPE, PIXEL = 3, (7, 11), 2e-6


def exposures(seed: int = 0) -> Exposures:
    """Views of any pose, distance and energy."""
    rng = np.random.default_rng(seed)
    views = Views(Rotation.from_rotvec(rng.normal(0, 2, (V, 3))).as_matrix(), rng.normal(0, 1e-5, (V, 2)), SHAPE, PIXEL)
    return Exposures(views, rng.uniform(10, 20, V), rng.uniform(0.1, 0.2, V), np.zeros(V), np.zeros(V))


def scan_at(planned: Exposures) -> Scan:
    frames = np.arange(len(planned) * SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(-1, *SHAPE)
    return Scan(frames, planned, np.arange(len(planned)) == 1, {"who": "it"})


def test_a_geometry_comes_back_exactly(tmp_path):
    errors = np.arange(7.0 * V).reshape(V, 7) / 1024
    written = Beams.of(exposures(), errors, {"aligned": 'by "hand" \\ eye'})
    write_beams(tmp_path / "geometry.toml", written)
    found = read_beams(tmp_path / "geometry.toml")
    assert found.made_by == {"aligned": 'by "hand" \\ eye'}
    for one, other in zip(found.view, written.view, strict=True):
        assert replace(one, error=None) == replace(other, error=None)
    assert found.view[2].error is not None
    np.testing.assert_allclose(found.view[2].error.turn_deg, errors[2, 2:5], rtol=1e-2)


def test_a_geometry_goes_onto_frames_of_the_same_beams(tmp_path):
    write_beams(tmp_path / "geometry.toml", Beams.of(exposures(1)))
    write_scan(tmp_path / "scan.nxs", scan_at(exposures(0)))
    true = exposures(1)
    found = read_as(tmp_path / "scan.nxs", Reading(Told(exposures=tmp_path / "geometry.toml")))
    np.testing.assert_array_equal(found.views.rotations, true.views.rotations)
    np.testing.assert_array_equal(found.views.shifts, true.views.shifts)
    np.testing.assert_array_equal(found.exposures.distance, true.distance)
    np.testing.assert_array_equal(found.exposures.energy_kev, true.energy_kev)
    np.testing.assert_array_equal(found.frames, scan_at(true).frames)
    assert found.views.pixel_size == PIXEL


def test_a_part_is_cut_where_the_beams_are(tmp_path):
    """The geometry is that of whole frames."""
    write_beams(tmp_path / "geometry.toml", Beams.of(exposures(1)))
    write_scan(tmp_path / "scan.nxs", scan_at(exposures(0)))
    part = Part(crop="1:7,3:9", bin=2, views="0,2")
    found = read_as(tmp_path / "scan.nxs", Reading(Told(exposures=tmp_path / "geometry.toml"), part))
    wanted = part.of(scan_at(exposures(1)))
    np.testing.assert_array_equal(found.views.shifts, wanted.views.shifts)
    np.testing.assert_array_equal(found.frames, wanted.frames)


def test_a_series_has_the_same_beams_at_every_time():
    """Whatever the order of its frames: those of one time follow each other as the views do."""
    order = np.array([0, 3, 1, 4, 2, 5])
    series = scan_at(exposures(0).repeated(np.array([0.0, 1.0]))[order])
    found = Beams.of(exposures(1)).applied(series)
    wanted = exposures(1).repeated(np.array([0.0, 1.0]))[order]
    np.testing.assert_array_equal(found.views.rotations, wanted.views.rotations)
    np.testing.assert_array_equal(found.exposures.distance, wanted.distance)
    np.testing.assert_array_equal(found.exposures.time, series.exposures.time)


def test_what_is_left_out_stays_as_the_scan_says(tmp_path):
    file = tmp_path / "geometry.toml"
    views = "".join(f"[[view]]\nangle_deg = {30 * v}\ntilt_deg = {5 * v}\nshift_px = [{v}, -1]\n" for v in range(V))
    file.write_text(f'format = "holosplat geometry 1"\n{views}')
    found = read_beams(file).applied(scan_at(exposures(0)))
    np.testing.assert_allclose(found.views.rotations, rotation_tilted([0, 30, 60], [0, 5, 10]), atol=1e-15)
    np.testing.assert_allclose(found.views.shifts, PIXEL * np.array([[0, -1], [1, -1], [2, -1]]), rtol=1e-15)
    np.testing.assert_array_equal(found.exposures.distance, exposures(0).distance)
    file.write_text(file.read_text().replace("tilt_deg", "pixel_size_m = 3e-6\ntilt_deg"))
    larger = read_beams(file).applied(scan_at(exposures(0)))
    assert larger.views.pixel_size == 3e-6
    np.testing.assert_allclose(larger.views.shifts, 1.5 * found.views.shifts, rtol=1e-12)


GOOD = 'format = "holosplat geometry 1"\n[[view]]\nangle_deg = 0.0\ndistance_m = 0.1\n[[view]]\nangle_deg = 1.0\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "format is missing"),
        ('format = "geometry 9"\n[[view]]\nangle_deg = 0', "format must be 'holosplat geometry 1'"),
        ('format = "holosplat geometry 1"', "a table \\[\\[view\\]\\] for each beam"),
        (GOOD, "view\\[1\\].distance_m is missing, which view\\[0\\] has"),
        (GOOD.replace("distance_m", "distance"), "view\\[0\\].distance is not known"),
        (GOOD.replace("angle_deg = 1.0", "shift_px = [0, 0]"), "either rotation or angle_deg"),
        (GOOD + "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "either rotation or angle_deg"),
        (GOOD + "shift_m = [0, 0, 0]", "view\\[1\\].shift_m must have 2 entries"),
        (GOOD + "shift_m = [0, 0]\nshift_px = [0, 0]", "leave one of the two"),
        (GOOD.replace("angle_deg = 1.0", "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]"), "proper rotation"),
        (GOOD + "distance_m = 1.0\npixel_size_m = 1e-6", r"view\[0\].pixel_size_m is missing"),
        (GOOD.replace("angle_deg = 1.0", "angle_deg = 'x'"), "must be a number"),
        ("made_by = 3", "made_by must be a table of texts"),
        ("[[view", "must be valid TOML"),
    ],
)
def test_a_file_that_is_no_geometry_is_refused(tmp_path, text, said):
    (tmp_path / "geometry.toml").write_text(text)
    with pytest.raises(InputError, match=said) as raised:
        read_beams(tmp_path / "geometry.toml")
    assert "geometry.toml" in str(raised.value)


def test_a_geometry_of_other_beams_is_refused(tmp_path):
    with pytest.raises(InputError, match="each of the 2 frames, or for each of the 2 of every time, but it has 3"):
        Beams.of(exposures()).applied(scan_at(exposures()[:2]))
    write_beams(tmp_path / "geometry.toml", Beams.of(exposures()))
    write_scan(tmp_path / "scan.nxs", scan_at(exposures()))
    for option, told in (("--distance", Told(distance=0.2)), ("--axis-column", Told(axis_column=3.0))):
        with pytest.raises(InputError, match=f"says it already; leave {option}"):
            read_as(tmp_path / "scan.nxs", Reading(replace(told, exposures=tmp_path / "geometry.toml")))


def test_a_file_that_lacks_distance_and_energy_takes_them_from_the_geometry(tmp_path):
    """Frames of other programs: an archive that says nothing but its angles."""
    frames = scan_at(exposures()).frames
    np.savez(tmp_path / "scan.npz", data=frames, angles_deg=np.zeros(V))
    write_beams(tmp_path / "geometry.toml", Beams.of(exposures(1)).with_pixel_size(PIXEL))
    found = read_as(tmp_path / "scan.npz", Reading(Told(exposures=tmp_path / "geometry.toml")))
    np.testing.assert_array_equal(found.exposures.distance, exposures(1).distance)
    np.testing.assert_array_equal(found.views.rotations, exposures(1).views.rotations)
    assert found.views.pixel_size == PIXEL


def run_of(tmp_path: Path, reading: Reading, summary: dict[str, object]) -> Path:
    """A run folder of the scan in `tmp_path`."""
    run = tmp_path / "run"
    run.mkdir()
    write_scan(tmp_path / "scan.nxs", scan_at(exposures(0)))
    write_json(run / "config.json", {})
    write_json(run / "source.json", run_source(tmp_path / "scan.nxs", reading))
    write_json(run / "summary.json", summary)
    return run


def test_a_run_that_was_read_with_a_geometry_keeps_it(tmp_path):
    write_beams(tmp_path / "geometry.toml", Beams.of(exposures(1)))
    run = run_of(tmp_path, Reading(Told(exposures=tmp_path / "geometry.toml")), {})
    assert run_reading(run).told.exposures == (tmp_path / "geometry.toml").resolve()
    np.testing.assert_array_equal(read(run).views.rotations, exposures(1).views.rotations)


def test_the_scan_of_a_refined_run_is_where_the_run_found_it(tmp_path):
    true = exposures(1)
    numbers = (true.views.rotations.tolist(), true.views.shifts.tolist(), true.distance.tolist())
    run = run_of(tmp_path, Reading(), {"geometry": dict(zip(("rotations", "shifts", "distance"), numbers))})
    found = read(run)
    np.testing.assert_array_equal(found.views.rotations, true.views.rotations)
    np.testing.assert_array_equal(found.views.shifts, true.views.shifts)
    np.testing.assert_array_equal(found.exposures.distance, true.distance)
    write_json(run / "summary.json", {"geometry": {"rotations": numbers[0][:2], "shifts": [], "distance": []}})
    with pytest.raises(InputError, match="geometry\\.rotations must have the shape"):
        read(run)
