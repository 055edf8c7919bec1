"""4D-Var on manufactured holograms: the loss's gradient through waves, surfaces and steps, and a first state found."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import holosplat as hs
from holosplat.checks import InputError
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.metrics.volumes import normal_distance
from holosplat.motion.assimilate import Assimilation, _Fit, assimilate
from holosplat.motion.cell_model import CellModel, ChannelFrame
from holosplat.motion.membrane_fit import Unknowns
from holosplat.specimens.red_cells import RedCell, icosphere

MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
SPHERE, FACES = icosphere(2)
CELL = TriangleMesh(RedCell().surface(SPHERE) + np.array([3e-6, 0, -1e-6]), FACES)
TIMES = np.array([0.0, 3e-6])
OPTIONS = Assimilation((0.046, 0.056), steps=4, curvature=False)


@cache
def experiment() -> tuple[CellModel, hs.Scan]:
    """A cell that the model itself moves for one step, and its frames from two sides."""
    model = CellModel(ChannelFrame((22e-6, 17e-6)), [CELL], 5e-6, 1.2e-3, 3)
    (way,) = model.run([CELL], TIMES, Unknowns.of(0.05, 5e-6))
    views = hs.Views.from_angles(np.array([0.0, 90.0]), (21, 27), 0.7e-6)
    exposures = hs.Exposures.of(views, 20.0, 0.05).repeated(TIMES)
    scenes = [hs.MeshScene.of_one_material([TriangleMesh(at, FACES)], MATERIAL) for at in way]
    frames = [hs.simulate(scene, exposures[[2 * k, 2 * k + 1]]).frames for k, scene in enumerate(scenes)]
    return model, hs.Scan(np.concatenate(frames), exposures, np.zeros(4, dtype=bool))


def off(shift: float) -> TriangleMesh:
    return TriangleMesh(CELL.vertices + shift * np.array([1.0, 0.5, -1.0]), FACES)


def test_the_gradient_is_the_slope_of_the_loss():
    """Along the gradient, against finite differences, which are as rough as pixels' lines are."""
    model, scan = experiment()
    fit = _Fit.of(scan, model, [off(0.1e-6)], Matter.one(*MATERIAL), OPTIONS)
    at = np.zeros(fit.size)
    gradient = fit(at)[1]
    way = 0.2 * gradient / np.linalg.norm(gradient)
    slope = (fit(at + way)[0] - fit(at - way)[0]) / 0.4
    assert slope == pytest.approx(np.linalg.norm(gradient), rel=0.1)


def test_frames_tell_where_a_cell_began():
    model, scan = experiment()
    start = off(0.15e-6)
    found = assimilate(scan, model, [start], Matter.one(*MATERIAL), OPTIONS)
    assert found.losses[1] < 0.5 * found.losses[0]
    assert normal_distance(found.meshes[0], CELL) < 0.6 * normal_distance(start, CELL)
    assert found.places[0].shape == (2, len(SPHERE), 3)
    assert found.places[0][0] == pytest.approx(found.meshes[0].vertices)


def test_what_cannot_be_fitted_is_refused():
    model, scan = experiment()
    with pytest.raises(InputError, match="two times"):
        assimilate(scan[:2], model, [CELL], Matter.one(*MATERIAL), OPTIONS)
    with pytest.raises(InputError, match="LOW:HIGH"):
        Assimilation((0.06, 0.05))
