"""The examples run as they stand, and give what they promise."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.workflows.run_folder import RunFolder

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run_example(name: str, *arguments: str, cwd: Path) -> str:
    """What the example prints; it must end well and say nothing on stderr."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_every_example_is_tested_and_short():
    found = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert found == ["01_simulate_and_reconstruct.py"]
    for name in found:
        assert (EXAMPLES / name).read_text(encoding="utf-8").count("\n") <= 60


def test_simulate_and_reconstruct(tmp_path):
    """Scores of held-out views and of the volume are printed; scan, run and volume are there to be read."""
    printed = run_example("01_simulate_and_reconstruct.py", "results/first", cwd=tmp_path)
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
