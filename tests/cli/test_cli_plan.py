"""`holosplat plan`: what it prints and writes."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import sys

import numpy as np
import pytest

from helpers.planned import CELL, ellipsoid
from holosplat.checks import InputError
from holosplat.cli import main
from holosplat.io.vtk import write_mesh
from holosplat.materials import WATER
from holosplat.mesh import TriangleMesh
from holosplat.planning.contrast import Setup, Subject
from holosplat.planning.plan import Recording, plan


def command(*arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `holosplat plan`; any exception but a clean exit fails the test."""
    out, err, before, code = io.StringIO(), io.StringIO(), sys.argv, 0
    sys.argv = ["holosplat", "plan", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.argv = before
    return code, out.getvalue(), err.getvalue()


PLASMA_CELL = ["--material", "red cell", "--medium", "plasma"]


def test_the_command_prints_the_plan():
    options = ["--detector", 100, 200, "--frame-rate", "1e6", "--velocity", 2, "--exposure", "1e-7", "--frames", 50]
    code, out, err = command(*PLASMA_CELL, "--pixel-size", "0.5e-6", "--photons-per-pixel", "1e4", *options)
    assert (code, err) == (0, "")
    for words in ("red cell of 8 µm, red cell in plasma", "20 keV, 100 mm, pixels of 500 nm", "2.49 µm, 4.98 px"):
        assert words in out
    found = plan(CELL, Setup(20.0, 0.1, 0.5e-6), Recording(1e4)).detection
    (line,) = [line for line in out.splitlines() if "signal to noise, 1e4" in line]
    assert line.split()[-1] == f"{found.snr:.3g}"
    (line,) = [line for line in out.splitlines() if line.strip().startswith("photons/px for signal to noise 5")]
    assert float(line.split()[-1]) == pytest.approx(found.photons, rel=0.01)
    assert "blur in an exposure" in out
    assert "640 GB/s" in out
    code, out, _ = command("--photons-per-pixel", 100)
    assert code == 0
    assert "haemoglobin in vacuum" in out
    assert "motion" not in out
    assert "data rate" not in out


def test_the_command_explains_itself():
    code, out, _ = command("--help")
    assert code == 0
    for flag in ("--distance-range", "--energy-range", "--velocity", "--ball", "--mesh", "--json", "--source-angle"):
        assert flag in out


def test_json_holds_inputs_and_results():
    code, out, _ = command(*PLASMA_CELL, "--json", "--detector", 64, 96, "--views", 8)
    assert code == 0
    found = json.loads(out)
    wanted = plan(CELL, Setup(), Recording(views=8, detector=(64, 96)))
    assert found["plan"]["detection"]["photons"] == pytest.approx(wanted.detection.photons)
    assert found["plan"]["sampling"]["limit_field"] == pytest.approx(wanted.sampling.limit_field)
    assert found["setup"] == {
        "energy_kev": 20.0,
        "distance": 0.1,
        "pixel_size": 3.2e-6,
        "psf_sigma_px": 0.0,
        "source_angle": 0.0,
    }
    assert found["recording"]["views"] == 8


def test_a_mesh_file_is_planned_as_the_shape_it_holds(tmp_path):
    write_mesh(tmp_path / "ball.vtk", ellipsoid(3e-6, 3e-6, 3e-6), "um")
    matter = ["--material", "SiO2", "--density", 2.2, "--medium", "water", "--json"]
    (_, from_file, _), (_, made, _) = (
        command(*matter, *shape) for shape in (["--mesh", tmp_path / "ball.vtk"], ["--ball", "6e-6"])
    )
    one, other = (json.loads(text)["plan"]["detection"]["snr_rms"] for text in (from_file, made))
    assert one == pytest.approx(other, rel=1e-4)


def test_a_survey_writes_its_picture_and_its_table(tmp_path):
    ranges = ["--distance-range", 0.02, 0.5, "--energy-range", 10, 30, "--points", 5, 3]
    code, out, err = command(*PLASMA_CELL, *ranges, "--out", tmp_path / "best.png", "--photons-per-pixel", "1e5")
    assert code == 0
    assert "surveying" in err
    assert f"wrote {tmp_path / 'best.png'}" in err
    assert {path.name for path in tmp_path.iterdir() if path.suffix != ".json"} == {"best.png", "best.csv"}
    assert (tmp_path / "best.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "best.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["energy_kev"]) for row in rows] == [10, 20, 30]
    at = Setup(20.0, float(rows[1]["best_distance_m"]), 3.2e-6)
    assert float(rows[1]["snr"]) == pytest.approx(plan(CELL, at, Recording(1e5)).detection.snr_rms, rel=1e-4)
    (line,) = [line for line in out.splitlines() if line.split()[:2] == ["20", "keV"]]
    assert f"{float(rows[1]['snr']):.3g}" in line
    assert "best" in out


def test_one_range_is_enough_and_needs_no_file(tmp_path):
    code, out, _ = command("--energy-range", 10, 20, "--points", 2, 3, "--json")
    assert code == 0
    found = json.loads(out)["survey"]
    assert (found["energies_kev"], found["distances_m"]) == ([10, 15, 20], [0.1])
    code, out, _ = command("--distance-range", 0.05, 0.2, "--points", 3, 2)
    assert code == 0
    assert "20 keV" in out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--energy-kev", -5], ["energy", "positive", "-5"]),
        (["--energy-kev", 20000], ["energy", "20000", "unit"]),
        (["--distance", -1], ["distance", "negative"]),
        (["--pixel-size", 3.2], ["--pixel-size", "3.2", "metres"]),
        (["--psf-sigma-px", -1], ["--psf-sigma-px", "-1"]),
        (["--source-angle", "nan"], ["--source-angle", "nan"]),
        (["--photons-per-pixel", 0], ["--photons-per-pixel"]),
        (["--views", 0], ["views", "0"]),
        (["--detector", 0, 5], ["--detector", "0"]),
        (["--bit-depth", 65], ["--bit-depth", "65"]),
        (["--velocity", -1], ["velocity", "-1"]),
        (["--frame-rate", "1e6", "--exposure", "1e-3"], ["exposure", "0.001", "1e-06"]),
        (["--diameter", 8], ["--diameter", "8", "metres"]),
        (["--diameter", "8e-6", "--ball", "8e-6"], ["--diameter", "--ball"]),
        (["--tilt-deg", "nan"], ["tilt"]),
        (["--mesh", "nowhere.vtk"], ["nowhere.vtk"]),
        (["--material", "unobtainium"], ["unobtainium"]),
        (["--material", "SiO2"], ["SiO2", "density"]),
        (["--medium-density", 1], ["--medium"]),
        (["--material", "water", "--medium", "water"], ["differ"]),
        (["--ball", "2e-3"], ["samples", "smaller object"]),
        (["--pixel-size", "1e-8", "--distance", 10], ["samples", "shorter distance"]),
        (["--distance-range", 1, 0.1], ["--distance-range", "lower"]),
        (["--distance-range", -1, 1], ["--distance-range", "-1"]),
        (["--energy-range", 10, "nan"], ["--energy-range", "nan"]),
        (["--energy-range", 10, 20, "--points", 1, 5], ["--points"]),
        (["--out", "best.png"], ["--out", "--distance-range"]),
        (["--energy-range", 10, 20, "--out", "best.pdf"], ["--out", ".png"]),
        (["--energy-range", 10, 20, "--out", "no/such/best.png"], ["no/such/best.png", "folder"]),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*options)
    assert (code, out) == (2, "")
    (line,) = [line for line in err.splitlines() if line.startswith("holosplat: ")]
    assert line.endswith(".")
    for word in words:
        assert word in line, line
    assert list(tmp_path.iterdir()) == []


def test_flat_objects_are_refused():
    flat = TriangleMesh(np.array([[0, 0, 0], [1e-6, 0, 0], [0, 1e-6, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]]), "leaf")
    with pytest.raises(InputError, match="leaf"):
        Subject(flat, WATER)


SMALL = ["--ball", "6e-6", "--pixel-size", "1e-6", "--distance", 0.03, "--views", 3, "--detector", 17, 15]


def test_an_experiment_is_rehearsed_before_it_is_made():
    code, out, _ = command(*SMALL, "--times", 2, "--json")
    assert code == 0
    table = json.loads(out)["rehearsal"]
    low, high = table["intervals_of_errors"]["total"]
    assert low < 0 < high
    assert len(table["runs"]) == 2
    assert any(line.startswith("Dice: at least") for line in table["words"])
    code, _, err = command(*SMALL, "--times", 1)
    assert code == 2
    assert "2 rehearsals or more, but it is 1" in err
