"""Two runs side by side: what differs is said, volumes are compared on one grid, and other folders are refused."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from helpers.cli import COLUMNS, PIXEL, ROWS, Workshop, holosplat, refused, worked
from holosplat.cli.scans import side_of_run
from holosplat.inference import Decision
from holosplat.metrics import fourier_shell_correlation
from holosplat.report.compare import Comparison, chosen, differing, in_columns
from holosplat.report.page import Table

pytestmark = pytest.mark.usefixtures("unjudged_runs")


@pytest.fixture(scope="module")
def coarse(shop: Workshop, tmp_path_factory):
    """A run of the shop's scan on pixels joined two by two, by another method."""
    out = tmp_path_factory.mktemp("coarse") / "run"
    method = ("--method", "tikhonov-tv", "--material", "haemoglobin")
    worked(holosplat("reconstruct", shop.scan, "--out", out, "--bin", 2, *method))
    return out


def test_a_run_is_the_same_as_itself(shop, tmp_path):
    said = worked(holosplat("compare", shop.run, shop.run, "--out", tmp_path / "page.html")).out
    assert "differs by 0 %" in said
    assert "that differ" not in said
    assert "Dice, at half of A's" in said
    page = (tmp_path / "page.html").read_text()
    assert "Slices of both" in page
    assert "A with B in Fourier space" in page
    assert "Nothing differs." in page


def test_what_differs_is_said_on_the_terminal_and_on_the_page(shop, coarse, tmp_path):
    said = worked(holosplat("compare", shop.run, coarse, "--out", tmp_path / "page.html")).out
    page = (tmp_path / "page.html").read_text()
    for words in ("method.kind", "per-view", "scan_hash", "SSIM of held-out frames", "kept state", "verdict"):
        assert words in said
        assert words in page
    assert "warmup_steps" not in said  # a usual setting that the other method does not have
    refused(holosplat("compare", shop.run, coarse, "--out", tmp_path / "page.html"), "page.html must be new")


def test_a_name_that_is_decided_again_keeps_its_choices_in_order():
    made = [
        Decision(name, choice, "held-out views")
        for name, choice in (("twins", "one"), ("start", "usual"), ("twins", "other"))
    ]
    assert chosen(made) == {"twins": "one, other", "start": "usual"}


def test_volumes_of_other_pixels_are_compared_on_one_grid(shop, coarse):
    """Of the larger pixels, over the fields of both; the correlation is that of the two volumes there."""
    found = Comparison(side_of_run(shop.run), side_of_run(coarse))
    assert found.grid.shape == (-(-COLUMNS // 2), -(-ROWS // 2), -(-COLUMNS // 2))
    assert found.grid.voxel_size[0] == pytest.approx(2 * PIXEL)
    first, second = found.volumes
    assert found.scores is not None
    expected = fourier_shell_correlation(second.delta, first.delta)[1]
    np.testing.assert_allclose(found.scores.fsc, expected)
    assert found.scores.fsc[1] > 0.5


def test_a_run_whose_scan_is_gone_is_compared_without_scores(shop, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(shop.run, moved)
    source = moved / "source.json"
    source.write_text(source.read_text().replace("scan.nxs", "gone.nxs"))
    said = worked(holosplat("compare", shop.run, moved, "--out", tmp_path / "page.html")).out
    row = next(line for line in said.splitlines() if "SSIM of held-out frames" in line)
    assert row.endswith("–")


@pytest.mark.parametrize("which", ["nothing", "folder", "scan.nxs"])
def test_what_is_no_run_is_refused(shop, tmp_path, which):
    (tmp_path / "folder").mkdir()
    (tmp_path / "scan.nxs").write_bytes(b"")
    refused(holosplat("compare", shop.run, tmp_path / which, "--out", tmp_path / "page.html"), which)
    assert not (tmp_path / "page.html").exists()


def test_tables_differ_where_values_do():
    assert differing({"a": 1, "b": 2}, {"b": 3, "a": 1, "c": None}) == [("b", "2", "3"), ("c", "–", "None")]
    lines = in_columns(Table("Both", [("name", "x " * 40, "y")], ("", "A", "B")))
    assert lines[0] == "Both"
    assert max(map(len, lines)) <= 2 + 3 * 46
    assert [line.strip()[0] for line in lines[2:]] == ["n", "x"]
