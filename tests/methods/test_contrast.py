"""Holes in a medium: taken where they predict unseen frames better than bodies, and found by methods as bodies are."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.inference import Score
from holosplat.materials import parse_material
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS, PerView, Task
from holosplat.methods.contrast import ABOVE, BELOW, BY_FITTED, decide_sign, without_matter
from holosplat.methods.contrast import STAGE as SIGN
from holosplat.methods.cross_validation import BY_FISSION
from holosplat.methods.illumination import _fitted, _scores, prepared
from holosplat.methods.method import first_of_task
from holosplat.methods.trials import WITHOUT
from holosplat.metrics import volume_scores
from holosplat.optics.background import LightOptions
from holosplat.scan import Exposures, Scan
from holosplat.specimens import MeshScene, Substances
from holosplat.specimens.red_cells import random_cells
from holosplat.workflows.preconditions import decisions_of
from holosplat.workflows.totals import TotalMatter
from holosplat_bench.specimens.matter import MATTER
from holosplat_bench.specimens.rods import RodScene, random_bubbles

AIR_IN_WATER = DeltaBeta(-5.75e-7, -2.56e-10)
PIXEL, SHAPE, VIEWS = 1e-6, (35, 42), 8


def of(scene, photons: float | None = None) -> Scan:
    views = Views.evenly_spaced(VIEWS, SHAPE, PIXEL)
    is_test = np.arange(VIEWS) == 3
    return simulate(scene, Exposures.of(views, 20.0, 0.1), photons_per_pixel=photons, seed=3, is_test=is_test)


@pytest.fixture(scope="module")
def bubbles() -> RodScene:
    return random_bubbles(4, (3e-6, 6e-6), (34e-6, 30e-6, 34e-6), AIR_IN_WATER, 5)


@pytest.fixture(scope="module")
def holes(bubbles) -> Scan:
    return of(bubbles, 5000)


@pytest.fixture(scope="module")
def cells() -> Scan:
    matter = DeltaBeta(4e-7, 4e-7 / 1500)
    return of(MeshScene.of_one_material(random_cells(3, (34e-6, 30e-6, 34e-6), 5, 12e-6), matter), 5000)


@pytest.mark.parametrize("prior", [MaterialPrior.unknown(), MaterialPrior.of_ratio(AIR_IN_WATER.ratio)])
def test_holes_are_taken_where_they_predict_unseen_frames(prior, holes):
    """And what is decided later is decided of holes; the run's folder keeps it."""
    task = prepared(Task(holes.train(), prior))
    (sign,) = (each for each in task.decisions if each.name == SIGN)
    assert sign.choice == BELOW
    assert sign.compared[0].gain > 0.2
    assert task.prior == prior.signed(-1)
    assert task.first is not None
    assert task.first.material.delta < 0
    assert decisions_of(task)["decisions"][0]["choice"] == BELOW
    again = prepared(Task(holes.train(), prior), before=(tuple(task.first.taken), task.decisions))
    assert again.prior == task.prior
    assert again.decisions == task.decisions


def test_bodies_stay_bodies(cells):
    task = prepared(Task(cells.train(), MaterialPrior.of_ratio(1500)))
    (sign,) = (each for each in task.decisions if each.name == SIGN)
    assert sign.choice == ABOVE
    assert sign.compared[0].loses
    assert task.prior.delta_sign == 1.0


def test_what_is_told_is_not_asked(holes):
    told = Task(holes.train(), MaterialPrior.known(AIR_IN_WATER))
    first = first_of_task(told)

    def asked(volumes, fold, without):
        pytest.fail("a score was asked for")

    assert decide_sign(first, asked, fitted=asked) == (first, ())


def test_a_volume_worse_than_none_does_not_tell_the_sign(cells):
    """Holes that are hardly there leave less than it, and as much as no matter."""
    first = first_of_task(Task(cells.train(), MaterialPrior.of_ratio(1500)))

    def score(volumes, fold: int, without: str) -> Score:
        unseen = first.folds.split(fold)[1]
        left = torch.from_numpy(unseen.frames).double() - 1
        return Score.of(left * (3.0 if volumes is first and not without else 1.0))

    assert decide_sign(first, score, fitted=score)[1][0].choice == ABOVE


@pytest.mark.parametrize(
    ("unseen", "fitted", "choice"),
    [
        ((1.0, 1.0), (0.5, 0.9), BELOW),  # unseen views leave it open
        ((1.5, 1.0), (0.5, 0.9), ABOVE),  # holes predict less than no matter
        ((1.0, 1.0), (0.9, 0.5), ABOVE),
        ((1.0, 1.0), (1.0, 1.5), ABOVE),  # neither is matter
    ],
)
def test_where_unseen_views_leave_the_sign_open_fitted_ones_compare_it(cells, unseen, fitted, choice):
    """What is left by holes and by bodies, over what is left without matter."""
    first = first_of_task(Task(cells.train(), MaterialPrior.of_ratio(1500)))

    def score(left: tuple[float, float], volumes, fold: int, without: str) -> Score:
        frames = torch.from_numpy(first.folds.split(fold)[1].frames).double() - 1
        return Score.of(frames * (1.0 if without else left[volumes.prior.sign == 0]))

    found, decisions = decide_sign(first, partial(score, unseen), fitted=partial(score, fitted))
    assert decisions[0].choice == choice
    assert found.prior.sign == (-1 if choice == BELOW else 0)
    halves = replace(first, folds=replace(first.folds, count=1, by=BY_FISSION))
    assert decide_sign(halves, partial(score, unseen), fitted=partial(score, fitted))[1][0].choice == ABOVE


def test_fitted_frames_are_those_that_volumes_were_made_of(cells):
    first = first_of_task(Task(cells.train(), MaterialPrior.of_ratio(1500)))
    kept, aside = len(first.folds.kept(0)), len(first.folds.aside(0))
    assert kept != aside
    assert (without_matter(first, 0).frames, without_matter(first, 0, fitted=True).frames) == (aside, kept)
    none = _fitted(LightOptions(), first, 0, WITHOUT)
    assert np.allclose(none.powers, without_matter(first, 0, fitted=True).powers)
    assert _fitted(LightOptions(), first, 0, "").gain_over(none)[0] > 0.5


def test_a_crack_is_a_hole_that_fitted_frames_tell():
    """Of a thin crack through the field, which views along it show."""
    kind = MATTER["crack"](44e-6)
    air, medium = (parse_material(name).delta_beta(20.0) for name in ("air", "PMMA"))
    drawn = kind.drawn(Substances(air, None, medium), 3)
    views = Views.evenly_spaced(8, shape=(44, 44), pixel_size=PIXEL)
    scan = simulate(
        drawn.scene, Exposures.of(views, 20.0, 0.1), photons_per_pixel=1000.0, seed=1, is_test=np.zeros(8, bool)
    )
    task = Task(scan, MaterialPrior.unknown())
    how = {"fitted": partial(_fitted, task.light)}
    _, (decision,) = decide_sign(first_of_task(task), *_scores(task.light), **how)
    assert (decision.choice, decision.by) == (BELOW, BY_FITTED)


@pytest.mark.parametrize("name", ["tikhonov-tv", "ctf-tv", "holographic-tv"])
def test_methods_find_bubbles_in_water_that_fills_the_field(name, bubbles, holes):
    prior = MaterialPrior.known(AIR_IN_WATER, medium="water")
    truth = bubbles.voxelise(Grid.of_views(holes.views))
    done = hs.reconstruct(holes, prior, METHODS[name])
    found = done.object.voxelise(truth.grid)
    scores = volume_scores(found, truth)
    assert scores.dice > 0.85
    assert scores.relative_error_delta < 0.35
    assert found.delta.max() <= 0
    said = hs.evaluate(done, holes, truth)
    assert said.material.delta == pytest.approx(AIR_IN_WATER.delta)
    assert any("against water" in line and "-5.75" in line for line in said.lines())
    assert any(line.startswith("against water: δ and β are differences") for line in done.choice.lines())
    assert done.total is not None
    assert total_of(done.total) / float(truth.delta.sum() * PIXEL**3) == pytest.approx(1.0, abs=0.2)
    assert "total δ against water -" in done.total.words


def total_of(total: TotalMatter) -> float:
    assert total.value is not None
    return total.value


def test_light_that_a_medium_dims_is_no_matter(bubbles, unjudged_runs):
    """Frames over flat fields without the water: its even absorption is in no difference, and counts as light."""
    scan = of(bubbles)
    truth = bubbles.voxelise(Grid.of_views(scan.views))
    dimmed = hs.Scan(0.9 * scan.frames, scan.exposures, scan.is_test)
    done = hs.reconstruct(dimmed, MaterialPrior.known(AIR_IN_WATER, medium="water"), PerView())
    assert volume_scores(done.object.voxelise(truth.grid), truth).dice > 0.9


def test_uneven_light_does_not_hide_the_sign(bubbles):
    """A slope of a tenth across frames leaves more of them than matter does, until both sides may have it."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / np.array(SHAPE)[:, None, None] - 0.5
    draws = np.random.default_rng(2).normal(size=(VIEWS, 2))
    slopes = np.stack([1 + 0.1 * (a * x + b * y) for a, b in draws])
    scan = of(bubbles, 1e5)
    prior = MaterialPrior.of_ratio(AIR_IN_WATER.ratio)
    task = prepared(Task(hs.Scan(scan.frames * slopes, scan.exposures, scan.is_test).train(), prior))
    assert task.prior.sign == -1
    assert task.uneven is not None
