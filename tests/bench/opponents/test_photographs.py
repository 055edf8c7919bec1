"""Holograms taken for photographs: how δ is read off, resets of opacities, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.contract import MATERIAL, two_balls
from holosplat.fit.misfit_diagnosis import cause_scores
from holosplat.fit.residuals import Prediction, residuals
from holosplat.matter import Matter
from holosplat.methods import Task
from holosplat.optics.retrieval import paganin
from holosplat_bench.opponents.photographed import AlphaCloud
from holosplat_bench.opponents.photographs import AlphaRates, AlphaSplats, ReadDelta


@pytest.fixture(scope="module")
def scan() -> hs.Scan:
    return two_balls().train()


@pytest.fixture(scope="module")
def task(scan) -> Task:
    return Task(scan, hs.MaterialPrior.known(MATERIAL))


def start(scan: hs.Scan) -> AlphaCloud:
    return AlphaCloud.random(60, scan.views, torch.from_numpy(scan.frames), Matter.one(*MATERIAL), 0)


def test_delta_is_read_off_retrieved_thickness(scan, task):
    """What is left of the thickness is orthogonal to the lines, and the ratio of δ and β stays."""
    read = ReadDelta().start(task, start(scan))
    thickness = paganin(torch.from_numpy(scan.frames), scan.exposures, *MATERIAL)
    lines = read.project(scan.views)[1] / MATERIAL.delta
    left = ((thickness - lines) * lines).sum() / lines.square().sum()
    assert abs(float(left)) < 1e-4
    assert float((thickness * lines).sum()) > 0
    assert read.matter.channels[0].ratio == pytest.approx(MATERIAL.ratio, rel=1e-6)


def test_density_that_has_nothing_in_common_with_the_frames_is_refused(scan, task):
    inverted = replace(task, scan=replace(scan, frames=2 - scan.frames))
    with pytest.raises(hs.InputError, match="nothing in common"):
        ReadDelta().start(inverted, start(scan))


def test_opacities_are_reset_in_the_first_half(scan, task):
    """To one hundredth at most, and only where it is due; grey values stay."""
    still = AlphaRates(0.0, 0.0, 0.0, 0.0, 0.0)
    options = AlphaSplats(start_per_pixel=0.05, rates=still, reset_every=2)
    options = replace(options, schedule=replace(options.schedule, steps=5), density=replace(options.density, every=0))
    fit = options.stages()[0].fit(task, start(scan))
    opacity = []
    for step in range(1, 6):
        fit.run(lambda record: None, until=step)
        opacity.append(float(fit.model.object.amplitudes.detach().max()))
    assert np.allclose(opacity, [0.1, 0.01, 0.01, 0.01, 0.01], rtol=1e-4)
    assert torch.equal(fit.model.object.raw_greys, start(scan).raw_greys)


def test_wave_optics_explains_nothing_of_photographs(scan):
    """Photographs of a detector that is elsewhere ask for its shift alone, not for matter, distances or blurs."""
    seen, views = start(scan), scan.views
    moved = replace(views, shifts=views.shifts + np.array([0.3 * views.pitch, 0.0]))
    noise = torch.tensor(1e-9).expand(len(scan), views.shape[0], views.shape[1] // 2 + 1)
    found = residuals(Prediction(seen, scan.exposures, 1), seen.photographs(moved).detach(), noise)
    cause = cause_scores(found)
    assert [cause[name].gain for name in ("mass", "absorption", "distance", "blur")] == [0.0] * 4
    assert cause["shift_x"].value[0] == pytest.approx(0.3, rel=0.1)


def test_splats_need_a_start():
    with pytest.raises(hs.InputError, match="start_per_pixel must be a positive number"):
        AlphaSplats(start_per_pixel=0.0)
