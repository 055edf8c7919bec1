"""Fits by which hypotheses are compared: the frames that they set aside, and rivals that their own frames refute."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, KnownRatio, MaterialPrior
from holosplat.methods import SmoothVolume, Task
from holosplat.methods.cross_validation import plain_light, predicted_frames
from holosplat.methods.levels import TrialFits
from holosplat.methods.method import first_of_task
from holosplat.methods.trials import FREE, NULL, UNEVEN, Trials
from holosplat.methods.uncertain import Determined
from holosplat.optics.background import LightOptions
from holosplat.scan import Exposures, Scan
from holosplat.specimens.soft_matter import soft_cells

MATTER = DeltaBeta(4e-7, 4e-7 / 1500)
SHAPE, VIEWS = (31, 36), 8
PRIOR = MaterialPrior.of_ratio(MATTER.ratio, 1)


@pytest.fixture(scope="module")
def soft() -> Scan:
    scene = soft_cells(2, (10e-6, 13e-6), (34e-6, 38e-6, 34e-6), MATTER, seed=5, edge=2e-6)
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, SHAPE, 1.5e-6), 20.0, 0.2)
    return simulate(scene, exposures, photons_per_pixel=1e5, seed=3, is_test=np.zeros(VIEWS, dtype=bool))


def uneven(scan: Scan) -> Scan:
    """The same in light that has a slope of its own in each frame."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / np.array(SHAPE)[:, None, None] - 0.5
    slopes = np.random.default_rng(2).normal(size=(VIEWS, 2))
    light = np.stack([1 + 0.1 * (a * x + b * y) for a, b in slopes])
    return replace(scan, frames=(scan.frames * light).astype(np.float32))


@pytest.mark.parametrize(("views", "together"), [(2, 1), (5, 1), (6, 2), (9, 3), (12, 4), (40, 4)])
def test_folds_of_fits_set_a_third_of_the_views_aside(soft, views, together):
    """Each view once at most; of few views they are those of first volumes, whose phase retrieval they share."""
    scan = soft[np.arange(views) % VIEWS]
    first = first_of_task(Task(scan, PRIOR))
    found = first.for_fits
    assert found is first.for_fits
    assert (found is first) == (views < 9)
    aside = [found.folds.aside(k).tolist() for k in range(found.folds.count)]
    assert {len(one) for one in aside} == {together}
    if found is not first:
        assert len({view for one in aside for view in one}) == together * found.folds.count
        assert found._thickness is first._thickness
        assert found.material is first.material
        first.taken = ("correlated noise",)
        assert first.for_fits.taken == first.taken


def test_fits_have_the_ratio_that_was_found(soft):
    """It is not looked for again beside fewer views."""
    scan = soft[np.arange(12) % VIEWS]
    task = Task(scan, MaterialPrior.unknown().signed(1), lit=plain_light(torch.from_numpy(scan.frames), LightOptions()))
    first = first_of_task(task).at_ratio(MATTER.ratio)
    found = Determined("delta_beta", 777.0, 700.0, 800.0, (50.0, 1e4), told=True)
    first.once(("ratio", first.taken), 0, lambda: (found, None))
    prior = TrialFits(task, first, {"continuous": SmoothVolume()})._fitted_to((), "continuous", 0).prior
    assert isinstance(prior, KnownRatio)
    assert prior.ratio == 777.0


@pytest.mark.parametrize(("left", "after", "refuted"), [(3.0, 1.9, True), (3.0, 2.2, False), (1.15, 0.5, False)])
def test_a_volume_that_leaves_its_own_frames_unexplained_is_no_rival_in_free_light(
    soft, monkeypatch, left, after, refuted
):
    """Such light makes up for what it has got wrong, and it predicts unseen frames as well as the candidate does."""
    task = Task(uneven(soft), PRIOR)
    fits = TrialFits(task, first_of_task(task), {"continuous": SmoothVolume()})
    monkeypatch.setattr(TrialFits, "_fit", lambda *_: None)  # no matter: even light
    monkeypatch.setattr(TrialFits, "_unexplained", lambda fits, taken, fold: after if taken else left)
    null, free = (fits.score(name, "continuous", 0) for name in (NULL, NULL + FREE + UNEVEN))
    assert np.array_equal(null.powers, free.powers) is refuted
    assert refuted or free.gain_over(null)[0] > 0.1


def test_frames_in_uneven_light_refute_a_volume_in_even_light(soft):
    """Its χ² is that of the frames it was fitted to, in units of their noise."""
    for scan, refuted in ((soft, False), (uneven(soft), True)):
        task = Task(scan, PRIOR)
        fits = TrialFits(task, first_of_task(task), {"continuous": SmoothVolume(rounds=1)})
        left = fits._unexplained((), 0)
        assert left is not None
        assert (left > 1.2) is refuted
        assert fits.refuted((), UNEVEN, 0) is refuted
        seen = first_of_task(task).folds.split(0)[0]
        frames = torch.from_numpy(seen.frames).double()
        found = fits._fit((), "continuous", 0)
        assert found is not None
        white = Trials(first_of_task(task), task.light).tried((), 0).light.noise.white[:, None, None]
        roots = 2 * (predicted_frames(seen.exposures, found).double().sqrt() - frames.sqrt()) / white
        plain = float(roots.square().mean())
        assert 0.3 < left / plain < 1  # what voxels cannot show counts as noise, too


def test_spherical_matter_has_a_residual_too(soft):
    """Its fit ends as a volume."""
    task = Task(uneven(soft), PRIOR.about_a_point())
    fits = TrialFits(task, first_of_task(task), {"continuous": SmoothVolume()})
    assert fits.refuted((), UNEVEN, 0)
