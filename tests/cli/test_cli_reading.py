"""The options that say how a scan is read, in every command that reads frames."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from helpers.cli import PIXEL, copied, drop, holosplat, known, refused, worked
from helpers.pictures import undrawn
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume

pytestmark = pytest.mark.usefixtures("unjudged_runs")

PART = ("--crop", "3:22,1:26", "--views", "0:8:2", "--test-views", "3")


@pytest.fixture(scope="module")
def run(shop, tmp_path_factory):
    """A run on a part of the scan: off-centre rows and columns, every second view, and one held out."""
    out = tmp_path_factory.mktemp("reading") / "run"
    with undrawn():
        worked(holosplat("reconstruct", shop.scan, "--out", out, *known(shop), *PART))
    return out


def test_a_run_on_a_part_is_judged_on_the_same_part(shop, run):
    """Without a word: source.json knows. What is said otherwise is another scan, and the report then stays."""
    again = worked(holosplat("evaluate", run, "--json"))
    assert "not the scan that was reconstructed" not in again.err
    assert json.loads(again.out)["test"]["mean"]["ssim"] > 0.3
    other = worked(holosplat("evaluate", run, "--json", "--test-views", "1"))
    assert "not the scan that was reconstructed" in other.err
    named = worked(holosplat("evaluate", run, "--json", "--scan", shop.scan, *PART))
    assert json.loads(named.out) == json.loads(again.out)


def test_a_part_is_reconstructed_where_it_is(shop, run, tmp_path):
    """The volume of a run on a cut field lies where the field is, and agrees there with that of the whole field."""
    frames = {}
    for name, folder in (("part", run), ("whole", shop.run)):
        worked(holosplat("export", folder, "--volume", tmp_path / f"{name}.h5"))
        frames[name] = read_volume(tmp_path / f"{name}.h5")
    part, whole = frames["part"], frames["whole"]
    assert part.grid.shape == (25, 19, 25)
    views = read_scan(shop.scan)[[0, 2, 4, 6]].cropped(slice(3, 22), slice(1, 26)).views
    np.testing.assert_allclose(part.grid.origin, Grid.of_views(views).origin, atol=1e-12)
    y = np.round((part.grid.axes()[1] - whole.grid.axes()[1][0]) / PIXEL).astype(int)
    profile, wanted = part.delta.sum((0, 2)), whole.delta.sum((0, 2))[y]
    assert np.corrcoef(profile, wanted)[0, 1] > 0.9


def test_predicted_frames_of_a_part_are_a_part_of_the_predicted_frames(shop, tmp_path):
    whole, part = tmp_path / "whole.nxs", tmp_path / "part.nxs"
    worked(holosplat("render", shop.run, "--scan", shop.scan, "--out", whole, "--split", "all"))
    worked(holosplat("render", shop.run, "--scan", shop.scan, "--out", part, "--split", "all", "--crop", "0:24,2:27"))
    wanted = read_scan(whole).frames[:, :, 2:27]
    contrast = np.abs(wanted - 1).max()
    inside = slice(5, -5)  # waves beyond the edge are guessed
    np.testing.assert_allclose(
        read_scan(part).frames[:, inside, inside], wanted[:, inside, inside], atol=0.05 * contrast
    )


def test_a_part_is_converted_and_the_axis_said(shop, tmp_path):
    out = tmp_path / "part.nxs"
    worked(
        holosplat(
            *("convert", shop.scan, out, "--to", "nxtomo", "--crop", ":,4:28", "--bin", 2, "--views", "1,3,5"),
            *("--axis-column", "12.5", "--sense", "anticlockwise", "--distance", "0.2"),
        )
    )
    found, source = read_scan(out), read_scan(shop.scan)[[1, 3, 5]]
    assert (found.views.shape, found.views.pixel_size) == ((12, 12), 2 * PIXEL)
    np.testing.assert_allclose(found.views.rotations, source.views.rotations.transpose(0, 2, 1), atol=1e-9)
    np.testing.assert_allclose(found.views.shifts, [[(13.5 - 12.5 + 2) * PIXEL, 0]] * 3, atol=1e-12)
    assert set(found.exposures.distance) == {0.2}
    assert found.is_test.tolist() == [False, True, False]


def test_a_file_that_lacks_a_value_takes_it_from_the_command(shop, tmp_path):
    file = copied(shop.scan, tmp_path, drop("entry/instrument/beam/incident_energy"))
    refused(holosplat("convert", file, tmp_path / "out.nxs", "--to", "nxtomo"), "incident_energy", "--energy-kev")
    worked(holosplat("convert", file, tmp_path / "out.nxs", "--to", "nxtomo", "--energy-kev", 20))
    with h5py.File(tmp_path / "out.nxs") as opened:
        assert opened["entry/instrument/beam/incident_energy"][()] == 20


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--crop", "0:99,:"), ("--crop", "24 rows")),
        (("--views", "8"), ("--views", "from 0 to 7")),
        (("--bin", "0"), ("--bin",)),
        (("--angles", "none.txt"), ("--angles", "none.txt")),
        (("--axis-column", "28"), ("0 to 27",)),
        (("--pixel-size", "3"), ("--pixel-size", "metres")),
    ],
)
def test_what_cannot_be_read_so_is_refused(shop, tmp_path, options, words):
    outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop), *options)
    refused(outcome, *words)
    assert not (tmp_path / "run").exists()
