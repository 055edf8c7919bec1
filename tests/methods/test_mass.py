"""The total δ that frames know: right in noise, whatever a fit has lost, with an error that says how far it is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, Matter
from holosplat.methods.modulation import MODEL_SHARE, RATIO_SHARE, total_delta
from holosplat.optics.noise import NoiseModel
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.soft_matter import soft_cells

PIXEL, SHAPE, VIEWS = 1e-6, (41, 45), 8
MATERIAL = DeltaBeta(6e-7, 4e-10)
CELLS = soft_cells(2, (15 * PIXEL, 18 * PIXEL), (40e-6, 38e-6, 40e-6), MATERIAL, seed=3, edge=3 * PIXEL)
TRUE = CELLS.mass.delta


@pytest.fixture(scope="module")
def quiet() -> Scan:
    """Eight views of two soft cells without noise."""
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, SHAPE, PIXEL), 20.0, 0.05)
    return simulate(CELLS, exposures, is_test=np.zeros(VIEWS, dtype=bool))


@pytest.fixture(scope="module")
def volume(quiet) -> VoxelGrid:
    """The true volume on voxels of a pixel."""
    grid = Grid.of_views(quiet.views)
    values = torch.from_numpy(np.asarray(CELLS.voxelise(grid).delta)) / MATERIAL.delta
    return VoxelGrid(values[None].float(), grid, Matter.one(*MATERIAL))


def scaled(volume: VoxelGrid, factor: float) -> VoxelGrid:
    return volume.with_parameters({"values": factor * volume.values})


def noisy(scan: Scan, seed: int) -> tuple[Scan, NoiseModel]:
    """The scan in noise equal to its contrast, and that noise."""
    sigma = float(np.sqrt(np.square(scan.frames - 1).mean()))
    counts = np.random.default_rng(seed).poisson(scan.frames / sigma**2)
    noise = NoiseModel.white_only(torch.full((VIEWS,), sigma, dtype=torch.float64), SHAPE)
    return replace(scan, frames=(counts * sigma**2).astype(np.float32)), noise


def test_without_noise_it_is_right_whatever_the_volume_has_lost(quiet, volume):
    noise = NoiseModel.of_frames(torch.from_numpy(quiet.frames))
    for factor in (1.0, 0.6, 1.3):
        found = total_delta(scaled(volume, factor), quiet, noise)
        assert found.value == pytest.approx(TRUE, rel=0.02)
        assert found.held == pytest.approx(factor * TRUE, rel=0.01)
        assert found.share == pytest.approx(MODEL_SHARE, rel=0.2)


@pytest.mark.parametrize("left", [0.9, 0.4])
def test_in_noise_it_is_unbiased_and_within_its_error(quiet, volume, left):
    """Noise equal to the contrast, over its seeds, for a volume that lost a tenth, or most of it."""
    deviations, values = [], []
    for seed in range(8):
        found = total_delta(scaled(volume, left), *noisy(quiet, seed))
        deviations.append((found.value - TRUE) / found.error)
        values.append(found.value / TRUE)
        assert 0.03 < found.share < 0.2
    assert np.mean(values) == pytest.approx(1.0, abs=0.08)
    assert np.sqrt(np.square(deviations).mean()) < 1.6
    assert np.std(deviations) > 0.3


def test_blurred_shapes_bias_high_frequencies_alone(quiet, volume):
    """A blurred volume makes fringes too faint; the range of low frequencies that is taken knows better than all."""
    blurred = torch.nn.functional.avg_pool3d(volume.values[None], 7, stride=1, padding=3)[0]
    found = total_delta(volume.with_parameters({"values": blurred}), *noisy(quiet, 1))
    assert found.value == pytest.approx(TRUE, abs=2.5 * found.error)
    assert found.value == pytest.approx(TRUE, rel=0.12)


def test_the_model_of_the_object_counts_rather_than_its_voxels(quiet, volume):
    """Frames that a model of its own predicts as they were measured leave nothing to correct."""
    finer = scaled(volume, 0.8)
    noise = NoiseModel.of_frames(torch.from_numpy(quiet.frames))
    found = total_delta(finer, quiet, noise, torch.from_numpy(quiet.frames))
    assert found.value == pytest.approx(0.8 * TRUE, rel=0.01)


def test_a_ratio_that_was_estimated_is_a_doubt(quiet, volume):
    found = total_delta(volume, quiet, NoiseModel.of_frames(torch.from_numpy(quiet.frames)), ratio_doubt=RATIO_SHARE)
    assert found.share == pytest.approx(RATIO_SHARE, rel=0.1)


def test_a_volume_without_matter_has_no_mass(quiet, volume):
    with pytest.raises(InputError, match="a volume without matter"):
        total_delta(scaled(volume, 0.0), quiet, NoiseModel.of_frames(torch.from_numpy(quiet.frames)))
