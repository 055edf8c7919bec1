"""Continuous matter on both sides of its medium: found, decided for, told, and refused where it cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.baselines.material import estimate_delta
from holosplat.checks import InputError
from holosplat.cli.options import PriorOptions
from holosplat.geometry import Grid, Views
from holosplat.inference import Score
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS, SmoothVolume, Task
from holosplat.methods.contrast import ABOVE, BOTH, decide_sides
from holosplat.methods.contrast import STAGE as SIGN
from holosplat.methods.illumination import decided, prepared
from holosplat.methods.method import first_of_task
from holosplat.methods.start import starting_cloud
from holosplat.methods.trials import WITHOUT, Trials
from holosplat.optics.background import LightOptions
from holosplat.optics.retrieval import RETRIEVALS, tikhonov
from holosplat.scan import Exposures, Scan
from holosplat.series.plan import prior_of
from holosplat.specimens.continuous import ContinuousScene, Soft, ellipsoid
from holosplat.specimens.red_cells import random_cells

WATER = DeltaBeta(5.75e-7, 2.56e-10)
DENSE, THIN = DeltaBeta(0.4 * WATER.delta, 0.4 * WATER.beta), DeltaBeta(-WATER.delta, -WATER.beta)
PIXEL, SHAPE, VIEWS = 1.25e-6, (27, 33), 9


FINE, COARSE = Views.evenly_spaced(VIEWS, SHAPE, PIXEL), Views.evenly_spaced(5, (15, 19), 2e-6)


def of(scene, photons: float | None = None, views: Views = FINE) -> Scan:
    exposures, held_out = Exposures.of(views, 20.0, 0.15), np.zeros(len(views), dtype=bool)
    return hs.simulate(scene, exposures, photons_per_pixel=photons, seed=3, is_test=held_out)


@pytest.fixture(scope="module")
def pair() -> ContinuousScene:
    """A denser soft ball, and a hole with a sharp edge."""
    dense = ellipsoid(np.array([-8e-6, 1e-6, 3e-6]), (7e-6,) * 3, Soft(0.5), DENSE)
    return ContinuousScene((dense, ellipsoid(np.array([8e-6, -2e-6, -2e-6]), (5e-6,) * 3, Soft(0.0), THIN)))


@pytest.fixture(scope="module")
def scan(pair) -> Scan:
    return of(pair)


@pytest.fixture(scope="module")
def bodies() -> Scan:
    matter = DeltaBeta(4e-7, 4e-7 / 1500)
    return of(hs.MeshScene.of_one_material(random_cells(3, (32e-6, 28e-6, 32e-6), 5, 12e-6), matter), 5000)


def test_retrieval_finds_thickness_of_both_signs(pair, scan):
    """Of one sign, what is denser is lost behind the bound or the hole is."""
    frames = torch.from_numpy(scan.frames).double()
    both, one = (tikhonov(frames, scan.exposures, *WATER, two_sided=sides) for sides in (True, False))
    lines = lines_of(pair, scan)
    error = {name: float((found - lines).norm() / lines.norm()) for name, found in (("both", both), ("one", one))}
    assert error["both"] < 0.25
    assert error["one"] > 0.5
    assert float(one.min()) == 0


@pytest.mark.parametrize("name", RETRIEVALS)
def test_every_retrieval_has_thickness_of_both_signs(name, pair, scan):
    frames = torch.from_numpy(scan.frames)[:2]
    found = RETRIEVALS[name](frames, scan.exposures[np.arange(2)], *WATER, two_sided=True).double()
    lines = lines_of(pair, scan)[:2]
    assert float((found - lines).norm() / lines.norm()) < 0.4
    assert float(found.min()) < 0.5 * float(lines.min())


def lines_of(pair: ContinuousScene, scan: Scan) -> torch.Tensor:
    """Thickness [V, H, W] of water, in metres."""
    return pair.project(scan.exposures.views)[1].double() / WATER.delta


@pytest.mark.parametrize("two_sided", [True, False])
def test_first_volumes_have_the_sides_that_they_may_have(two_sided, scan, pair):
    how = HolographicTV(retrieval=20, iterations=80, corrections=0, upper=0.0, refine=1, two_sided=two_sided)
    values, grid = holographic_tv(scan, WATER, how, lambda stage, share: None)
    true = pair.voxelise(grid).delta / WATER.delta
    error = float(np.linalg.norm(values.numpy() - true) / np.linalg.norm(true))
    assert (error < 0.5) == two_sided
    assert (float(values.min()) < -0.5) == two_sided


def test_the_smooth_volume_finds_both_sides(scan, pair):
    prior = MaterialPrior.of_ratio(WATER.ratio).on_both_sides()
    light = LightOptions("even", still="none", noise="white")
    done = hs.reconstruct(scan, prior, SmoothVolume(), light=light)
    truth = pair.voxelise(Grid.of_views(scan.views))
    found = done.object.voxelise(truth.grid).delta
    assert np.linalg.norm(found - truth.delta) < 0.2 * np.linalg.norm(truth.delta)
    assert found.min() < 0.8 * truth.delta.min()
    assert found.max() > 0.8 * truth.delta.max()
    assert done.choice.kept == "smooth volume"  # and not the start, which has both sides as well
    assert done.total is not None
    assert done.total.value is None
    assert "on both sides no error is known" in done.total.words


STEPS = {"neural-field": 0.3, "gaussians": 0.3, "voxels": 0.3}
"""Share of the usual steps."""


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("holographic-tv", 0.12),
        ("voxels", 0.12),
        ("neural-field", 0.4),
        ("gaussians", 0.12),
        ("tikhonov-tv", 0.12),
        ("ctf-tv", 0.17),
        ("paganin-tv", 0.2),
        ("paganin-fbp", 0.37),
        ("paganin-sirt", 0.35),
    ],
)
def test_every_method_of_continuous_matter_finds_both_sides(name, most, scan, pair, unjudged_runs):
    scan = of(pair, views=COARSE) if name == "neural-field" else scan  # whose samples take long
    method = METHODS[name].with_effort(STEPS.get(name, 1.0))
    light = LightOptions("even", still="none", noise="white")
    found = hs.reconstruct(scan, MaterialPrior.known(THIN, medium="water").on_both_sides(), method, light=light)
    truth = pair.voxelise(Grid.of_views(scan.views))
    delta = found.object.voxelise(truth.grid).delta
    assert np.linalg.norm(delta - truth.delta) < most * np.linalg.norm(truth.delta)
    assert delta.min() < 0.8 * truth.delta.min()
    assert delta.max() > 0.8 * truth.delta.max()


def test_noise_on_both_sides_is_not_taken_for_the_level_of_a_small_hole(pair):
    """All over the field it has more mass."""
    noisy = of(ContinuousScene(pair.elements[1:]), 3000)
    found = estimate_delta(noisy, WATER.ratio, lambda stage, share: None, two_sided=True)
    assert 0.4 * WATER.delta < found < 1.2 * WATER.delta


def test_gaussians_are_of_the_sides_that_a_start_finds(pair):
    """Where it finds nothing below the medium, no Gaussians are made of it; at random they are of both."""
    scan = of(ContinuousScene(pair.elements[:1]))
    task = Task(scan, MaterialPrior.known(DENSE).on_both_sides(), matter="continuous")
    method = METHODS["gaussians"]
    assert isinstance(method, hs.Gaussians)
    clouds = [starting_cloud(task, replace(method, start=start, filled=0.3)) for start in ("phase", "random")]
    assert [len(cloud.matter) for cloud in clouds] == [1, 2]
    assert clouds[1].matter.delta == -clouds[1].matter.channels[1].delta
    with pytest.raises(InputError, match="δ and β apart lie on one side of their medium"):
        starting_cloud(Task(scan, MaterialPrior.unknown().on_both_sides()), replace(method, separate=True))


def test_both_sides_are_taken_where_they_predict_unseen_frames(scan):
    first = first_of_task(Task(scan, MaterialPrior.of_ratio(WATER.ratio).signed(-1)))
    found, decision = decide_sides(first, LightOptions())
    assert decision.name == SIGN
    assert decision.choice == BOTH
    assert found.prior.two_sided
    assert found.prior.sign == -1


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_side_that_is_told_is_kept(scan, sign):
    told = MaterialPrior.of_ratio(WATER.ratio).signed(sign)
    assert prepared(Task(scan, told), SmoothVolume()).prior == told


def test_a_run_that_goes_on_keeps_both_sides(scan):
    task = prepared(Task(scan, MaterialPrior.of_ratio(WATER.ratio)), SmoothVolume())
    assert task.prior.two_sided
    assert task.first is not None
    again = prepared(
        Task(scan, MaterialPrior.of_ratio(WATER.ratio)), SmoothVolume(), (tuple(task.first.taken), task.decisions)
    )
    assert (again.prior, again.decisions) == (task.prior, task.decisions)


def test_bodies_of_one_side_stay_there(bodies):
    """Cells in air, in noise: a family that the rule was not made on."""
    first = first_of_task(Task(bodies, MaterialPrior.of_ratio(1500).signed(1)))
    found, decision = decide_sides(first, LightOptions())
    assert decision.choice == ABOVE
    assert found is first


def test_methods_of_one_side_refuse_both(bodies):
    prior = MaterialPrior.of_ratio(1500).on_both_sides()
    with pytest.raises(InputError, match="is continuous, but the method is surfaces, whose matter lies on one"):
        hs.reconstruct(bodies, prior, METHODS["surfaces"])


def test_sides_are_no_option_of_a_method(bodies):
    by_hand = SmoothVolume(volume=HolographicTV(two_sided=True))
    with pytest.raises(InputError, match=r"volume.two_sided must be false, for --contrast says"):
        hs.reconstruct(bodies, MaterialPrior.of_ratio(1500), by_hand)


def test_what_is_told_is_kept_in_files():
    for prior in (
        MaterialPrior.unknown(),
        MaterialPrior.of_ratio(900.0, -1),
        MaterialPrior.known(THIN, medium="water"),
    ):
        both = prior.on_both_sides()
        assert both.two_sided
        assert prior_of(both.as_dict()) == both
        assert prior_of(prior.as_dict()) == prior
    with pytest.raises(InputError, match="must be of one --material"):
        MaterialPrior.known(WATER, DENSE).on_both_sides()


def test_the_command_line_tells_the_side():
    ratio = PriorOptions(delta_beta=2250.0)
    assert replace(ratio, contrast="both").prior(20.0).two_sided
    assert [replace(ratio, contrast=side).prior(20.0).sign for side in ("auto", "above", "below")] == [0, 1, -1]
    told = PriorOptions(material=("air",), medium="water")
    assert replace(told, contrast="both").prior(20.0).two_sided
    assert replace(told, contrast="below").prior(20.0) == told.prior(20.0)
    with pytest.raises(InputError, match="--contrast must be on the side of --material, but it is above"):
        replace(told, contrast="above").prior(20.0)
    several = PriorOptions(material=("air", "glass"), medium="water")
    for one in ("above", "below"):
        with pytest.raises(InputError, match="--contrast must be on the side of --material"):
            replace(several, contrast=one).prior(20.0)
    assert replace(several, contrast="both").prior(20.0) == several.prior(20.0)


@pytest.mark.parametrize(
    ("even", "both", "lit", "chosen"),
    [(2.0, 1.0, 1.0, BOTH), (1.0, 1.0, 1.0, ABOVE), (2.0, 1.0, 0.5, ABOVE), (1.0, 2.0, 2.0, ABOVE)],
)
def test_frames_are_left_alone_where_both_sides_explain_them_as_well(bodies, monkeypatch, even, both, lit, chosen):
    """Light that was taken beside matter of one side stays where it predicts more than matter of both does."""

    def score(trials: Trials, name: str, fold: int) -> Score:
        prior = trials.first.prior
        power = even if prior.spherical else both if prior.two_sided else lit if name == "uneven light" else even
        return Score(np.full((8, 3), 9.0 if WITHOUT in name else power), 2)

    monkeypatch.setattr(Trials, "score", score)
    first = replace(first_of_task(Task(bodies, MaterialPrior.of_ratio(1500).signed(1))), taken=("uneven light",))
    found, decision = decide_sides(first, LightOptions())
    assert decision.choice == chosen
    assert found.prior.two_sided == (chosen == BOTH)
    assert decide_sides(first, LightOptions(), first.taken)[1].choice == ABOVE  # its user says what the light is


@pytest.mark.parametrize(("longer", "chosen"), [(2.0, BOTH), (0.9, ABOVE)])
def test_both_sides_do_not_win_by_their_steps(bodies, monkeypatch, longer, chosen):
    """Matter on one side by as many steps must not predict as well."""
    usual = HolographicTV().iterations

    def score(trials: Trials, name: str, fold: int) -> Score:
        first = trials.first
        one = longer if first.options.iterations == usual else 2.0
        power = 1.0 if first.prior.two_sided and not first.prior.spherical else one
        return Score(np.full((8, 3), 9.0 if WITHOUT in name or first.prior.spherical else power), 2)

    monkeypatch.setattr(Trials, "score", score)
    first = first_of_task(Task(bodies, MaterialPrior.of_ratio(1500).signed(1)))
    assert first.options.iterations < usual
    assert decide_sides(first, LightOptions())[1].choice == chosen


def test_light_that_is_uneven_stays_beside_bodies(bodies):
    """Matter on both sides does not explain what light does."""
    rows, columns = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    pattern = 1 + 0.05 * np.sin(9 * rows + 2) * np.cos(7 * columns + 1)
    lit = replace(bodies, frames=(bodies.frames * pattern).astype(np.float32))
    first = first_of_task(Task(lit, MaterialPrior.of_ratio(1500).signed(1)))
    first.taken, _ = decided(first, LightOptions(), (), ("fixed pattern",))
    assert first.taken
    assert decide_sides(first, LightOptions())[1].choice == ABOVE


def test_methods_of_one_level_refuse_several_materials(bodies):
    """Before anything is computed; those that take several are named."""
    two = MaterialPrior.known(WATER, WATER._replace(delta=0.4 * WATER.delta))
    taking = [name for name, method in METHODS.items() if method.several]
    remedy = f"give one, or take --method {', '.join(taking[:-1])} or {taking[-1]}"
    for method in (one for one in METHODS.values() if not one.several):
        said = rf"--material must be given once for the method {method.kind}, .* it is given 2 times; {remedy}\."
        with pytest.raises(InputError, match=said):
            hs.reconstruct(bodies, two, method, on_progress=lambda *given: pytest.fail("something is computed"))
