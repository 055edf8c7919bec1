"""Matter that leaves the frames sideways (interior tomography), and a volume wider than they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.blobs import MATERIAL, PIXEL, SHAPE, blob_lines, blob_scan, blobs
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.baselines.beyond import carried_on, columns_beyond, margins_of
from holosplat.fit.smooth_volume import ContinuousPrior, VolumeProblem
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods.method import Task
from holosplat.methods.modulation import total_delta
from holosplat.methods.volume import SmoothStage, SmoothVolume
from holosplat.methods.voxels import VoxelFit, VoxelStage
from holosplat.optics.noise import NoiseModel
from holosplat.optics.retrieval import bounded_estimate
from holosplat.representations import VoxelGrid
from holosplat.scan import Scan

LEFT = 8
COLUMNS = SHAPE[1] - 2 * LEFT
RATIO = MATERIAL.beta / MATERIAL.delta


def cut() -> Scan:
    """The middle columns of the blobs' frames, which both leave sideways."""
    return blob_scan().cropped(slice(0, SHAPE[0]), slice(LEFT, LEFT + COLUMNS))


def whitened(measured: Scan, columns: int) -> WhitenedFrames:
    noise = NoiseModel.white_only(torch.full((len(measured),), 0.01, dtype=torch.float64), measured.views.shape)
    return WhitenedFrames(measured, MATERIAL, noise, beyond=(0, columns))


def quiet(stage: str, fraction: float) -> None:
    """No progress to show."""


@pytest.mark.parametrize("columns", [3, LEFT, 60])
def test_slopes_of_matter_at_the_sides_are_those_of_the_misfit(columns):
    """Where the wider raster lies within that of the waves, and where it is larger."""
    misfit = whitened(cut(), columns)
    at = 0.9 * blob_lines(misfit.field, boxes=(1, 2)).float() / PIXEL
    gradient = misfit(at).gradient
    assert gradient.shape == (len(at), SHAPE[0], COLUMNS + 2 * columns)
    assert float(gradient[:, :, columns - 1].abs().max()) > 0.01 * float(gradient.abs().max())
    toward = gradient / gradient.abs().max()
    slope = (misfit(at + 0.02 * toward).value - misfit(at - 0.02 * toward).value) / 0.04
    assert float((gradient * toward).sum()) == pytest.approx(slope, rel=5e-3)


def test_frames_know_of_matter_at_their_sides():
    wider, narrow = (whitened(cut(), columns) for columns in (LEFT, 0))
    lines = blob_lines(wider.field, boxes=(1, 2)).float() / PIXEL
    explained, without = wider(lines).value, narrow(lines[:, :, LEFT:-LEFT]).value
    assert 2 * explained / wider.count < 0.1 < 0.1 * without / explained


def test_the_preconditioner_is_on_the_wider_volume():
    problem = VolumeProblem(whitened(cut(), LEFT), ContinuousPrior(), 1.0)
    assert problem.grid.shape == (SHAPE[1], SHAPE[0], SHAPE[1])
    u = 0.8 * blobs(Grid.of_views(problem.frames.field))
    value, slope = problem(u)
    step = problem.preconditioner(u)(slope())
    assert problem((u - 0.1 * step).clamp_min(0))[0] < value


def test_columns_at_the_sides_are_a_share_of_the_frames():
    """Rounded up to what larger pixels divide, too."""
    part = cut()
    assert [columns_beyond(part.views, share) for share in (0.0, 0.1, 0.5, 1.0)] == [0, 4, 8, 16]


def test_what_lies_at_the_sides_is_unknown_and_not_inside():
    """A volume that ends with the frames has it inside, as far as its bounds let it."""
    part, errors = cut(), dict[float, float]()
    truth = blobs(Grid.of_views(part.views))
    for beside in (0.0, 0.5):
        options = HolographicTV(upper=0.0, refine=1, corrections=0, retrieval=30, beside=beside)
        volume, grid = holographic_tv(part, MATERIAL, options, quiet)
        assert (margins_of(grid, part.views)[1] > 0) == (beside > 0)
        found = VoxelGrid(volume[None], grid, Matter.one(1.0, 0.0)).resampled(Grid.of_views(part.views)).values[0]
        errors[beside] = float((found - truth).norm() / truth.norm())
    assert errors[0.5] < min(0.31, 0.95 * errors[0.0])


def test_fits_have_the_voxels_at_the_sides():
    part = cut()
    task = Task(part, MaterialPrior.of_ratio(MATERIAL.ratio), 0, matter="continuous")
    quick = HolographicTV(upper=0.0, refine=1, retrieval=20, iterations=40, corrections=0, beside=0.5)
    stage = SmoothStage(SmoothVolume(quick, rounds=1, iterations=2))
    start = stage.start(task, None)
    columns = margins_of(start.grid, part.views)[1]
    assert columns >= COLUMNS / 2
    fit = stage.fit(task, start)
    assert fit.voxels.grid == start.grid
    assert VoxelStage(VoxelFit(refine=1)).start(task, start).grid == start.grid


def test_retrieval_lets_matter_leave_at_the_sides():
    part = cut()
    frames = torch.from_numpy(part.frames)
    kept, free = (
        bounded_estimate(frames, part.exposures, RATIO, None, (False, sides)).phase for sides in (False, True)
    )
    edge = [0, 1, -2, -1]
    assert float(free[:, :, edge].sum()) > float(kept[:, :, edge].sum())


def test_the_total_is_that_of_the_field_between_the_sides():
    part = cut()
    field = part.views.padded((0, LEFT))
    u = blobs(Grid.of_views(field))
    found = VoxelGrid(0.9 * u[None], Grid.of_views(field), Matter.one(*MATERIAL))
    noise = NoiseModel.white_only(torch.full((len(part),), 0.005, dtype=torch.float64), part.views.shape)
    total = total_delta(found, part, noise)
    inside = slice(LEFT, -LEFT)
    truth = float(u[inside, :, inside].sum()) * PIXEL**3 * MATERIAL.delta
    assert total.held / truth == pytest.approx(0.9, rel=1e-3)


def test_images_go_on_as_their_outermost_columns():
    image = torch.arange(6.0).reshape(1, 2, 3)
    assert carried_on(image, 0, 2)[0, 1].tolist() == [3, 3, 3, 4, 5, 5, 5]
    np.testing.assert_array_equal(carried_on(image, 1, 1)[0, 0], [0, 0, 1, 2, 2])
