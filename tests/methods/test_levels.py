"""Whether matter has levels: told by views that are set aside, and what follows from it for the methods."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import ClassVar

import numpy as np
import pytest
import torch

from helpers.runs import KNOWN, SMALL
from holosplat.baselines.material import LIKELY_RATIOS
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError, NoMatterError
from holosplat.geometry import Grid, Views
from holosplat.inference import Decision, Score
from holosplat.matter import DeltaBeta, MaterialPrior, Matter, MatterKind
from holosplat.methods import Auto, Gaussians, Method, Task, settled
from holosplat.methods.cross_validation import MissingMatter, plain_light
from holosplat.methods.levels import (
    CONTINUOUS,
    LEVELS,
    SHOWN,
    TrialFits,
    decide_matter,
    flattened,
)
from holosplat.methods.method import first_of_task
from holosplat.methods.trials import WITHOUT
from holosplat.methods.uncertain import Determined
from holosplat.methods.volume import SmoothVolume
from holosplat.optics.background import LightOptions
from holosplat.representations import Stored, VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.specimens.soft_matter import soft_cells
from holosplat.workflows.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("begun_once")

MATERIAL = DeltaBeta(4e-7, 4e-7 / 1500)
PIXEL, SHAPE = 1.4e-6, (33, 38)  # rectangular, and odd
RATIO = MaterialPrior.of_ratio(MATERIAL.ratio)


def measured(scene, fine: bool = False) -> Scan:
    """fine: on pixels of 1 µm, with as wide fringes in them."""
    shape, pixel, distance = ((45, 52), 1e-6, 0.1) if fine else (SHAPE, PIXEL, 0.2)
    exposures = Exposures.of(Views.evenly_spaced(9, shape, pixel), 20.0, distance)
    return simulate(scene, exposures, is_test=np.zeros(9, dtype=bool))


def decided(task: Task) -> str:
    """As runs decide, once for the same frames (`begun_once`)."""
    return import_module("holosplat.methods.solve").decide_matter(task).choice


@pytest.fixture(scope="module")
def soft() -> Scan:
    return measured(soft_cells(4, (14e-6, 20e-6), (40e-6, 38e-6, 40e-6), MATERIAL, seed=5, edge=3e-6))


@pytest.fixture(scope="module")
def sharp() -> Scan:
    cells = random_cells(4, (40e-6, 38e-6, 40e-6), 5, 17e-6)
    return measured(MeshScene.of_one_material(cells, MATERIAL))


@pytest.mark.parametrize("prior", [RATIO, MaterialPrior.known(MATERIAL)], ids=["ratio", "known"])
def test_a_continuum_is_told_from_levels_whatever_is_known(soft, sharp, prior):
    assert decided(Task(soft, prior)) == CONTINUOUS
    found = decide_matter(Task(sharp, prior))
    assert found.choice == "one level"
    assert found.by == "views set aside"
    assert found.compared[-1].name == CONTINUOUS


def test_two_levels_are_levels_where_two_materials_may_be_found():
    """One ratio with one bound cannot hold them: metal beside soft matter must not be capped at one of the two."""
    cells = random_cells(4, (40e-6, 38e-6, 40e-6), 5, 17e-6)
    dense, light = MATERIAL, DeltaBeta(0.45 * MATERIAL.delta, 0.45 * MATERIAL.beta)
    scene = MeshScene(cells, [dense, light, dense, light])
    scan = measured(scene, fine=True)
    assert decide_matter(Task(scan, MaterialPrior.unknown())).choice in LEVELS
    assert decide_matter(Task(scan, RATIO)).choice == CONTINUOUS


def test_noise_that_hides_the_matter_leaves_the_null(soft, sharp):
    rng = np.random.default_rng(0)
    for scan in (soft, sharp):
        hidden = replace(scan, frames=scan.frames + rng.normal(0, 0.2, scan.frames.shape).astype(np.float32))
        assert decide_matter(Task(hidden, RATIO)).choice == "one level"


@dataclass(frozen=True)
class Answer(Method):
    """A method that finds a given object, on whatever frames."""

    kind: ClassVar[str] = "answer"
    found: Stored

    def stages(self):
        return (self,)

    name: ClassVar[str] = "answer"

    def start(self, task, before):
        return self.found

    def fit(self, task, start):
        return None


def test_fits_decide_where_flat_volumes_do_not(sharp):
    """The methods' own fits of the frames that are left: the one that predicts the others is right."""
    rng = np.random.default_rng(0)
    noisy = replace(sharp, frames=sharp.frames + rng.normal(0, 0.08, sharp.frames.shape).astype(np.float32))
    grid = Grid.of_views(noisy.views)
    true = MeshScene.of_one_material(random_cells(4, (40e-6, 38e-6, 40e-6), 5, 17e-6), MATERIAL).voxelise(grid)
    filled = torch.from_numpy(np.asarray(true.delta, np.float32))[None] / MATERIAL.delta
    right, wrong = (Answer(VoxelGrid(share * filled, grid, Matter.one(*MATERIAL))) for share in (1.0, 0.5))
    trials = ((right, wrong, "one level"), (wrong, right, CONTINUOUS), (right, right, CONTINUOUS))
    for levels, continuous, choice in trials:
        found = decide_matter(Task(noisy, RATIO), {"levels": levels, "continuous": continuous})
        assert (found.choice, found.by) == (choice, "views set aside, by fits")


@dataclass(frozen=True)
class Slow(Answer):
    """A method that finds something else in all its steps."""

    later: Stored
    steps: list[float] = field(default_factory=list, compare=False)
    join_missing: bool = True
    joined: set[tuple[bool, bool]] = field(default_factory=set, compare=False)
    """Whether fits were long, and whether missing bodies join in them."""

    def start(self, task, before):
        self.joined.add((self.found is self.later, self.join_missing))
        return super().start(task, before)

    def with_effort(self, effort: float) -> Slow:
        self.steps.append(effort)
        return replace(self, found=self.later) if effort == 1 else self


@pytest.mark.parametrize(("short", "efforts"), [(0.0, [0.2]), (2.0, [0.2, 1.0])], ids=["short", "long"])
def test_levels_that_short_fits_do_not_find_have_long_ones(soft, short, efforts):
    """Of a soft cell, of which unseen frames say that first volumes show nothing."""
    hidden = Decision(SHOWN, "as measured" + WITHOUT, "views set aside")
    task, grid = Task(soft, RATIO, decisions=(hidden,)), Grid.of_views(soft.views)
    bad, fair, good = (
        VoxelGrid(torch.full((1, *grid.shape), x), grid, Matter.one(*MATERIAL)) for x in (short, 1.0, 0.0)
    )
    levels = Slow(bad, good)
    assert decide_matter(task, {"levels": levels, "continuous": Answer(fair)}).choice == "one level"
    assert levels.steps == efforts
    assert levels.joined == {(effort == 1, effort == 1) for effort in efforts}  # short ones do without


def test_fits_alone_overturn_a_known_material(soft):
    """Of a soft cell, flat volumes say that it is continuous; where fits of both kinds are alike, its levels stand."""
    task = Task(soft, MaterialPrior.known(MATERIAL))
    assert decide_matter(task).choice == CONTINUOUS
    grid = Grid.of_views(soft.views)
    ones = torch.ones((1, *grid.shape))
    near, far = (Answer(VoxelGrid(share * ones, grid, Matter.one(*MATERIAL))) for share in (0.0, 1.0))
    for levels, continuous, choice in ((near, near, "one level"), (far, near, CONTINUOUS), (near, far, "one level")):
        found = decide_matter(task, {"levels": levels, "continuous": continuous})
        assert (found.choice, found.by) == (choice, "views set aside, by fits")


def test_first_volumes_that_show_no_matter_do_not_decide_its_kind(soft):
    """Of this soft cell they are sure; where unseen frames speak against them, fits are asked, and find one level."""
    grid = Grid.of_views(soft.views)
    near, far = (Answer(VoxelGrid(torch.full((1, *grid.shape), x), grid, Matter.one(*MATERIAL))) for x in (0.0, 1.0))
    methods = {"levels": near, "continuous": far}
    assert decide_matter(Task(soft, RATIO), methods).choice == CONTINUOUS
    hidden = Decision(SHOWN, "as measured" + WITHOUT, "views set aside")
    found = decide_matter(Task(soft, RATIO, decisions=(hidden,)), methods)
    assert (found.choice, found.by) == ("one level", "views set aside, by fits")


def test_continuous_matter_is_sure_where_all_folds_say_so(soft, monkeypatch):
    """Its first two views leave it open, the six tell it: no method is fitted."""

    def score(flat, name: str, fold: int) -> Score:
        own = 1.0 if name == CONTINUOUS else 1.06
        scatter = np.array([0.9, 1.1]) if name != CONTINUOUS and fold == 0 else np.ones(2)
        return Score(own * np.repeat(scatter, 4)[:, None] * np.ones(3), 2)

    monkeypatch.setattr("holosplat.methods.levels._FlatVolumes.score", score)
    monkeypatch.setattr(TrialFits, "score", lambda *_: pytest.fail("a method was fitted"))
    found = decide_matter(Task(soft, RATIO), {"levels": Auto().gaussians, "continuous": Auto().volume})
    assert found.choice == CONTINUOUS


def test_continuous_matter_has_all_its_steps_beside_short_fits_of_bodies(soft, monkeypatch):
    efforts = list[tuple[int, int]]()

    def score(fits, name, kind, fold, two=False) -> Score:
        bodies, volume = (fits._methods[one] for one in ("levels", "continuous"))
        efforts.append((bodies.fit.schedule.steps, volume.iterations))
        return Score(np.ones((8, 3)), 2)

    monkeypatch.setattr(TrialFits, "score", score)
    methods = {"levels": Auto().gaussians, "continuous": Auto().volume}
    decide_matter(Task(soft, MaterialPrior.known(MATERIAL)), methods)
    assert {steps for steps, _ in efforts} == {round(0.2 * Auto().gaussians.fit.schedule.steps)}
    assert {iterations for _, iterations in efforts} == {Auto().volume.iterations}


def test_fits_must_win_in_every_fold(soft, monkeypatch):
    """Continuous matter explains the first two unseen views ten and four times better, and the others worse."""

    def score(fits, name, kind, fold, two=False) -> Score:
        own = (1.0, 1.0) if kind == "levels" else (0.01, 0.06) if fold == 0 else (100.0, 100.0)
        return Score(np.repeat(own, 4)[:, None] * np.ones(3), 2)

    monkeypatch.setattr(TrialFits, "score", score)
    methods = {"levels": Auto().gaussians, "continuous": Auto().volume}
    found = decide_matter(Task(soft, MaterialPrior.known(MATERIAL)), methods)
    assert (found.choice, found.by) == ("one level", "views set aside, by fits")


@pytest.mark.parametrize(("is_lit", "ratio"), [(True, 777.0), (False, 333.0)])
def test_kinds_are_compared_at_the_likeliest_ratio(soft, monkeypatch, is_lit, ratio):
    """Where none is known; before light is decided, at that of the first volume."""
    seen, grid = list[float](), Grid.of_views(soft.views)
    frames = torch.from_numpy(soft.frames)
    task = Task(soft, MaterialPrior.unknown(), lit=plain_light(frames, LightOptions()) if is_lit else None)
    first = first_of_task(task)
    first._material = DeltaBeta(MATERIAL.delta, MATERIAL.delta / 333.0)

    def fitted(method, task) -> VoxelGrid:
        seen.append(task.prior.ratio)
        return VoxelGrid(torch.zeros((1, *grid.shape)), grid, Matter.one(*MATERIAL))

    place = import_module("holosplat.methods.levels")
    monkeypatch.setattr(place, "ratio_of_one", lambda task, first: likely(777.0))
    monkeypatch.setattr(place, "solve_stages", fitted)
    TrialFits(task, first, {"continuous": Auto().volume}).score("as measured", "continuous", 0)
    assert seen == [pytest.approx(ratio)]


def likely(ratio: float) -> Determined:
    return Determined("delta_beta", ratio, 0.9 * ratio, 1.1 * ratio, LIKELY_RATIOS, True)


def test_a_fit_that_finds_no_matter_predicts_frames_without_any(soft, monkeypatch):
    """It is a candidate that explains nothing, not the end of a run."""
    place = import_module("holosplat.methods.levels")
    task = Task(soft, RATIO, lit=plain_light(torch.from_numpy(soft.frames), LightOptions()))
    first = first_of_task(task)

    def nothing(method, task):
        raise NoMatterError

    monkeypatch.setattr(place, "solve_stages", nothing)
    found = TrialFits(task, first, {"levels": Auto().gaussians}).score("as measured", "levels", 0)
    unseen = first.for_fits.folds.split(0)[1]
    empty = Score.of(unseen.left(torch.ones(unseen.frames.shape, dtype=torch.float64)))
    np.testing.assert_allclose(found.powers, empty.powers)


def test_the_level_of_a_fit_is_that_of_the_continuous_fit_beside_it(soft, monkeypatch):
    """Of two levels, and of a known material, none is looked for."""
    place, seen = import_module("holosplat.methods.levels"), dict[str, object]()
    grid = Grid.of_views(soft.views)
    smooth = VoxelGrid(torch.ones((1, *grid.shape)), grid, Matter.one(*MATERIAL))

    def fitted(method, task) -> VoxelGrid:
        seen[task.matter] = task.likeliest
        return smooth

    monkeypatch.setattr(place, "solve_stages", fitted)
    kinds = {"levels": Auto().gaussians, "continuous": Auto().volume}
    task = Task(soft, RATIO, lit=plain_light(torch.from_numpy(soft.frames), LightOptions()))
    TrialFits(task, first_of_task(task), kinds).score("as measured", "levels", 0)
    assert seen == {"continuous": None, "levels": smooth}
    known = replace(task, prior=KNOWN)
    TrialFits(known, first_of_task(known), kinds).score("as measured", "levels", 0)
    assert seen["levels"] is None


def test_too_few_views_are_said(sharp):
    assert "too few views" in decide_matter(Task(sharp[[0, 4]], RATIO)).by


def test_the_kind_that_is_told_is_taken(sharp):
    assert settled(SMALL, Task(sharp, KNOWN), "continuous").matter == "continuous"


@pytest.mark.parametrize(
    ("method", "prior", "told", "why"),
    [
        (
            SMALL,
            MaterialPrior.known(MATERIAL, DeltaBeta(1e-7, 1e-10)),
            "continuous",
            "several materials",
        ),
        (SMALL, RATIO.on_both_sides(), "levels", "both sides"),
        (SmoothVolume(), RATIO, "levels", "the method volume has no levels"),
    ],
)
def test_a_kind_that_there_cannot_be_is_refused_and_the_other_one_taken(sharp, method, prior, told, why):
    kind: MatterKind = "levels" if told == "continuous" else "continuous"
    with pytest.raises(InputError, match=f"--matter must be {kind} or auto, because .*{why}.*, but it is {told}"):
        reconstruct(sharp, prior, method, matter=told)
    decided = settled(method, Task(sharp, prior))
    assert decided.matter == kind
    assert why in decided.decision.by


def test_fits_of_gaussians_decide_the_kind_of_a_known_material(soft, monkeypatch):
    """First volumes alone call cells in few views continuous; each kind has a fit of its own."""
    asked, place = list[tuple[str, str]](), import_module("holosplat.methods.levels")
    grid = Grid.of_views(soft.views)

    def fitted(method, task) -> VoxelGrid:
        asked.append((method.kind, task.matter))
        return VoxelGrid(torch.zeros((1, *grid.shape)), grid, Matter.one(*MATERIAL))

    monkeypatch.setattr(place, "solve_stages", fitted)
    known = Task(soft, MaterialPrior.known(MATERIAL), lit=plain_light(torch.from_numpy(soft.frames), LightOptions()))
    assert place.decide_matter(known).choice == CONTINUOUS
    found = settled(Gaussians(), known)
    assert found.matter == "levels"
    assert set(asked) == {("gaussians", "levels"), ("gaussians", "continuous")}


def test_auto_takes_bodies_for_levels_and_a_volume_for_a_continuum(soft, sharp):
    auto = Auto().with_effort(0.3)
    assert settled(auto, Task(soft, RATIO)).method is auto.volume
    assert settled(auto, Task(sharp, RATIO)).method.kind == "bodies"


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


@pytest.mark.parametrize("rows", [1, 2])
def test_a_volume_of_few_rows_has_an_inside(rows):
    """Matter goes on above and below frames of few rows, as of a tooth."""
    disc = torch.zeros(13, rows, 17)
    disc[2:11, :, 3:13] = 1.0
    disc[4:9, :, 5:9] = 0.6
    one, two = flattened(disc, 1)
    assert (one != disc).any()
    torch.testing.assert_close(two, disc)


def test_missing_matter_counts_what_is_absent(sharp):
    """Nothing leaves about all, and a residual twice as large four times as much."""
    judge = MissingMatter(sharp, MATERIAL)
    residual = torch.from_numpy(sharp.frames) - 1
    assert judge.of(residual) == pytest.approx(judge.whole)
    assert judge.of(2 * residual) == pytest.approx(4 * judge.whole, rel=1e-5)
