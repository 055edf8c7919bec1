"""Matter that goes on above and below the frames: where it is noticed, and what a taller volume makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.blobs import MATERIAL, PIXEL, SHAPE, blob_lines, blob_scan, blobs
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.baselines.beyond import carried_on, margins_of, rows_beyond
from holosplat.baselines.holographic_tv import Correction
from holosplat.fit.smooth_volume import ContinuousPrior, VolumeProblem
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods.method import Task
from holosplat.methods.modulation import total_delta
from holosplat.methods.surface_fit import field_of
from holosplat.methods.volume import SmoothStage, SmoothVolume
from holosplat.optics.noise import NoiseModel
from holosplat.optics.retrieval import bounded_estimate
from holosplat.optics.retrieval.bounded import NOWHERE
from holosplat.representations import GaussianCloud, VoxelGrid
from holosplat.representations.initialise import cloud_from_volume
from holosplat.scan import Scan

TOP, ROWS, BEYOND = 7, 11, 4
RATIO = MATERIAL.beta / MATERIAL.delta


def cut(top: int = TOP, rows: int = ROWS, photons: float | None = None) -> Scan:
    """The middle rows of the blobs' frames, in which both go on above and below."""
    return blob_scan(photons=photons).cropped(slice(top, top + rows), slice(0, SHAPE[1]))


def whitened(measured: Scan, beyond: int) -> WhitenedFrames:
    noise = NoiseModel.white_only(torch.full((len(measured),), 0.01, dtype=torch.float64), measured.views.shape)
    return WhitenedFrames(measured, MATERIAL, noise, beyond=(beyond, 0))


def quiet(stage: str, fraction: float) -> None:
    """No progress to show."""


def test_frames_know_of_matter_beyond_them():
    """Lines in closed form, with the blurs of a projector's: they explain the frames where none are left out."""
    taller, short = (whitened(cut(), beyond) for beyond in (BEYOND, 0))
    lines = blob_lines(taller.field, boxes=(1, 2)).float() / PIXEL
    assert lines.shape == (6, ROWS + 2 * BEYOND, SHAPE[1])
    explained, without = taller(lines).value, short(lines[:, BEYOND:-BEYOND]).value
    assert 2 * explained / taller.count < 0.1 < 0.1 * without / explained


def test_slopes_of_matter_beyond_are_those_of_the_misfit():
    misfit = whitened(cut(), BEYOND)
    at = 0.9 * blob_lines(misfit.field, boxes=(1, 2)).float() / PIXEL
    gradient = misfit(at).gradient
    assert float(gradient[:, BEYOND - 1].abs().max()) > 0.01 * float(gradient.abs().max())
    toward = gradient / gradient.abs().max()
    slope = (misfit(at + 0.02 * toward).value - misfit(at - 0.02 * toward).value) / 0.04
    assert float((gradient * toward).sum()) == pytest.approx(slope, rel=5e-3)


def test_the_preconditioner_is_on_the_taller_volume():
    problem = VolumeProblem(whitened(cut(), BEYOND), ContinuousPrior(), 1.0)
    assert problem.grid.shape == (SHAPE[1], ROWS + 2 * BEYOND, SHAPE[1])
    u = 0.8 * blobs(Grid.of_views(problem.frames.field))
    value, slope = problem(u)
    step = problem.preconditioner(u)(slope())
    assert problem((u - 0.1 * step).clamp_min(0))[0] < value


def test_matter_is_noticed_where_it_leaves_the_frames_and_nowhere_else():
    whole, part = blob_scan(), cut()
    volume = blobs(Grid.of_views(whole.views))
    inside = volume[:, TOP : TOP + ROWS]
    assert rows_beyond(volume, whole, RATIO) == 0
    assert rows_beyond(inside, part, RATIO) % 4 == 0 < rows_beyond(inside, part, RATIO)
    assert rows_beyond(volume[:, TOP:], cut(TOP, SHAPE[0] - TOP), RATIO) > 0
    contact = replace(part, exposures=replace(part.exposures, distance=np.zeros(len(part))))
    assert rows_beyond(inside, contact, RATIO) == 0
    column = np.cos(np.pi * np.arange(SHAPE[1]) / SHAPE[1])
    lit = replace(whole, frames=(whole.frames * (1 + 0.02 * column)).astype(np.float32))
    assert rows_beyond(volume + 0.3 * volume.mean(), lit, RATIO) == 0  # as smooth light would have it


def test_a_volume_of_cut_frames_keeps_its_matter():
    """Air beyond the frames takes a part of it away, as of a volume that ends with them."""
    part, options = cut(5, 15, 20_000), HolographicTV(upper=0.0, refine=1, noisy=1.0)
    volume, grid = holographic_tv(part, MATERIAL, options, quiet)
    beyond, _ = margins_of(grid, part.views)
    truth = blobs(Grid.of_views(part.views))
    found = volume[:, beyond:-beyond]
    assert 0.84 < float(found.sum() / truth.sum()) < 1.1
    assert float((found - truth).norm() / truth.norm()) < 0.17


def test_a_smooth_volume_of_cut_frames_goes_on_beyond_them():
    """Without noise a tenth of the contrast stands for it."""
    part = cut(5, 15)
    task = Task(part, MaterialPrior.of_ratio(MATERIAL.ratio), 0, matter="continuous")
    quick = HolographicTV(upper=0.0, refine=1, retrieval=20, iterations=40, corrections=0)
    stage = SmoothStage(SmoothVolume(quick, rounds=1, iterations=2))
    start = stage.start(task, None)
    assert margins_of(start.grid, part.views)[0] > 0
    fit = stage.fit(task, start)
    assert fit.voxels.grid == start.grid
    contrast = np.sqrt(np.square(part.frames - 1.0).mean(axis=(1, 2)))
    assert (task.noise.white.numpy() < 0.05 * contrast).all()
    assert np.allclose(fit.plan.noise.white.numpy(), 0.1 * contrast)


def test_retrieval_and_corrections_go_on_beyond_the_frames():
    part = cut()
    frames, missing = torch.from_numpy(part.frames), torch.from_numpy(part.frames) - 1
    kept, free = (
        bounded_estimate(frames, part.exposures, RATIO, None, leaves).phase for leaves in (NOWHERE, (True, False))
    )
    assert float(free[:, :2].sum() + free[:, -2:].sum()) > float(kept[:, :2].sum() + kept[:, -2:].sum())
    inside, taller = (Correction(part, MATERIAL, beyond)(missing) for beyond in (0, BEYOND))
    assert taller.shape == (6, ROWS + 2 * BEYOND, SHAPE[1])
    assert torch.equal(taller[:, BEYOND:-BEYOND], inside)
    assert float(taller[:, BEYOND - 1].abs().max()) > 0.05 * float(inside.abs().max())


def test_the_total_is_that_of_the_field_of_view():
    part = cut()
    field = part.views.taller(BEYOND)
    u = blobs(Grid.of_views(field))
    found = VoxelGrid(0.9 * u[None], Grid.of_views(field), Matter.one(*MATERIAL))
    noise = NoiseModel.white_only(torch.full((len(part),), 0.005, dtype=torch.float64), part.views.shape)
    total = total_delta(found, part, noise)
    truth = float(u[:, BEYOND:-BEYOND].sum()) * PIXEL**3 * MATERIAL.delta
    assert total.value / truth == pytest.approx(1, rel=0.03)
    assert total.held / truth == pytest.approx(0.9, rel=1e-3)


def test_gaussians_beyond_the_frames_make_the_field_taller():
    views = Views.evenly_spaced(2, (ROWS, SHAPE[1]), PIXEL)

    def cloud(beyond: int) -> GaussianCloud:
        grid = Grid.of_views(views.taller(beyond))
        return cloud_from_volume(blobs(grid), grid, MATERIAL, 2 * PIXEL, PIXEL)

    assert field_of(cloud(0), views).shape == views.shape
    assert field_of(cloud(BEYOND), views).shape == (ROWS + 2 * BEYOND, SHAPE[1])


def test_images_go_on_as_their_outermost_rows():
    image = torch.arange(6.0).reshape(1, 2, 3)
    assert carried_on(image, 2)[0, :, 0].tolist() == [0, 0, 0, 3, 3, 3]
    assert carried_on(image, 0) is image
