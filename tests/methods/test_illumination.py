"""Light, pattern and noise are hypotheses: each is taken where it predicts unseen frames, and not on other families."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from holosplat.baselines import holographic_tv
from holosplat.beamline.light import UnevenLight, correlated_field
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.inference import Decision, Score
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, SmoothVolume, Task, trials
from holosplat.methods.cross_validation import BY_FISSION, BY_VIEWS, FirstVolumes, Folds, plain_light
from holosplat.methods.illumination import STAGE, confirmed, prepared, shows_matter
from holosplat.methods.levels import SHOWN, TrialFits
from holosplat.methods.method import first_of_task
from holosplat.methods.trials import NULL, UNEVEN, WITHOUT, Trials, with_more
from holosplat.optics.background import FLUX, Background, Light, LightOptions
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.specimens.soft_matter import soft_cells
from holosplat.workflows.run_illumination import EVEN, light_options_of

MATTER = DeltaBeta(4e-7, 4e-7 / 1500)
PIXEL, SHAPE, VIEWS = 1.5e-6, (31, 36), 8
PRIOR = MaterialPrior.of_ratio(MATTER.ratio, 1)  # on which side matter lies is for other tests


def of(scene, photons: float | None = None) -> Scan:
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, SHAPE, PIXEL), 20.0, 0.2)
    return simulate(scene, exposures, photons_per_pixel=photons, seed=3, is_test=np.zeros(VIEWS, dtype=bool))


@pytest.fixture(scope="module")
def soft() -> Scan:
    return of(soft_cells(2, (10e-6, 13e-6), (34e-6, 38e-6, 34e-6), MATTER, seed=5, edge=2e-6), 1e5)


@pytest.fixture(scope="module")
def sharp() -> Scan:
    return of(MeshScene.of_one_material(random_cells(3, (34e-6, 36e-6, 34e-6), 5, 12e-6), MATTER), 1e5)


def lit(scan: Scan, factor: np.ndarray) -> Scan:
    return replace(scan, frames=(scan.frames * factor).astype(np.float32))


def uneven() -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / np.array(SHAPE)[:, None, None] - 0.5
    draw = np.random.default_rng(2)
    return np.stack([1 + 0.1 * (a * x + b * y) for a, b in draw.normal(size=(VIEWS, 2))])


def choices(scan: Scan, light: LightOptions | None = None) -> list[str]:
    light = light or LightOptions()
    return [each.choice for each in prepared(Task(scan, PRIOR, light=light)).decisions if each.name == STAGE]


@pytest.mark.parametrize("family", ["soft", "sharp"])
def test_even_light_is_left_alone(family, request):
    task = prepared(Task(request.getfixturevalue(family), PRIOR))
    assert task.uneven is None
    assert task.lit is not None
    assert task.lit.still is None
    assert task.scan is request.getfixturevalue(family)


@pytest.fixture(scope="module", params=["soft", "sharp"])
def in_uneven_light(request) -> tuple[str, Task]:
    scan = lit(request.getfixturevalue(request.param), uneven())
    return request.param, prepared(Task(scan, PRIOR), SmoothVolume())


def test_uneven_light_is_found(in_uneven_light):
    family, task = in_uneven_light
    first = [each for each in task.decisions if each.name == STAGE and each.by == BY_VIEWS]
    assert "uneven light" in first[-1].choice
    assert task.uneven is not None
    if family == "sharp":  # soft matter leaves next to no air, so that the light is known badly, and still is better
        off = task.lit.factor().numpy() / uneven()
        assert float(off.std()) < 0.2 * float(uneven().std())


def test_fits_confirm_uneven_light(in_uneven_light):
    _, task = in_uneven_light
    last = [each for each in task.decisions if each.name == STAGE][-1]
    assert last.by == "views set aside, by fits"
    assert "uneven light" in last.choice


def test_light_is_applied_as_it_was_compared():
    """That of coarse pixels: on fine ones, other parts of a frame pass for air. Its noise is white."""
    shape = (97, 150)
    y, x = np.mgrid[: shape[0], : shape[1]] / np.array(shape)[:, None, None] - 0.5
    light = np.stack([1 + 0.1 * (a * x + b * y) for a, b in ((1, 0.5), (-0.6, 1), (0.3, -1))])
    skirt = 1 - 0.2 * np.exp(-((x / 0.1) ** 2) - (y / 0.15) ** 2)
    frames = (light * skirt * (1 + 1e-3 * np.random.default_rng(3).normal(size=light.shape))).astype(np.float32)
    scan = Scan(frames, Exposures.of(Views.evenly_spaced(3, shape, PIXEL), 20.0, 0.1), np.zeros(3, dtype=bool))
    options = LightOptions()
    found = with_more(plain_light(scan.measured, options), UNEVEN, scan, lambda _: scan.measured, options)
    compared = Light.of(scan.binned(3).measured, LightOptions("smooth"))
    assert found is not None
    assert torch.equal(found.part(torch.arange(3), 3).air, compared.air)
    torch.testing.assert_close(found.part(torch.arange(3), 3).factor(), compared.factor(), rtol=0, atol=2e-3)
    assert not found.noise.has_grain


def test_fits_refuse_what_does_not_help_them(soft, monkeypatch):
    """A pattern that a first volume finds in even light is next to nothing."""

    def forced(first: FirstVolumes, options: LightOptions, *_: object) -> tuple[tuple[str, ...], tuple[()]]:
        Trials(first, options).proposed(("fixed pattern",))
        return ("fixed pattern",), ()

    monkeypatch.setattr("holosplat.methods.illumination.decided", forced)
    task = prepared(Task(soft, PRIOR), SmoothVolume())
    last = [each for each in task.decisions if each.name == STAGE][-1]
    assert last.choice == "as measured"
    assert len(last.compared) == 1
    assert task.lit is not None
    assert task.lit.still is None


@pytest.mark.parametrize("family", ["soft", "sharp"])
def test_unequal_flux_is_found(family, request):
    """Of .4 %, which passes for absorption of matter all over the field."""
    flux = 1 + 0.004 * np.random.default_rng(4).normal(size=(VIEWS, 1, 1))
    task = prepared(Task(lit(request.getfixturevalue(family), flux), PRIOR))
    assert task.uneven is not None
    assert task.lit is not None
    off = (task.lit.factor().numpy() / flux).mean(axis=(1, 2))
    assert float(off.std()) < 0.3 * float(flux.std())
    if family == "sharp":  # in soft matter, light by air alone tells the flux better still
        assert light_options_of(task) == EVEN


def test_flux_is_told_from_noise_of_means():
    """On rectangular frames of odd sides."""
    draw = torch.Generator().manual_seed(2)
    true = 1 + 0.3 * torch.rand(7, 31, 45, generator=draw)
    noise = 0.01 * torch.randn(7, 31, 45, generator=draw)
    flux = torch.tensor([0.99, 1.0, 1.01, 1.02, 0.98, 1.0, 1.0])[:, None, None]
    found = Background.of_flux(flux * true + noise, true)
    assert found.is_flux
    assert float((found.factor() / flux).std()) < 1e-3
    assert float(found.variances[0]) ** 0.5 == pytest.approx(float(flux.log().std()), rel=0.1)
    assert found.size_of_doubt == pytest.approx(float(flux.log().std()) / 7**0.5, rel=0.1)
    draws = (Background.of_flux(true + 0.01 * torch.randn(true.shape, generator=draw), true) for _ in range(40))
    assert 10 < sum(bool((one.factor() == 1).all()) for one in draws) < 30  # of equal flux, half of all draws
    assert bool((Background.of_flux(true, true).factor() == 1).all())
    assert bool((Background.of_flux(true[:1], 1.1 * true[:1]).factor() == 1).all())


def test_flux_is_unknown_before_there_is_a_volume():
    """All that means of frames differ by may be flux."""
    draw = torch.Generator().manual_seed(2)
    flux = torch.tensor([0.99, 1.0, 1.01, 1.02, 0.98])[:, None, None]
    frames = flux * (1 + 0.01 * torch.randn(5, 31, 45, generator=draw))
    found = Background.unknown_flux(frames)
    assert found.is_flux
    assert torch.equal(found.factor(), torch.ones(5, 31, 45, dtype=torch.float64))
    assert found.size_of_doubt == pytest.approx(float(flux.log().std()), rel=0.1)


def test_flux_is_told_by_a_volume_to_which_it_is_unknown(sharp):
    """And not by one that takes all frames for equally lit."""
    flux = 1 + 0.02 * np.random.default_rng(4).normal(size=(VIEWS, 1, 1))
    scan, asked = lit(sharp, flux), list[Light]()

    def predict(light: Light) -> torch.Tensor:
        asked.append(light)
        return sharp.measured

    found = with_more(plain_light(scan.measured, LightOptions()), FLUX, scan, predict, LightOptions())
    assert [each.background is not None and each.background.is_flux for each in asked] == [True]
    assert asked[0].doubt.power().amax() > 100 * asked[0].noise.power().amax()
    assert found is not None
    off = found.factor().numpy() / flux
    assert float(off.std()) < 1e-3


def test_flux_is_told_where_it_spoils_the_volume(sharp):
    """The volume of frames in even light predicts worse than no matter; that beside unknown flux predicts well."""
    flux = 1 + 0.02 * np.random.default_rng(4).normal(size=(VIEWS, 1, 1))
    trials = Trials(first_of_task(Task(lit(sharp, flux), PRIOR)), LightOptions())

    def gain(name: str) -> float:
        return trials.score(name, 0).gain_over(trials.score(name + WITHOUT, 0))[0]

    assert trials.proposed((FLUX,))
    assert gain("as measured") < 0
    assert gain(FLUX) > 0.3


@pytest.mark.parametrize("family", ["soft", "sharp"])
def test_a_fixed_pattern_is_found(family, request):
    pattern = 1 + 0.03 * np.random.default_rng(1).normal(size=SHAPE)
    task = prepared(Task(lit(request.getfixturevalue(family), pattern[None]), PRIOR))
    assert task.lit is not None
    assert task.lit.still is not None
    left = task.lit.still.numpy() / pattern
    assert float(left.std()) < 0.5 * 0.03


def test_grain_of_each_frame_is_no_pattern(sharp):
    draw = np.random.default_rng(3)
    grain = np.stack([1 + 0.02 * correlated_field(SHAPE, 1.5, draw) for _ in range(VIEWS)])
    task = prepared(Task(lit(sharp, grain), PRIOR))
    assert task.lit is not None
    assert task.lit.still is None


def test_light_that_the_frames_of_a_later_fold_do_not_show_adds_nothing_there(sharp, monkeypatch):
    """As where the views that show air are set aside there; a run ended there before."""
    first = first_of_task(Task(lit(sharp, uneven()), PRIOR))
    hidden, found = first.folds.split(1)[0].frames, trials.with_more

    def where_air_is_seen(light, one, seen, *given):
        unseen = one == UNEVEN and np.array_equal(seen.frames, hidden)
        return None if unseen else found(light, one, seen, *given)

    monkeypatch.setattr(trials, "with_more", where_air_is_seen)
    tried = Trials(first, LightOptions())
    assert tried.proposed((UNEVEN,))
    here, there = (tried.score(UNEVEN, fold).gain_over(tried.score(NULL, fold))[0] for fold in (0, 1))
    assert here > 0
    assert there == 0


@pytest.mark.parametrize(
    ("method", "prior", "is_asked", "is_likely"),
    [
        (Auto(), MaterialPrior.unknown(1), True, True),
        (SmoothVolume(), MaterialPrior.unknown(1), True, True),
        (None, MaterialPrior.unknown(1), True, False),
        (Auto(), PRIOR, False, False),
        (Auto(), MaterialPrior.unknown().on_both_sides(), False, False),
    ],
    ids=["default", "volume", "no method", "ratio told", "both sides"],
)
def test_absorption_is_decided_before_light_where_nothing_is_known(
    soft, method, prior, is_asked, is_likely, monkeypatch
):
    """By the likelihood, too, for methods of which a fit may be made."""
    order, decision = list[str](), Decision("δ/β", "700", "views set aside")

    def found(task, first, light, likely):
        order.append("ratio")
        assert likely is is_likely
        return first.at_ratio(700.0), (decision,)

    def lit(first, *_):
        order.append("light")
        assert (first.material.ratio == pytest.approx(700.0)) is is_asked
        return (), ()

    place = import_module("holosplat.methods.illumination")
    monkeypatch.setattr(place, "decide_ratio", found)
    monkeypatch.setattr(place, "decided", lit)
    monkeypatch.setattr(place, "_may_have_both_sides", lambda *_: False)
    assert (decision in prepared(Task(soft, prior), method).decisions) is is_asked
    assert order == ["ratio"] * is_asked + ["light"]


def test_what_is_told_is_not_decided(soft):
    told = LightOptions("even", noise="white")
    assert choices(soft, told) == []
    assert prepared(Task(soft, PRIOR, light=replace(told, noise="correlated"))).noise.has_grain
    assert not prepared(Task(soft, PRIOR, light=told)).noise.has_grain


def test_two_views_are_judged_by_data_fission(soft):
    few = soft[[0, 4]]
    folds = Folds.of(few)
    assert folds.by == BY_FISSION
    first, second = (torch.from_numpy(part.frames) for part in folds.split(0))
    assert torch.allclose(0.5 * (first + second), torch.from_numpy(few.frames), atol=1e-6)
    assert float((first - second).std()) > 0
    assert all("fixed pattern" not in each for each in choices(few))


def test_folds_share_phase_retrieval(sharp):
    """A volume is the same as by retrieval of its own views alone."""
    task = Task(sharp, MaterialPrior.known(MATTER))
    first = first_of_task(task)
    seen, _ = first.folds.split(1)
    light = plain_light(torch.from_numpy(seen.frames), task.light)
    alone, _ = holographic_tv(seen, MATTER, first.options, task.on_progress, light)
    assert torch.equal(first.volume(1, light).values[0], alone)


def test_folds_share_no_view(soft):
    folds = Folds.of(soft)
    unseen = [part for k in range(folds.count) for part in folds.split(k)[1].frames]
    assert len({part.tobytes() for part in unseen}) == len(unseen) == 2 * folds.count
    for k in range(folds.count):
        seen, aside = folds.split(k)
        assert len(seen) + len(aside) == VIEWS


def test_the_lamp_of_a_simulated_beamline_is_found(sharp):
    lamp = UnevenLight(light_smooth=0.03, light_seed=4).on(VIEWS, SHAPE)
    rng = np.random.default_rng(0)
    frames = np.stack([lamp.recorded(frame, n, 1e5, rng) for n, frame in enumerate(sharp.frames)])
    assert "uneven light" in " ".join(choices(replace(sharp, frames=frames.astype(np.float32))))


def test_fits_decide_where_first_volumes_show_no_matter(sharp, monkeypatch):
    """By the kind of matter that predicts better; they are not asked where first volumes show some."""
    asked = set()

    class Fits:
        def __init__(self, *_: object) -> None: ...

        def score(self, name: str, kind: str, fold: int) -> Score:
            asked.add(kind)
            left = 0.5 if (name, kind) == (FLUX, "levels") else 1.0
            return Score(left * np.random.default_rng(fold).uniform(1, 2, (4, 3)), 2)

    monkeypatch.setattr("holosplat.methods.illumination.TrialFits", Fits)
    noise = 1 + 0.01 * np.random.default_rng(6).normal(size=sharp.frames.shape)
    flux = 1 + 0.02 * np.random.default_rng(4).normal(size=(VIEWS, 1, 1))
    empty = replace(sharp, frames=(noise * uneven() * flux).astype(np.float32))
    options = LightOptions(still="none", noise="white")
    made = prepared(Task(empty, PRIOR, light=options), Auto()).decisions
    assert all(each.choice.endswith("without matter") for each in made if each.name == SHOWN)
    last = [each for each in made if each.name == STAGE and each.by.endswith("by fits")]
    assert [each.choice for each in last] == [FLUX, FLUX]
    assert asked == {"levels", "continuous"}


def test_first_volumes_need_not_surely_show_matter(monkeypatch):
    """One frame is explained, and one hardly: fits of all hypotheses would cost many times as much."""
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 32, 32)))

    class Volumes:
        def __init__(self, *_: object) -> None: ...

        def score(self, name: str, fold: int) -> Score:
            return Score.of(
                noise * (1.0 if name.endswith("without matter") else torch.tensor([0.4, 1.2])[:, None, None])
            )

    monkeypatch.setattr("holosplat.methods.illumination.Trials", Volumes)
    first = SimpleNamespace(folds=SimpleNamespace(count=1, by="views set aside"))
    found = shows_matter(first, LightOptions(), ())  # type: ignore[arg-type]
    assert found.choice == "as measured"
    assert not found.compared[0].wins


def test_first_volumes_decide_where_they_show_matter(sharp):
    first = first_of_task(Task(sharp, PRIOR))
    assert shows_matter(first, LightOptions(), ()).choice == "as measured"


@pytest.mark.parametrize(("later", "choice"), [(0.7, "correlated noise"), (1.0, NULL)])
def test_whole_fits_confirm_by_the_folds_that_one_leaves_open(soft, monkeypatch, later, choice):
    seen = set[int]()

    def score(fits: TrialFits, name: str, kind: str, fold: int, two: bool = False) -> Score:
        assert list(fits._methods) == ["continuous"]
        assert fits._methods["continuous"] == SmoothVolume()
        seen.add(fold)
        scatter, power = np.array([0.8, 1.2]), 1.0 if fold == 0 else later
        return Score(np.repeat(scatter * power if name != NULL else np.ones(2), 4)[:, None] * np.ones(3), 2)

    monkeypatch.setattr(TrialFits, "score", score)
    first = first_of_task(Task(soft, PRIOR))
    first.taken = ("correlated noise",)
    assert confirmed(Task(soft, PRIOR), first, ()).choice == choice
    assert seen == {0, 1, 2}
