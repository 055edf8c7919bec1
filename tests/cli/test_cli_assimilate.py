"""`forecast --by assimilate`: mechanics fitted to the frames of a run themselves, on a cell in a channel."""

from __future__ import annotations

import json
from functools import cache
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import holosplat as hs
import holosplat.cli.track as command
import holosplat.workflows.track as workflow
from helpers.cli import holosplat, refused, worked
from helpers.pictures import undrawn
from holosplat.bodies.rest_shape import centroid
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.motion.cell_model import CellModel, ChannelFrame
from holosplat.motion.membrane_fit import Unknowns
from holosplat.motion.track import Followed
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import RedCell, icosphere

MATERIAL, PIXEL, SHAPE = hs.materials.HAEMOGLOBIN.delta_beta(20.0), 0.7e-6, (21, 27)
SPHERE, FACES = icosphere(2)
CHANNEL = (22e-6, 17e-6)
TIMES = 3e-6 * np.arange(5)
AWAY = 0.15e-6 * np.array([1.0, 0.5, -1.0])
"""By which a run of track has the cell at the wrong place, at all times alike [m]."""


@cache
def way() -> np.ndarray:
    """[T, Q, 3] [m] of a cell that the model itself moves."""
    cell = TriangleMesh(RedCell().surface(SPHERE) + np.array([3e-6, 0, -1e-6]), FACES)
    return CellModel(ChannelFrame(CHANNEL), [cell], 5e-6, 1.2e-3, 3).run([cell], TIMES, Unknowns.of(0.05, 5e-6))[0]


def scan() -> hs.Scan:
    """Its frames from two sides."""
    views = hs.Views.from_angles(np.array([0.0, 90.0]), SHAPE, PIXEL)
    exposures = hs.Exposures.of(views, 20.0, 0.05).repeated(TIMES)
    scenes = [hs.MeshScene.of_one_material([TriangleMesh(at, FACES)], MATERIAL) for at in way()]
    frames = [hs.simulate(scene, exposures[[2 * k, 2 * k + 1]]).frames for k, scene in enumerate(scenes)]
    return hs.Scan(np.concatenate(frames), exposures, np.zeros(len(exposures), dtype=bool))


def beside_it(train: hs.Scan, *_: object, **__: object) -> Followed:
    """A run whose cell has the right shape and path, but lies beside its place."""
    basis = TimeBasis(float(train.instants[0]), float(train.instants[-1]), 2)
    paths = basis.fitted(train.instants, way()[: len(train.instants)] + AWAY)
    bodies = MovingSurfaces.of_bodies([paths], [FACES], basis, PIXEL, Matter.one(*MATERIAL))
    return Followed(bodies, [], 2, {"soft fit": 0.0}, (1,) * len(train.instants))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A scan, a run of its first four times, and forecasts of the last by frames and by paths."""
    folder = tmp_path_factory.mktemp("assimilate")
    write_scan(folder / "scan.nxs", scan())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workflow, "follow", beside_it)
        patch.setattr(command, "report_run", lambda folder, *_: folder.report)
        worked(holosplat("track", folder / "scan.nxs", "--material", "haemoglobin", "--time-frames", "0:4",
                         "--out", folder / "run"))  # fmt: skip
    how = ("--times", 1, "--no-half-sets", "--channel", *CHANNEL, "--peak", "0.046:0.056")
    with undrawn():
        said = worked(holosplat("forecast", folder / "run", *how, "--by", "assimilate", "--out", folder / "later"))
        worked(holosplat("forecast", folder / "run", *how[:3], "--by", "paths", "--out", folder / "paths"))
    (folder / "said.txt").write_text(said.out)
    return folder


def off(folder: Path) -> float:
    """By how much the middle of the cell is off at the forecast's time [m]."""
    found = read_object(folder / "object.h5")
    assert isinstance(found, MovingSurfaces)
    return float(np.linalg.norm(centroid(found.bodies(TIMES[4])[0]) - centroid(TriangleMesh(way()[4], FACES))))


def test_frames_put_the_cell_where_it_is(folder):
    """Paths keep their error; the frames do not allow it."""
    assert off(folder / "paths") == pytest.approx(np.linalg.norm(AWAY), rel=0.2)
    assert off(folder / "later") < 0.5 * off(folder / "paths")
    judged = [json.loads((folder / name / "forecast.json").read_text())["held_out"][0] for name in ("later", "paths")]
    assert judged[0]["ssim"] > judged[1]["ssim"]


def test_what_the_window_tells_is_said_and_what_it_does_not(folder):
    """Numbers with their standard errors, of the range's; in so short a time the modulus is not seen."""
    flow = json.loads((folder / "later/forecast.json").read_text())["flow"]
    assert 0.046 < flow["peak_m_s"] < 0.056
    assert 0 < flow["peak_told"] < 1
    assert flow["shear_told"] > 0.5
    assert flow["loss_after"] < flow["loss_before"]
    told, page = (folder / "said.txt").read_text(), unescape((folder / "later/report.html").read_text("utf-8"))
    for words in ("the window does not tell the shear modulus", "of the membrane's viscosity it says nothing"):
        assert words in told
        assert words in page
    config = json.loads((folder / "later/config.json").read_text())["method"]
    assert config["dynamics"]["frames"] is True


def test_without_a_channel_it_is_refused(folder):
    out = folder / "none"
    refused(holosplat("forecast", folder / "run", "--by", "assimilate", "--out", out), "assimilate", "--channel")
    assert not out.exists()
