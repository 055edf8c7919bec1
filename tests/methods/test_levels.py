"""Whether matter has levels: told by views that are set aside, and what follows from it for the methods."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import torch

from helpers.runs import KNOWN, SMALL
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, Gaussians, Task, levels, settled
from holosplat.methods.cross_validation import CrossValidation, MissingMatter
from holosplat.methods.levels import Decision, LevelTest, decide_matter, flattened
from holosplat.optics.background import Light, LightOptions
from holosplat.optics.noise_model import NoiseModel
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.specimens.soft_matter import soft_cells

pytestmark = pytest.mark.usefixtures("begun_once")

MATERIAL = DeltaBeta(4e-7, 4e-7 / 1500)
PIXEL, SHAPE = 1e-6, (45, 52)  # rectangular, and odd
RATIO = MaterialPrior.of_ratio(MATERIAL.ratio)


def measured(scene, photons: float | None = None) -> Scan:
    exposures = Exposures.of(Views.evenly_spaced(9, SHAPE, PIXEL), 20.0, 0.1)
    return simulate(scene, exposures, photons_per_pixel=photons, seed=3, is_test=np.zeros(9, dtype=bool))


def decided(task: Task) -> Decision:
    """As runs decide, once for the same frames (`begun_once`)."""
    return import_module("holosplat.methods.solve").decide_matter(task, LevelTest())


@pytest.fixture(scope="module")
def soft() -> Scan:
    return measured(soft_cells(4, (14e-6, 20e-6), (40e-6, 38e-6, 40e-6), MATERIAL, seed=5, edge=3e-6))


@pytest.fixture(scope="module")
def sharp() -> Scan:
    cells = random_cells(4, (40e-6, 38e-6, 40e-6), 5, 17e-6)
    return measured(MeshScene.of_one_material(cells, MATERIAL))


@pytest.mark.parametrize("prior", [RATIO, MaterialPrior.known(MATERIAL)], ids=["ratio", "known"])
def test_a_continuum_is_told_from_levels_whatever_is_known(soft, sharp, prior):
    continuous, levels = (decided(Task(scan, prior)) for scan in (soft, sharp))
    assert (continuous.matter, continuous.sure) == ("continuous", True)
    assert (levels.matter, levels.sure) == ("levels", True)
    assert "views set aside" in continuous.why


def test_two_levels_are_levels_where_two_materials_may_be_found():
    """One ratio with one bound cannot hold them: metal beside soft matter must not be capped at one of the two."""
    cells = random_cells(4, (40e-6, 38e-6, 40e-6), 5, 17e-6)
    dense, light = MATERIAL, DeltaBeta(0.45 * MATERIAL.delta, 0.45 * MATERIAL.beta)
    scene = MeshScene(cells, [dense, light, dense, light])
    scan = measured(scene)
    assert decide_matter(Task(scan, MaterialPrior.unknown())).matter == "levels"
    assert decide_matter(Task(scan, RATIO)).matter == "continuous"


def test_noise_that_hides_levels_leaves_the_decision_to_what_is_known(sharp):
    rng = np.random.default_rng(0)
    hidden = replace(sharp, frames=sharp.frames + rng.normal(0, 0.2, sharp.frames.shape).astype(np.float32))
    kinds = {prior.kind: decide_matter(Task(hidden, prior)) for prior in (RATIO, MaterialPrior.known(MATERIAL))}
    assert {kind: (found.matter, found.sure) for kind, found in kinds.items()} == {
        "ratio": ("continuous", False),
        "known": ("levels", True),
    }


def test_in_noise_a_flat_inside_should_do_good(soft, sharp):
    """If it does harm, matter is continuous; of what is known to have a level that is noise."""
    rng = np.random.default_rng(1)
    for scan, matter in ((soft, "continuous"), (sharp, "undecided")):
        noise = 0.5 * float(np.sqrt(np.square(scan.frames - 1).mean()))
        hidden = replace(scan, frames=scan.frames + rng.normal(0, noise, scan.frames.shape).astype(np.float32))
        found = decide_matter(Task(hidden, RATIO))
        assert (found.matter if found.sure else "undecided") == matter
        assert decide_matter(Task(hidden, MaterialPrior.known(MATERIAL))).matter == "levels"


def test_in_uneven_light_a_known_material_has_levels(soft):
    """What a flat inside leaves may be light then; a known ratio stays what the frames say."""
    rows = soft.frames.shape[1]
    lit = Light.of(torch.from_numpy(soft.frames), LightOptions("smooth", ((0, rows, 0, 3),)))
    found = decide_matter(Task(soft, MaterialPrior.known(MATERIAL), lit=lit))
    assert (found.matter, found.sure) == ("levels", True)
    assert "uneven light" in found.why
    assert decided(Task(soft, MaterialPrior.known(MATERIAL))).matter == "continuous"
    assert decide_matter(Task(soft, RATIO, lit=lit)).matter == "continuous"


def test_the_first_volume_is_made_in_the_light_of_its_frames(sharp, monkeypatch):
    """Those that are left, on the pixels that they are binned to."""
    rows, seen = sharp.frames.shape[1], []
    lit = Light.of(torch.from_numpy(sharp.frames), LightOptions("smooth", ((0, rows, 0, 3),)))
    split = CrossValidation(width=26)
    made = levels.holographic_tv

    def noted(scan, material, options, on_progress, light):
        seen.append((scan, light))
        return made(scan, material, options, on_progress, light)

    monkeypatch.setattr(levels, "holographic_tv", noted)
    decide_matter(Task(sharp, KNOWN, lit=lit), LevelTest(validation=split))
    ((scan, light),) = seen
    left, _ = split.split(sharp)
    np.testing.assert_array_equal(scan.frames, left.frames)
    assert light.background.factor().shape == left.frames.shape


def test_too_few_views_are_said(sharp):
    assert "too few views" in decide_matter(Task(sharp[[0, 4]], RATIO)).why


def test_the_kind_that_is_told_is_taken(sharp):
    assert settled(SMALL, Task(sharp, KNOWN), "continuous").matter == "continuous"
    two = MaterialPrior.known(DeltaBeta(2e-7, 1e-10), DeltaBeta(1e-7, 1e-10))
    with pytest.raises(InputError, match="--matter must be levels or auto where two materials are known"):
        settled(SMALL, Task(sharp, two), "continuous")


def test_auto_takes_bodies_for_levels_and_a_volume_for_a_continuum(soft, sharp):
    auto = Auto()
    assert settled(auto, Task(soft, RATIO)).method is auto.volume
    assert settled(auto, Task(sharp, RATIO)).method.kind == "bodies"


@pytest.mark.parametrize(
    ("shares", "noise", "wanted"),
    [
        ((0.18, 0.18), 0.0, "continuous"),
        ((0.179, 0.183), 0.0, "continuous"),
        ((0.15, 0.18), 0.0, "levels"),
        ((0.18, 0.1), 0.0, "continuous"),
        ((0.15, 0.18), 0.2, "continuous"),
        ((0.71, 0.738), 0.66, "levels"),
    ],
)
def test_a_trial_decides_where_one_method_is_better_beyond_noise(soft, monkeypatch, shares, noise, wanted):
    """Shares that Gaussians and a volume leave in views set aside; else what a known ratio leaves open stays so."""
    auto, task = Auto(), Task(soft, RATIO)
    module = import_module("holosplat.methods.auto")
    monkeypatch.setattr(module, "solve_stages", lambda method, trial: trial.matter)
    share = dict(zip(("levels", "continuous"), shares))
    monkeypatch.setattr(MissingMatter, "share", lambda judge, matter: share[matter])
    monkeypatch.setattr(MissingMatter, "of", lambda judge, images: noise**2 if images.dtype == torch.float64 else 1.0)
    method, decision = auto.chosen(task, Decision("continuous", "open", sure=False))
    assert decision.matter == wanted
    assert (method is auto.volume) == (wanted == "continuous")
    assert ("decides nothing" in decision.why) == (wanted == "continuous" and shares[0] <= shares[1])


def test_views_set_aside_are_judged_by_their_own_noise(soft):
    """Binned as they are, of a scan in which each view has noise of its own."""
    white = torch.arange(1.0, len(soft) + 1).double()
    noise = NoiseModel(white, torch.zeros(len(soft), soft.views.shape[0], soft.views.shape[1] // 2 + 1).double())
    halved = CrossValidation(width=max(soft.views.shape) // 2)
    left, aside = halved.split(soft)
    exposures = soft.exposures.views.rotations
    of = [int(np.abs(exposures - turn).sum((1, 2)).argmin()) for turn in aside.views.rotations]
    assert len(left) + len(of) == len(soft)
    factor = soft.views.shape[0] // aside.views.shape[0]
    np.testing.assert_allclose(halved.noise_aside(soft, noise).white, white[of] / factor)


def test_occupancies_are_bounded_where_matter_has_levels_only(sharp):
    known = MaterialPrior.known(MATERIAL)
    levels, continuous = (Task(sharp, known, matter=matter) for matter in ("levels", "continuous"))
    assert (levels.bounded, levels.bound(1.0)) == (True, 1.0)
    assert (continuous.bounded, continuous.bound(1.0)) == (False, 0.0)
    stage = Gaussians().stages()[0]
    names = [
        {part for term in stage.fit(task, _cloud()).plan.problem.terms for part in term.names}
        for task in (levels, continuous)
    ]
    assert names[0] - names[1] == {"overfull", "two_levels"}


def _cloud():
    from holosplat.matter import Matter
    from holosplat.representations import random_cloud

    return random_cloud(20, Views.evenly_spaced(9, SHAPE, PIXEL), Matter.one(*MATERIAL), 2e-6, 0)


def test_flat_volumes_keep_their_rims_and_their_mass():
    values = torch.zeros(15, 13, 17)
    values[3:12, 3:11, 4:13] = 1.0
    values[5:10, 5:9, 6:11] = torch.rand(5, 4, 5, generator=torch.Generator().manual_seed(1)) + 0.5
    one = next(flattened(values, 1))
    inside = one != values
    assert inside.any()
    assert not inside[3].any()
    assert torch.isclose(one.sum(), values.sum())
    assert one[inside].unique().numel() == 1
    assert list(flattened(torch.zeros(9, 9, 9).index_fill(0, torch.tensor([4]), 1.0), 1)) == []


def test_views_set_aside_are_binned_and_never_among_those_seen(sharp):
    seen, aside = CrossValidation(width=26).split(sharp)
    assert (len(seen), len(aside), aside.views.shape) == (7, 2, (22, 26))
    assert CrossValidation().split(sharp[[0, 1]]) is None


def test_missing_matter_counts_what_is_absent(sharp):
    """Nothing leaves about all, and a residual twice as large four times as much."""
    judge = MissingMatter(sharp, MATERIAL)
    residual = judge.measured - 1
    assert judge.of(residual) == pytest.approx(judge.whole)
    assert judge.of(2 * residual) == pytest.approx(4 * judge.whole, rel=1e-5)
