"""δ/β of matter of which nothing is known: by first volumes, by likelihood, and beside what light explains."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from holosplat.baselines.material import LIKELY_RATIOS, RATIOS, USUAL_RATIO
from holosplat.beamline.simulate import simulate
from holosplat.checks import NoMatterError
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS, Task
from holosplat.methods.contrast import with_usual_steps
from holosplat.methods.cross_validation import FirstVolumes
from holosplat.methods.illumination import prepared
from holosplat.methods.levels import TrialFits, decide_ratio, ratio_of_one
from holosplat.methods.method import first_of_task, one_material
from holosplat.methods.uncertain import Determined
from holosplat.optics.background import FLUX, LightOptions
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.specimens.soft_matter import soft_cells
from holosplat.workflows.preconditions import decided_before, decisions_of

pytestmark = pytest.mark.usefixtures("begun_once")

MATERIAL = DeltaBeta(4e-7, 4e-7 / 1500)
PIXEL, SHAPE = 1.4e-6, (33, 38)  # rectangular, and odd
SIZE = (40e-6, 38e-6, 40e-6)


def measured(scene) -> Scan:
    exposures = Exposures.of(Views.evenly_spaced(9, SHAPE, PIXEL), 20.0, 0.2)
    return simulate(scene, exposures, is_test=np.zeros(9, dtype=bool))


def bodies(material: DeltaBeta) -> MeshScene:
    return MeshScene.of_one_material(random_cells(4, SIZE, 5, 17e-6), material)


@pytest.fixture(scope="module")
def soft() -> Scan:
    return measured(soft_cells(4, (14e-6, 20e-6), SIZE, MATERIAL, seed=5, edge=3e-6))


def likely(ratio: float) -> Determined:
    return Determined("delta_beta", ratio, 0.9 * ratio, 1.1 * ratio, LIKELY_RATIOS, True)


@pytest.mark.parametrize("kind", ["soft", "sharp"])
@pytest.mark.parametrize(("true", "likeliest"), [(300.0, 300.0), (9e3, 9e3), (1e6, 300.0), (300.0, LIKELY_RATIOS[1])])
def test_absorption_is_taken_where_it_predicts_unseen_views(kind, true, likeliest, monkeypatch):
    """Of matter that absorbs, and not of matter that does not, whatever explains the fitted frames; and where unseen
    views do not tell the two apart, what explains the fitted frames stands."""
    material = DeltaBeta(MATERIAL.delta, MATERIAL.delta / true)
    cells = soft_cells(4, (14e-6, 20e-6), SIZE, material, seed=5, edge=3e-6)
    task = Task(measured(cells if kind == "soft" else bodies(material)), MaterialPrior.unknown(1))
    place = import_module("holosplat.methods.levels")
    asked = list[Task]()
    monkeypatch.setattr(place, "likeliest_ratio", lambda task: asked.append(task) or likely(likeliest))
    there, (_, decision) = decide_ratio(task, first_of_task(task))
    found = ratio_of_one(task, there)
    assert len(asked) == 1
    assert (decision.name, decision.by) == ("δ/β in frames as measured", "views set aside")
    assert found.value == (likeliest if true == likeliest else LIKELY_RATIOS[1])
    assert there.material.ratio == pytest.approx(found.value)
    if likeliest < LIKELY_RATIOS[1] and found.value != likeliest:
        assert not found.told
        assert (found.low, found.high) == (0.9 * likeliest, LIKELY_RATIOS[1])
        assert decision.line == found.remark


@pytest.mark.parametrize(("absorption", "sign"), [(0.1, -1), (10.0, 1)])
def test_first_volumes_find_the_ratio_by_unseen_views(absorption, sign):
    """Within the step of the ratios that are tried, and of holes as of bodies."""
    delta = sign * MATERIAL.delta
    material = DeltaBeta(delta, absorption * sign * MATERIAL.beta)
    first = first_of_task(Task(measured(bodies(material)), MaterialPrior.unknown(sign)))
    _, decision = first.ratio
    assert (decision.name, decision.by) == ("δ/β of first volumes", "views set aside")
    tried = sorted((float(each.name) for each in decision.compared), reverse=True)
    assert tried == pytest.approx([one for one in RATIOS if one != USUAL_RATIO], rel=1e-4)
    step = RATIOS[0] / RATIOS[1]
    assert float(decision.choice) / step <= first.material.ratio <= step * float(decision.choice)
    assert material.ratio / 2.6 < first.material.ratio < 2.6 * material.ratio
    assert first.material.delta * sign > 0


def test_frames_without_matter_leave_the_usual_ratio(soft):
    """No ratio predicts them better; and that there is no matter is said when a volume is asked for."""
    empty = replace(soft, frames=np.ones_like(soft.frames))
    first = first_of_task(Task(empty, MaterialPrior.unknown(1)))
    assert first.ratio[0] == pytest.approx(USUAL_RATIO, rel=1e-3)
    with pytest.raises(NoMatterError):
        _ = first.material


def test_first_volumes_decide_where_the_likelihood_tells_none_or_is_not_asked(monkeypatch):
    place = import_module("holosplat.methods.levels")
    monkeypatch.setattr(place, "likeliest_ratio", lambda task: replace(likely(160.0), told=False))
    task = Task(measured(bodies(DeltaBeta(MATERIAL.delta, 10 * MATERIAL.beta))), MaterialPrior.unknown(1))
    there, (first, _) = decide_ratio(task, first_of_task(task))
    assert there.material.ratio == pytest.approx(160.0)
    assert not ratio_of_one(task, there).told
    volumes = first_of_task(task)
    alone, (same, _) = decide_ratio(task, volumes, likely=False)
    assert first == replace(same, seconds=first.seconds)
    assert alone.material.ratio == pytest.approx(volumes.ratio[0])


IN_FLUX = LightOptions(still="none", noise="white")
"""Neither a pattern nor grain is looked for, which are for other tests."""


def in_unequal_flux(scan: Scan) -> Scan:
    """Frames that pass for those of matter that absorbs, as long as their light is even."""
    flux = 1 + 0.02 * (-1.0) ** np.arange(9)[:, None, None]
    return replace(scan, frames=(scan.frames * flux).astype(np.float32))


def test_a_run_that_goes_on_has_the_ratio_that_was_decided(soft, quick_likelihood):
    """And so the same light: that of frames as they were measured may be another one."""
    task = Task(in_unequal_flux(soft), MaterialPrior.unknown(1), light=IN_FLUX)
    assert first_of_task(task).ratio[0] < 0.5 * LIKELY_RATIOS[1]
    done = prepared(task)
    again = prepared(task, before=decided_before(decisions_of(done)))
    assert done.first is not None
    assert again.first is not None
    assert done.first.taken == again.first.taken != ()
    assert done.first.material == again.first.material
    assert done.first.material.ratio == pytest.approx(LIKELY_RATIOS[1])
    assert np.array_equal(done.scan.frames, again.scan.frames)
    assert {each.name for each in done.decisions} == {each.name for each in again.decisions}


def test_absorption_must_predict_more_than_the_light_that_other_matter_calls_for(soft, monkeypatch):
    task = Task(in_unequal_flux(soft), MaterialPrior.unknown(1))
    monkeypatch.setattr(import_module("holosplat.methods.levels"), "likeliest_ratio", lambda task: likely(300.0))
    asked = list[FirstVolumes]()

    def lit(first: FirstVolumes) -> tuple[str, ...]:
        asked.append(first)
        return (FLUX,)

    dark, (_, alone) = decide_ratio(task, first_of_task(task))
    there, (_, beside) = decide_ratio(task, first_of_task(task), lit)
    assert (alone.choice, beside.choice) == ("300", "1.8e+04")
    assert (dark.material.ratio, there.material.ratio) == pytest.approx((300.0, LIKELY_RATIOS[1]))
    assert sorted(one.material.ratio for one in asked) == pytest.approx([300.0, LIKELY_RATIOS[1]])


def test_a_ratio_is_found_again_in_other_light(soft, monkeypatch):
    """As the likelihood has it: light that was found at one δ/β speaks for this."""
    asked = list[Task]()
    place = import_module("holosplat.methods.levels")
    monkeypatch.setattr(place, "likeliest_ratio", lambda task: asked.append(task) or likely(3000.0))
    task = Task(soft, MaterialPrior.unknown(1))
    first = first_of_task(task)
    for taken in ((), (), ("fixed pattern",), ()):
        first.taken = taken
        there, decisions = decide_ratio(task, first)
        assert (there is first) is (decisions == ()) is bool(taken)
    assert len(asked) == 2


def test_matter_that_absorbs_in_unequal_flux_does_both(quick_likelihood):
    """What frames as measured hide is found once the light is known."""
    dark = measured(bodies(DeltaBeta(MATERIAL.delta, 10 * MATERIAL.beta)))
    done = prepared(Task(in_unequal_flux(dark), MaterialPrior.unknown(1), light=IN_FLUX))
    assert done.first is not None
    assert done.first.taken == (FLUX,)
    found = ratio_of_one(done, done.first)
    assert found.told
    assert 75 < found.value < 300  # 150


def test_both_sides_and_fits_of_two_levels_have_the_ratio_that_was_decided(soft, monkeypatch):
    """Neither looks for it again; and fits that compare hypotheses start on voxels of a pixel."""
    place, asked = import_module("holosplat.methods.levels"), list[tuple[float, int]]()
    task = Task(soft, MaterialPrior.unknown(1))
    first = first_of_task(task).at_ratio(777.0)
    asking = import_module("holosplat.methods.cross_validation")
    monkeypatch.setattr(asking, "unseen_ratio", lambda one: pytest.fail("a ratio was asked"))
    assert with_usual_steps(first, first.prior.on_both_sides()).material.ratio == pytest.approx(777.0)

    def solved(method, fitted):
        asked.append((one_material(fitted).ratio, method.gaussians.volume.refine))
        raise NoMatterError

    monkeypatch.setattr(place, "solve_stages", solved)
    TrialFits(task, first, {"levels": METHODS["auto"].kinds["levels"]}).score("as measured", "levels", 0, two=True)
    assert asked == [(pytest.approx(777.0), 1)]
