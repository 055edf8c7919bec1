"""The command line: its contract on tiny scenes, and how it explains itself."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import holosplat.workflows.demo as demo
from helpers.cli import (
    BEAM,
    COLUMNS,
    FORMULA,
    MATTER,
    QUICK,
    ROWS,
    altered,
    holosplat,
    worked,
)
from holosplat.cli import main
from holosplat.methods.presets import SCHEMA, preset
from holosplat.tables import to_table


def test_the_installed_command_is_main():
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="holosplat")
    assert entry.load() is main


@pytest.mark.parametrize("command", ["simulate", "reconstruct", "render", "export", "evaluate", "demo"])
def test_every_command_explains_itself(command):
    outcome = worked(holosplat(command, "--help"))
    assert f"holosplat {command}" in outcome.out
    assert "--out" in outcome.out or "--volume" in outcome.out or "--truth" in outcome.out


def test_the_whole_chain(shop, tmp_path):
    """simulate, reconstruct with a preset, render, export, evaluate: files in, files out, nothing else."""
    cells = [os.path.relpath(cell, tmp_path) for cell in shop.cells]
    options = [*MATTER, *BEAM, "--views", 8, "--psf-sigma-px", 0.3, "--photons-per-pixel", 20000, "--seed", 3]
    with contextlib.chdir(tmp_path):
        worked(holosplat("simulate", *cells, *options, "--out", "scan.nxs", "--truth", "truth.h5"))
        material = ["--material", FORMULA, "--density", 1.335]
        fitted = holosplat("reconstruct", "scan.nxs", "--out", "RUN", *material, "--preset", "fast", "--seed", 4)
        assert "held-out frames: SSIM" in worked(fitted).out
        assert "report: RUN/report.html" in fitted.err
        worked(holosplat("render", "RUN", "--scan", "scan.nxs", "--out", "predicted.nxs"))
        worked(holosplat("export", "RUN", "--volume", "volume.h5"))
        scores = json.loads(worked(holosplat("evaluate", "RUN", "--truth", "truth.h5", "--json")).out)
    assert scores["ssim"] > 0.8
    assert scores["dice"] > 0.9
    worked(holosplat("evaluate", tmp_path / "RUN"))  # it knows its scan from any folder
    found = {path.name for path in tmp_path.iterdir()}
    assert found == {"scan.nxs", "truth.h5", "RUN", "predicted.nxs", "volume.h5"}
    names = {
        "config.json",
        "metrics.csv",
        "checkpoint.pt",
        "checkpoint_before.pt",
        "manifest.json",
        "provenance.json",
        "object.h5",
        "summary.json",
        "source.json",
        "report.html",
    }
    assert {path.name for path in (tmp_path / "RUN").iterdir()} == names
    assert "</html>" in (tmp_path / "RUN/report.html").read_text()
    config = json.loads((tmp_path / "RUN/config.json").read_text())
    assert config["schema_version"] == SCHEMA
    assert config["method"] == to_table(preset("fast"))
    assert config["seed"] == 4


def test_the_demo_runs_the_chain_and_shows_its_commands(shop, tmp_path, monkeypatch):
    """Here on the two small cells."""
    monkeypatch.setattr(demo, "DETECTOR", (ROWS, COLUMNS))
    monkeypatch.setattr(demo, "write_demo_meshes", lambda folder: [Path(shutil.copy(c, folder)) for c in shop.cells])
    monkeypatch.setattr("holosplat.methods.presets.chosen_method", lambda *said: QUICK)
    outcome = worked(holosplat("demo", "--out", tmp_path / "demo"))
    found = {path.name for path in (tmp_path / "demo").iterdir()}
    assert found == {"meshes", "scan.nxs", "truth.h5", "run", "provenance.json"}
    assert (tmp_path / "demo/run/report.html").is_file()
    for command in ("simulate", "reconstruct", "evaluate"):
        assert f"$ holosplat {command}" in outcome.err
    assert "volume: Dice" in outcome.out
    again = holosplat("demo", "--out", tmp_path / "demo")
    assert (again.code, "--out" in again.err) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reconstruct", "scan.nxs"], ["--out"]),
        (["reconstruct", "scan.nxs", "--out", "o", "--sead", "1"], ["--sead", "--seed"]),
        (["reconstruct", "scan.nxs", "--out", "o", "--seed", "one"], ["--seed", "one"]),
        (["simulate", "a.vtk", *altered("--detector", "24"), "--out", "o"], ["--detector"]),
        (["simulate", "a.vtk", *altered("--origin", "1 2"), "--out", "o"], ["--origin"]),
        (["render", "run", "--scan", "scan.nxs", "--out", "o", "--split", "some"], ["--split", "some", "train"]),
        (["reconstrukt"], ["reconstrukt", "reconstruct"]),
        ([], ["simulate", "reconstruct"]),
    ],
)
def test_a_wrong_command_line_is_explained(arguments, words):
    outcome = holosplat(*arguments)
    assert outcome.code == 2
    assert "Traceback" not in outcome.err
    for word in words:
        assert word.replace("-", " ").strip() in outcome.said, (word, outcome.err)


def test_a_reader_that_leaves_early_sees_no_traceback():
    """`holosplat backends | head -1`, with a reader that closes at once."""
    command = [sys.executable, "-c", "from holosplat.cli import main; main()", "backends"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        assert "Traceback" not in process.stderr.read()
