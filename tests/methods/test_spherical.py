"""Spherical matter: its derivatives, a shock in three beams, and matter that is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.checks import InputError
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS, SmoothVolume, Task, contrast
from holosplat.methods.contrast import BELOW, BOTH, SPHERICAL, _refuted, decide_sides, with_sign, with_usual_steps
from holosplat.methods.illumination import prepared
from holosplat.methods.method import first_of_task
from holosplat.methods.spherical import AXES, WORTH, Sphere, SphericalFit, SphericalMatter
from holosplat.methods.volume import SmoothStage
from holosplat.optics.background import LightOptions
from holosplat.optics.noise import NoiseModel
from holosplat.scan import Exposures, Scan
from holosplat.series.plan import prior_of
from holosplat.specimens import Substances
from holosplat.specimens.continuous import ContinuousScene, Soft, ellipsoid
from holosplat_bench.specimens.fluids import Shock
from holosplat_bench.specimens.gas_waves import ExpandingShock

WATER = DeltaBeta(5.75e-7, 2.56e-10)
PIXEL, SHAPE, PHOTONS = 1.4e-6, (33, 37), 3000.0
VIEWS = Views.from_angles([0.0, 60.0, 120.0], SHAPE, PIXEL)
SPHERE = MaterialPrior.of_ratio(WATER.ratio).on_both_sides().about_a_point()
PLAIN = LightOptions("even", still="none", noise="white")


def of(scene: hs.volume.Object, views: Views = VIEWS) -> Scan:
    exposures = Exposures.of(views, 20.0, 0.2)
    return hs.simulate(scene, exposures, photons_per_pixel=PHOTONS, seed=5, is_test=np.zeros(len(views), dtype=bool))


@pytest.fixture(scope="module")
def shock() -> ContinuousScene:
    found = ExpandingShock(38e-6, shift=0.1).drawn(Substances(WATER, medium=WATER), 4).scene.at(0.7)
    assert isinstance(found, ContinuousScene)
    return found


@pytest.fixture(scope="module")
def scan(shock) -> Scan:
    return of(shock)


def sphere_of(scan: Scan, start: torch.Tensor) -> Sphere:
    return Sphere(WhitenedFrames(scan, WATER, NoiseModel.white_only(torch.full((3,), 0.02), SHAPE)), start)


@pytest.mark.parametrize("source", [None, 70e-6], ids=["parallel", "cone"])
def test_line_integrals_are_those_of_a_quadrature(source):
    """Of a random profile, on pixels of two sizes and detectors that are shifted; derivatives beside differences."""
    turns, shifts = hs.Views.from_angles([10.0, 70.0], (11, 15), PIXEL).rotations, np.array([[0.3, -0.2], [0.0, 0.5]])
    sources = None if source is None else np.array([source, 1.2 * source])
    views = Views(turns, PIXEL * shifts, (11, 15), PIXEL, np.array([1.0, 1.2]), sources)
    values, spacing = torch.from_numpy(np.random.default_rng(0).normal(size=5)), 1.1 * PIXEL
    matter = SphericalMatter(PIXEL * np.array([0.7, -1.2, 2.1]), spacing, values, WATER)
    found, at = matter.project(views), np.linspace(-25, 25, 20001) * PIXEL
    for v, pixel in enumerate(views.pixel_sizes):
        for row, column in ((5, 7), (3, 8), (6, 5)):
            place = np.array([(column - 7) * pixel, (row - 5) * pixel, 0.0]) + [*views.shifts[v], 0.0]
            way = np.array([0.0, 0.0, 1.0]) + (0 if sources is None else [*place[:2] / sources[v], 0.0])
            points = place + at[:, None] * way / np.linalg.norm(way) - turns[v] @ matter.centre
            radii = np.linalg.norm(points, axis=1) / spacing
            wanted = np.interp(radii, np.arange(6), [*values.tolist(), 0.0]).sum() * (at[1] - at[0])
            assert float(found.channels[v, 0, row, column]) == pytest.approx(wanted, abs=1e-5 * PIXEL)
    assert found.materials == (WATER,)

    def lines(number: int, step: float) -> torch.Tensor:
        moved = torch.zeros(AXES + len(values), dtype=torch.float64)
        moved[number] = step
        centre = matter.centre + spacing * moved[:AXES].numpy()
        return SphericalMatter(centre, spacing, values + moved[AXES:], WATER).lines(views).double()

    for number, slope in enumerate(matter.slopes(views)):
        wanted = (lines(number, 1e-3) - lines(number, -1e-3)) / 2e-3
        assert float((wanted - slope).norm() / wanted.norm()) < 2e-3


def test_voxels_hold_the_profile_and_its_integral():
    grid = Grid.centred((27, 25, 23), PIXEL)
    unknowns = torch.tensor([11.2, 12.4, 13.1, 0.4, 1.0, -0.7, 0.2, 0.6, 0.0], dtype=torch.float64)
    centre = np.array(grid.origin) + PIXEL * unknowns[:AXES].flip(0).numpy()
    matter = SphericalMatter(centre, PIXEL, unknowns[AXES:], WATER)
    fine = matter.voxelise(Grid.centred((135, 125, 115), PIXEL / 5)).delta / WATER.delta
    assert Sphere.sum_of(unknowns) == pytest.approx(float(fine.sum()) / 125, rel=2e-3)
    assert float(matter.voxelise(grid).beta.sum() / WATER.beta) == pytest.approx(float(fine.sum()) / 125, rel=0.2)


def test_a_total_that_is_told_counts_by_its_error(scan, shock):
    """Frames tell the total of a profile badly: a sure one is taken, and one that is not sure changes nothing."""
    truth = torch.from_numpy(shock.voxelise(Grid.of_views(VIEWS)).delta / WATER.delta).float()
    whitened = WhitenedFrames(scan, WATER, NoiseModel.white_only(torch.full((3,), PHOTONS**-0.5), SHAPE))
    sums = list[float]()
    for told in (None, (300.0, 1e6), (300.0, 1e-2)):
        sphere = Sphere(whitened, truth, told=told)
        while not sphere.ended:
            sphere.step()
        sums.append(Sphere.sum_of(sphere.unknowns))
    error = Sphere(whitened, truth).errors()[0]
    assert sums[1] == pytest.approx(sums[0], abs=0.05 * error)
    assert sums[2] == pytest.approx(300.0, abs=0.1)
    assert abs(sums[0] - float(truth.double().sum())) < 4 * error
    assert error > 50 > 10 * Sphere(whitened, truth, told=(300.0, 5.0)).errors()[0] / 2


def test_a_total_is_told_of_spherical_matter_alone(scan):
    task = Task(scan, MaterialPrior.of_ratio(WATER.ratio).on_both_sides(), matter="continuous", light=PLAIN)
    stage = SmoothStage(SmoothVolume(known_total=(0.0, 1e-24)))
    with pytest.raises(InputError, match="known_total is of spherical matter"):
        stage.fit(task, stage.start(task, None))
    for told in ((1.0,), (1.0, 0.0)):
        with pytest.raises(InputError, match="known_total must be a total and its positive standard error"):
            SmoothVolume(known_total=told)


def test_a_sphere_that_has_left_the_field_ends(scan):
    """As in uneven light, which matter on one side cannot explain; a run ended in a singular matrix there. Above all
    frames, for far along one view's beam it would still cast its shadow there."""
    sphere = sphere_of(scan, torch.zeros(SHAPE[1], *SHAPE))
    sphere.unknowns[1] = 900.0
    sphere.step()
    assert sphere.ended
    assert not sphere.matter().voxelise(sphere.grid).delta.any()


def test_steps_of_what_is_no_sphere_end_by_what_they_leave(monkeypatch):
    """Cells leave far more than noise, and so much is gained on the way that the gain alone would not end the steps."""
    cells = hs.specimens.random_cells(3, (30e-6, 20e-6, 30e-6), 3, 9e-6)
    sphere = sphere_of(of(hs.MeshScene.of_one_material(cells, WATER)), torch.zeros(SHAPE[1], *SHAPE))
    values, cut = [sphere.value], Sphere._cut
    monkeypatch.setattr(Sphere, "_cut", lambda self, *how: values.append(self.value) or cut(self, *how))
    while not sphere.cut:
        values = [sphere.value]
        sphere.step()
    before, after = values
    left = 2 * after / sphere.frames.measured.numel()
    assert left > 2
    assert WORTH < before - after < WORTH * left


def test_a_shock_is_found_in_three_beams(scan, shock):
    """As voxels of any kind it is not: nine tenths of the field are free then."""
    done = hs.reconstruct(scan, SPHERE, SmoothVolume(), light=PLAIN)
    truth = shock.voxelise(Grid.of_views(VIEWS)).delta
    found = done.object.voxelise(Grid.of_views(VIEWS)).delta
    assert np.linalg.norm(found - truth) < 0.25 * np.linalg.norm(truth)
    assert done.verdict is not None
    assert done.verdict.good
    assert done.total is not None
    assert done.total.error is not None
    assert abs(done.total.held - float(truth.sum()) * PIXEL**3) < 4 * done.total.error
    any_kind = hs.reconstruct(scan, MaterialPrior.of_ratio(WATER.ratio).on_both_sides(), SmoothVolume(), light=PLAIN)
    other = any_kind.object.voxelise(Grid.of_views(VIEWS)).delta
    assert np.linalg.norm(other - truth) > 2 * np.linalg.norm(found - truth)


def test_spherical_matter_is_taken_where_it_predicts_unseen_frames(scan):
    """And a run that goes on keeps it."""
    task = prepared(Task(scan, MaterialPrior.of_ratio(WATER.ratio), light=PLAIN), SmoothVolume())
    assert task.decisions[-1].choice == SPHERICAL
    assert task.prior.spherical
    other = prepared(Task(scan, MaterialPrior.of_ratio(WATER.ratio), light=PLAIN), METHODS["voxels"])
    assert not other.prior.spherical
    assert with_sign(MaterialPrior.of_ratio(WATER.ratio), task.decisions).spherical
    assert task.first is not None
    before = (tuple(task.first.taken), task.decisions)
    again = prepared(Task(scan, MaterialPrior.of_ratio(WATER.ratio), light=PLAIN), SmoothVolume(), before)
    assert again.prior == task.prior


def test_a_shock_is_found_in_two_beams(shock):
    """No view is set aside there, and its few unknowns explain as much as a free volume."""
    scan = of(shock, Views.from_angles([0.0, 90.0], SHAPE, PIXEL))
    done = hs.reconstruct(scan, MaterialPrior.of_ratio(WATER.ratio), light=PLAIN)
    truth = shock.voxelise(Grid.of_views(VIEWS)).delta
    assert [each.choice for each in done.choice.decisions].count(SPHERICAL) == 1
    assert np.linalg.norm(done.object.voxelise(Grid.of_views(VIEWS)).delta - truth) < 0.25 * np.linalg.norm(truth)


def test_radii_beyond_the_front_are_left_out(scan):
    """Of 22 values, those that frames do not tell from 0; the front is at some 15 voxels."""
    task = Task(scan, SPHERE, matter="continuous", light=PLAIN)
    stage = SmoothStage(SmoothVolume())
    fit = stage.fit(task, stage.start(task, None))
    fit.run(lambda record: None)
    assert isinstance(fit, SphericalFit)
    assert 13 <= fit.resolved()["radii"] <= 18
    values = fit.voxels.values[0]
    z, y, x = np.indices(values.shape)
    away = np.linalg.norm(np.stack([z, y, x]) - fit._sphere.unknowns[:AXES].numpy()[:, None, None, None], axis=0)
    assert not values[away > 19].any()
    assert values[away < 13].any()


def test_what_other_matter_predicts_better_from_the_same_views_is_refuted(scan, monkeypatch):
    """Not a shock; but two holes that are taken for one sphere. What is refuted is not taken."""
    prior = MaterialPrior.of_ratio(WATER.ratio)
    lumps = [
        ellipsoid(1e-6 * np.array(at), (6e-6,) * 3, Soft(0.3), DeltaBeta(-4e-7, -1.8e-10))
        for at in ([-8, 1, 3], [9, -4, -2])
    ]
    for given, refuted in ((scan, False), (of(ContinuousScene(tuple(lumps))), True)):
        first = first_of_task(Task(given, prior.signed(-1)))
        two = with_usual_steps(first, first.prior.on_both_sides())
        sphere = replace(two, prior=two.prior.about_a_point(), _made={})
        assert _refuted({SPHERICAL: sphere, BELOW: first, BOTH: two}, PLAIN, ()) is refuted
    monkeypatch.setattr(contrast, "_refuted", lambda *_: True)
    assert decide_sides(first_of_task(Task(scan, prior)), PLAIN)[1].choice != SPHERICAL


def test_a_sharp_front_without_noise_is_not_refuted():
    """A free volume may explain what samples leave of a front; lines of voxels left more than that."""
    views = Views.evenly_spaced(12, (96, 96), 1e-6)
    shock = Shock(76.8e-6, bubble=0.0).drawn(Substances(WATER, medium=WATER), 103).scene
    scan = hs.simulate(shock, Exposures.of(views, 20.0, 0.1), seed=5, is_test=np.zeros(12, dtype=bool))
    first = first_of_task(Task(scan, MaterialPrior.of_ratio(WATER.ratio)))
    assert decide_sides(first, PLAIN)[1].choice == SPHERICAL


@pytest.mark.parametrize("angles", [(0.0, 60.0, 120.0), (0.0, 90.0), (0.0,)], ids=["3 views", "2 views", "1 view"])
@pytest.mark.parametrize(("flat", "count"), [(1.0, 2), (0.8, 1), (1.0, 1)])
def test_matter_that_is_no_sphere_or_on_one_side_is_left_alone(flat, count, angles):
    """Two soft holes, one that is flattened by a fifth, and one that is a sphere of one side."""
    first = ellipsoid(np.array([-2e-6, 1e-6, 3e-6]), (9e-6, 9e-6 * flat, 9e-6), Soft(0.3), DeltaBeta(-4e-7, -1.8e-10))
    other = ellipsoid(np.array([9e-6, -4e-6, -2e-6]), (5e-6,) * 3, Soft(0.3), DeltaBeta(-4e-7, -1.8e-10))
    scene = ContinuousScene((first, other)[:count])
    scan = of(scene, Views.from_angles(list(angles), SHAPE, PIXEL))
    holes = first_of_task(Task(scan, MaterialPrior.of_ratio(WATER.ratio).signed(-1)))
    found, decision = decide_sides(holes, PLAIN)
    assert decision.choice == BELOW
    assert found is holes


def test_a_fit_goes_on_where_it_was(scan):
    task = Task(scan, SPHERE, matter="continuous", light=PLAIN)
    stage = SmoothStage(SmoothVolume())
    start = stage.start(task, None)
    whole, part, rest = (stage.fit(task, start) for _ in range(3))
    assert isinstance(whole, SphericalFit)
    whole.run(lambda record: None)
    part.run(lambda record: None, until=2)
    assert not part.finished
    rest.load(part.state_dict())
    rest.run(lambda record: None)
    first, second = (fit.result().object.voxelise(Grid.of_views(VIEWS)).delta for fit in (whole, rest))
    assert np.array_equal(first, second)


def test_what_is_told_is_kept_in_files():
    for prior in (MaterialPrior.unknown(-1), MaterialPrior.of_ratio(900.0), MaterialPrior.known(WATER)):
        assert prior.about_a_point().on_both_sides() == prior.on_both_sides().about_a_point() != prior.on_both_sides()
        for told in (prior.about_a_point(), prior.about_a_point().on_both_sides()):
            assert told.spherical
            assert prior_of(told.as_dict()) == told
            assert told.with_ratio(700.0).spherical
    with pytest.raises(InputError, match="must be of one material"):
        MaterialPrior.known(WATER, DeltaBeta(1e-7, 1e-10)).about_a_point()
