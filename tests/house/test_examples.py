"""The examples run as they stand, and give what they promise."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.io.vtk import read_meshes
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("plain_light", "unjudged_runs")  # but of what runs as a process

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


QUIETLY = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Warnings that Python does not show of its own accord."""


@pytest.fixture
def run_example(tmp_path, monkeypatch, capfd, recwarn) -> Callable[..., str]:
    """Runs an example in `tmp_path` as its own program within this process; gives what it prints.

    It must end well and say nothing on stderr.
    """

    def run(name: str, *arguments: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        recwarn.clear()
        plt.switch_backend("agg")
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        printed, complaints = capfd.readouterr()
        plt.close("all")
        assert complaints == ""
        assert [str(w.message) for w in recwarn if not issubclass(w.category, QUIETLY)] == []
        return printed

    return run


def in_a_process(name: str, *arguments: str, cwd: Path) -> str:
    """What the example prints as a process; it must end well and say nothing on stderr."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_every_example_is_tested_and_short():
    found = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert found == [
        "01_simulate_and_reconstruct.py",
        "02_own_meshes.py",
        "03_unknown_material.py",
        "04_noise.py",
        "05_surfaces.py",
        "06_adding_a_method.py",
    ]
    for name in found:
        assert (EXAMPLES / name).read_text(encoding="utf-8").count("\n") <= 60


def test_simulate_and_reconstruct(run_example, tmp_path):
    """Scores of held-out views and of the volume are printed; scan, run and volume are there to be read."""
    printed = run_example("01_simulate_and_reconstruct.py", "results/first")
    out = tmp_path / "results/first"
    ssim, frcm = (float(v) for v in re.findall(r"held-out frames: SSIM ([\d.]+), FRCM ([\d.]+)", printed)[0])
    dice = float(re.findall(r"volume: Dice ([\d.]+)", printed)[0])
    assert ssim > 0.93
    assert frcm > 0.5
    assert dice > 0.94
    assert {path.name for path in out.iterdir()} == {"scan.nxs", "run", "volume.h5"}
    assert str(Path("results/first/volume.h5")) in printed
    scan, volume = read_scan(out / "scan.nxs"), read_volume(out / "volume.h5")
    assert scan.is_test.sum() == 3
    assert volume.grid == Grid.of_views(scan.views)
    prior = RunFolder(out / "run").read_config()["prior"]
    assert prior["kind"] == "known"
    assert np.median(volume.delta[volume.delta > prior["delta"] / 2]) == pytest.approx(prior["delta"], rel=0.1, abs=0)


def numbers(pattern: str, printed: str) -> list[float]:
    """The numbers at the group of `pattern`, in the order in which they are printed."""
    return [float(value) for value in re.findall(pattern, printed)]


def test_own_meshes(tmp_path):
    """Meshes of other programs become a scan file and a volume with their three bodies; this one runs as a process."""
    printed = in_a_process("02_own_meshes.py", "out", cwd=tmp_path)
    assert "3 meshes" in printed
    assert numbers(r"volume: Dice ([\d.]+)", printed)[0] > 0.97
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "cell0.vtk",
        "cell1.vtk",
        "cell2.vtk",
        "scan.nxs",
        "hologram_and_volumes.png",
    }


@pytest.mark.usefixtures("quick_likelihood")
def test_unknown_material(run_example):
    """The known material gives a volume as good as any; with nothing known the ratio is within a third of the true one.

    It acts on the lowest frequencies, of which a field of four cells has few.
    """
    printed = run_example("03_unknown_material.py", "out")
    errors = numbers(r"error of δ ([\d.]+)", printed)
    assert errors[0] < min(0.09, min(errors) + 0.005)
    assert errors[2] < 0.1
    true, *_, found = numbers(r"δ/β = (\d+)", printed)
    assert found == pytest.approx(true, rel=0.33, abs=0)


def test_noise(run_example):
    """Scores fall with the photons, and cells are still found in the fewest."""
    printed = run_example("04_noise.py", "out")
    scores = numbers(r"SSIM ([\d.]+)", printed)
    assert scores == sorted(scores, reverse=True)
    assert numbers(r"Dice ([\d.]+)", printed)[2] > 0.8


def test_surfaces(run_example, tmp_path):
    """Surfaces have a much smaller error than the Gaussians, and are written as closed bodies."""
    printed = run_example("05_surfaces.py", "out")
    gaussians, surfaces = numbers(r"error of δ ([\d.]+)", printed)
    assert surfaces < 0.6 * gaussians
    (bodies,) = read_meshes([tmp_path / "out/bodies.vtk"], "um")
    assert f"{len(bodies.vertices)} vertices" in printed


def test_adding_a_method(run_example):
    """The method of the example finds the cells, with another result than the method that it builds on."""
    printed = run_example("06_adding_a_method.py")
    kinds = re.findall(r"^([\w-]+):$", printed, re.MULTILINE)
    assert kinds == ["per-view", "thresholded"]
    errors = dict(zip(kinds, numbers(r"relative error of δ ([\d.]+)", printed)))
    assert errors["thresholded"] < 0.3
    assert errors["thresholded"] != errors["per-view"]
