"""What is collected of a series: its tables, its bodies by name, and its page."""

from __future__ import annotations

import csv
import html
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import holosplat, refused, worked
from helpers.moving_ellipsoids import TIMES, true_paths
from helpers.moving_ellipsoids import scan as ellipsoids
from holosplat.io.nxtomo import write_scan
from holosplat.report.page import Headline
from holosplat.representations import MovingSurfaces
from holosplat.series.collect import collect, same_bodies
from holosplat.series.folder import SeriesFolder, duration, table_of, time_left
from holosplat.series.one_time import PHASE
from holosplat.series.page import Frame, Point, SeriesPage, chart, headline, labels, render_page
from holosplat.series.run import run_left, states
from holosplat.workflows.reconstruction import Reconstruction


def table(path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def partly(done, tmp_path) -> SeriesFolder:
    """The series with one task done, one that failed, and one that is left."""
    folder = SeriesFolder(shutil.copytree(done.path, tmp_path / "partly"))
    shutil.rmtree(folder.task(2))
    shutil.rmtree(folder.task(1))
    folder.task(1).mkdir()
    (folder.task(1) / "failed.json").write_text(json.dumps({"reason": "<b>no\x1b matter"}))
    return folder


def test_a_table_of_all_times(done, tmp_path):
    folder = SeriesFolder(shutil.copytree(done.path, tmp_path / "series"))
    assert collect(folder).missing == []
    rows = table(folder.table)
    assert [row["number"] for row in rows] == list("01234")
    assert [row["begun"] for row in rows] == ["cold", "warm", "cold", "warm", "cold"]
    assert {row["status"] for row in rows} == {"done"}
    first = folder.rows(folder.plan().windows()[0])[0]
    assert float(rows[0]["test_ssim"]) == pytest.approx(first.test["ssim"], rel=1e-5, abs=0)
    assert (folder.path / rows[3]["run"] / "object.h5").is_file()
    page = folder.page.read_text()
    assert "All times are done." in page
    assert page.count("data:image/png") == len(rows) + 1  # and the one that is shown first
    assert "http" not in re.sub(r"data:[^\"]*", "", page).replace("http-equiv", "")


def test_what_is_missing_is_said(partly):
    found = collect(partly)
    assert found.missing == [2, 3, 4]
    assert [row["status"] for row in table(partly.table)] == ["done", "done", "failed", "failed", "left"]
    page = partly.page.read_text()
    assert "3 of 5 times are missing." in page
    assert "&lt;b&gt;no" in page  # names and reasons are text
    lines = table_of(states(partly))
    assert re.match(r" +1  failed +0 of +2 times  <b>no  matter", lines[1])
    assert time_left(states(partly)).startswith(
        "tasks: 1 done, 0 running, 1 failed, 1 left; 2 of 5 times are done; the rest"
    )
    out = holosplat("series", "collect", partly.path)
    assert (out.code, "3 of 5 times are missing: 2, 3, 4" in out.err) == (4, True)
    assert "1 failed" in worked(holosplat("series", "status", partly.path)).out


def terabytes(path: Path) -> None:
    """A header that declares 40 TB, and 100 bytes."""
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**7, 10**6)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(100))


def of_one_axis(path: Path) -> None:
    np.save(path, np.zeros(5))


def of_text(path: Path) -> None:
    path.write_bytes(b"no array")


def a_pipe(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (terabytes, "but it is damaged or none: it declares 4e+13 bytes, but has"),
        (of_one_axis, "must be a phase map of numbers [H, W], but it is float64 of the shape (5,)"),
        (of_text, "must be a phase map (.npy), but it is damaged or none"),
        (a_pipe, "must be a phase map, but it is a pipe or a device"),
    ],
)
def test_a_phase_map_that_cannot_be_read_is_left_out_and_said(done, tmp_path, make, said):
    folder = SeriesFolder(shutil.copytree(done.path, tmp_path / "series"))
    path = folder.run(0, 0) / PHASE
    path.unlink()
    make(path)
    worked(holosplat("series", "collect", folder.path))
    page = html.unescape(folder.page.read_text())
    assert "All times are done." in page
    assert "time 0 has no picture: " in page
    assert said in page
    assert page.count("data:image/png") == 4 + 1


def test_a_body_keeps_its_name():
    """The nearest one within a radius; one that comes gets a new name."""
    radius = (0.75 / np.pi) ** (1 / 3)  # of a volume of one
    before = [(0.0, 0, 0, 1.0), (5.0, 0, 0, 1.0)]
    now = [(5.0 + 0.9 * radius, 0, 0, 1.0), (0.0, 1.1 * radius, 0, 1.0), (0.1, 0, 0, 1.0)]
    assert same_bodies(before, (3, 4), now, 5) == ((4, 5, 3), 6)
    assert same_bodies((), (), now[:2], 0) == ((0, 1), 2)


def test_bodies_are_followed_from_task_to_task(tmp_path, monkeypatch):
    """Windows of track that overlap: bodies have the same names in both, and it is said how far they are apart.

    `track` itself is a stand-in that finds the true bodies, in the second task moved by 50 nm.
    """
    write_scan(tmp_path / "scan.nxs", ellipsoids())
    cut = ["--window", TIMES - 1, "--overlap", 2, "--out", tmp_path / "series"]
    worked(holosplat("series", "plan", tmp_path / "scan.nxs", "--track", "--material", "haemoglobin", *cut))
    asked = []

    def found(scan, prior, options, seed, *, light, folder, resume):
        asked.append([round(1e6 * when) for when in scan.instants])
        bodies = true_paths()
        if len(asked) == 2:
            parts = bodies.faces, bodies.of_body, bodies.basis, bodies.unit_length, bodies.matter
            bodies = MovingSurfaces(bodies.coefficients + 50e-9 / bodies.unit_length / 3**0.5, *parts)
        return Reconstruction(bodies, "track", 20.0, 1, {}, True)

    monkeypatch.setattr("holosplat.series.task.track", found)
    folder = SeriesFolder(tmp_path / "series")
    assert run_left(folder).done == 2
    assert asked == [[10 * k for k in range(TIMES - 1)], [10 * k for k in range(TIMES - 3, TIMES)]]
    found_all = collect(folder)
    counts = {len(row.bodies) for row in found_all.rows if row}
    assert counts == {true_paths().count}
    assert {int(row["body"]) for row in table(folder.bodies)} == set(range(true_paths().count))
    assert found_all.agreement == {1: pytest.approx(50e-9, rel=1e-3, abs=0)}
    assert "task 1: bodies are 0.05 µm from where" in folder.page.read_text()
    assert all(row is not None and row.total is not None and row.total > 0 and row.train for row in found_all.rows)


def test_charts_have_round_labels_and_stay_on_their_sheet():
    assert labels(0.0, 9.3) == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert labels(5.2e-22, 7.1e-22) == pytest.approx([5.5e-22, 6e-22, 6.5e-22, 7e-22], rel=1e-9, abs=0)
    drawn = str(chart([Point(0, 1.0, 0.5), Point(1, float("nan")), Point(2, 3.0, marked=True)], "<x>"))
    assert drawn.count("<circle") == 2
    assert "&lt;x&gt;" in drawn
    heights = [float(y) for y in re.findall(r'cy="([0-9.]+)"', drawn)]
    assert 0 < heights[1] < heights[0] < 190
    assert str(chart([], "x")) == ""


def test_a_page_of_nothing_says_so():
    page = render_page(SeriesPage("A <series>", Headline("No scan has come yet.", None, ()), "", (), refresh=2.0))
    assert "A &lt;series&gt;" in page
    assert "const refresh = 2000;" in page


def test_durations():
    assert [duration(s) for s in (3, 99.6, 600, 7200)] == ["3 s", "100 s", "10 min", "2.0 h"]


def test_bad_input_of_the_command(files, done, tmp_path):
    refused(holosplat("series", "plan", files.scan, "--out", done.path), "must be new or empty", "--force")
    refused(
        holosplat("series", "plan", files.scan, "--out", tmp_path / "a", "--rounds", 2),
        "--rounds does not go with --motion each",
    )
    refused(
        holosplat("series", "plan", files.scan, "--track", "--preset", "fast", "--out", tmp_path / "a"),
        "--preset does not go with --motion bodies",
    )
    refused(holosplat("series", "plan", files.scan, "--delta-beta", "1:2", "--out", tmp_path / "a"), "one number")
    refused(holosplat("series", "run", tmp_path), "must hold a series")
    refused(holosplat("series", "run", done.path, 1, "--jobs", 2), "give one of a task's number")
    refused(holosplat("series", "run", done.path, 7), "from 0 to 2, but 7 is asked for")
    assert not (tmp_path / "a").exists()


def test_the_verdict_is_the_headline_with_cause_and_command(done, tmp_path):
    """Of a series of which one time is not explained; a scale bar, a colour bar and a list of contents are there."""
    folder = SeriesFolder(shutil.copytree(done.path, tmp_path / "series"))
    run = folder.run(0, 0)
    summary = json.loads((run / "summary.json").read_text())
    summary["verdict"] |= {"good": False, "cause": "distance", "reasons": ["a distance 4 % longer explains more"]}
    (run / "summary.json").write_text(json.dumps(summary))
    row = replace(folder.rows(folder.plan().windows()[0])[0], good=False, words="The frames are not explained.")
    frame = Frame(row, 0.0, run / PHASE, "run")
    said = headline("All times are done.", [frame])
    assert (said.text, said.trusted) == ("Do not trust 1 of 1 times: their frames are not explained", False)
    assert said.step is not None
    assert said.step.command.startswith(f"holosplat reconstruct {row.scan} --distance LOW:HIGH")
    page = render_page(SeriesPage("A series", said, "", (frame,)))
    assert f"<h1>{said.text}</h1>" in page
    assert "a distance 4 % longer explains more" in page
    assert re.search(r'class="ruler" style="width: [0-9.]+%">\d+\xa0[nµ]?m<', page)
    links, ids = re.findall('href="#([^"]+)"', page), re.findall(' id="([^"]+)"', page)
    assert {"map", "charts", "times"} <= set(links) <= set(ids)
    absorbing = replace(frame, row=replace(row, quantity="β"))
    page = render_page(SeriesPage("A series", said, "", (absorbing,)))
    assert "Absorption in the first view" in page
    assert "rad" not in page.partition("<main>")[2].partition("<script>")[0].replace("gradient", "")


def test_labels_of_an_axis_are_told_apart():
    page = chart([Point(k, 0.98 + 1e-6 * k) for k in range(9)], "SSIM")
    ticks = re.findall('text-anchor="end">([^<]+)<', page)
    assert len(set(ticks)) == len(ticks) > 1
