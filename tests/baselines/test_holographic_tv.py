"""Classical reconstructions: the primal–dual solver, holographic tomography, binned scans, material estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.holographic import CELL, PIXEL, SHAPE, cells, scan_of
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.baselines.holographic_tv import Correction
from holosplat.baselines.material import estimate_delta
from holosplat.baselines.tomography import plateau
from holosplat.beamline.light import UnevenLight
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.materials import PLASMA, RED_CELL, DeltaBeta
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.metrics import dice
from holosplat.model import measure
from holosplat.optics.background import LightOptions
from holosplat.optics.propagation import poisson
from holosplat.projectors.voxels import LatticeProjector, SliceProjector, projector_for, voxel_line_integrals
from holosplat.projectors.voxels.lattice import lattice_reference
from holosplat.scan import Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene

IN_PLASMA = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))


def quiet(stage: str, fraction: float) -> None:
    """No progress to show."""


def balls(material: DeltaBeta) -> MeshScene:
    """Two balls, for small fields."""
    vertices, faces = icosphere(3)
    places = (([-4, 2, 3], 4.0), ([4, -3, -2], 4.5))
    meshes = [TriangleMesh(PIXEL * (radius * vertices + np.array(centre)), faces) for centre, radius in places]
    return MeshScene.of_one_material(meshes, material)


@pytest.fixture(scope="module")
def cell_scan() -> Scan:
    return scan_of(cells(CELL), Views.evenly_spaced(8, SHAPE, PIXEL))


@pytest.fixture(scope="module")
def plasma_scan() -> Scan:
    return scan_of(cells(IN_PLASMA), Views.evenly_spaced(8, SHAPE, PIXEL))


def overlap(volume: torch.Tensor, grid: Grid, scene: MeshScene) -> float:
    """Dice of the occupancy with the scene's own voxels."""
    truth = scene.voxelise(grid).delta / scene.materials[0].delta
    return dice(volume.numpy() > 0.5, truth > 0.5)


USUAL = HolographicTV(weight=0.3, iterations=60, corrections=4, inner=12, refine=1)


def test_cells_are_found_from_eight_views(cell_scan):
    volume, grid = holographic_tv(cell_scan, CELL, USUAL, quiet)
    assert overlap(volume, grid, cells(CELL)) > 0.94
    assert 0 <= float(volume.min()) < float(volume.max()) <= 1
    views, refine = cell_scan.views, grid.shape[1] // SHAPE[0]
    assert grid.shape == (40 * refine, 36 * refine, 40 * refine)
    assert grid.voxel_size == pytest.approx((PIXEL / refine,) * 3)
    assert grid.origin == pytest.approx(Grid.of_views(views, refine).origin)


@pytest.mark.parametrize("corrections", [4, 12])
def test_cells_in_plasma_are_found_though_they_absorb_less(plasma_scan, corrections):
    """Δβ < 0: there is no δ/β; more corrections must not undo what fewer found."""
    options = replace(USUAL, corrections=corrections)
    volume, grid = holographic_tv(plasma_scan, IN_PLASMA, options, quiet)
    assert overlap(volume, grid, cells(IN_PLASMA)) > 0.93


def test_balls_are_found_from_views_of_any_orientation():
    """Views that share no axis (and shifted detectors) go through the lattice projector."""
    rotations = Rotation.random(6, random_state=3).as_matrix()
    shifts = PIXEL * np.random.default_rng(0).uniform(-1, 1, (6, 2))
    views = Views(rotations, shifts, (20, 24), PIXEL)
    scene = balls(CELL)
    assert scene.missing_field(views) < 0
    assert isinstance(projector_for(Grid.of_views(views), views), LatticeProjector)
    options = HolographicTV(iterations=30, corrections=2, inner=8, refine=1)
    volume, grid = holographic_tv(scan_of(scene, views), CELL, options, quiet)
    assert overlap(volume, grid, scene) > 0.93


def test_views_about_one_axis_may_have_shifted_detectors():
    shifts = PIXEL * np.stack([np.linspace(-3, 3, 7), np.zeros(7)], axis=1)
    views = Views(rotation_y(np.arange(7) * 180 / 7), shifts, (20, 24), PIXEL)
    scene = balls(CELL)
    assert isinstance(projector_for(Grid.of_views(views), views), SliceProjector)
    volume, grid = holographic_tv(scan_of(scene, views), CELL, USUAL, quiet)
    assert overlap(volume, grid, scene) > 0.93


def test_views_about_one_axis_may_be_shifted_along_it_by_part_of_a_pixel():
    """Rows that do not match (as after binning an odd number of them) go through the lattice projector."""
    views = Views(
        rotation_y(10 + np.arange(7) * 180 / 7),
        PIXEL * np.stack([np.zeros(7), np.linspace(-0.5, 0.5, 7)], axis=1),
        (20, 24),
        PIXEL,
    )
    grid, scene = Grid.of_views(views), balls(CELL)
    projector = projector_for(grid, views)
    assert isinstance(projector, LatticeProjector)
    full = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    lines, wanted = projector.project(full), lattice_reference(full, grid, views)
    np.testing.assert_allclose(lines, wanted, rtol=0, atol=1e-5 * float(wanted.max()))
    volume, grid = holographic_tv(scan_of(scene, views), CELL, USUAL, quiet)
    assert overlap(volume, grid, scene) > 0.93


def test_corrections_explain_what_is_missing_as_far_as_noise_lets(cell_scan):
    """Of thickness that is missing, half is given back at once, and less where noise hides it; of noise, no matter."""
    lines, shares = cells(CELL).project(cell_scan.views)[1] / CELL.delta, []
    for photons in (None, 1e4, 1e3):
        frames = poisson(cell_scan.frames, photons, 0) if photons else cell_scan.frames
        correction = Correction(replace(cell_scan, frames=frames), CELL)
        found = correction(torch.from_numpy(cell_scan.frames - 1))
        shares.append(float((found * lines).sum() / lines.square().sum()))
        alone = correction(torch.from_numpy(frames - cell_scan.frames))
        assert float(alone.norm() / lines.norm()) < 0.1
    assert 1 > shares[0] > 0.5 > shares[1] > shares[2] > 0


class Voxels:
    """A volume of one material as an Object."""

    def __init__(self, volume: torch.Tensor, grid: Grid, material: DeltaBeta) -> None:
        self.volume, self.grid, self.material = volume, grid, material

    def at(self, time: float) -> Voxels:
        return self

    def project(self, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
        lines = voxel_line_integrals(self.volume[None], self.grid, views)[:, 0]
        return lines * self.material.beta, lines * self.material.delta


@pytest.mark.parametrize("material", [CELL, IN_PLASMA], ids=["in vacuum", "in plasma"])
def test_corrections_bring_the_volume_in_agreement_with_the_holograms(request, material):
    scan = request.getfixturevalue("cell_scan" if material is CELL else "plasma_scan")
    errors, dices = [], []
    for corrections in (0, 4):
        volume, grid = holographic_tv(scan, material, replace(USUAL, corrections=corrections, refine=0), quiet)
        predicted = measure(Voxels(volume, grid, material), scan.exposures, 2).numpy()
        errors.append(float(np.abs(predicted - scan.frames).mean() / np.abs(scan.frames - 1).mean()))
        dices.append(overlap(volume, grid, cells(material)))
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.4
    assert min(dices) > 0.94  # noise-aware retrieval is good at this by itself; the corrections must not spoil it
    assert dices[1] > dices[0] - 0.015


def test_noisy_frames_get_no_rounds_of_agreement(cell_scan):
    noisy = replace(cell_scan, frames=poisson(cell_scan.frames, 300, 0))
    options = replace(USUAL, corrections=1)
    for scan, rounds in ((cell_scan, True), (noisy, False)):
        volume, without = (holographic_tv(scan, CELL, o, quiet)[0] for o in (options, replace(options, corrections=0)))
        assert (volume.shape != without.shape or not torch.equal(volume, without)) == rounds


def test_few_views_get_more_steps_a_round(cell_scan):
    few = cell_scan[np.arange(0, 8, 2)]
    options = replace(USUAL, corrections=1, inner=5)
    as_it_is, _ = holographic_tv(few, CELL, options, quiet)
    twice, _ = holographic_tv(few, CELL, replace(options, inner=10, few_views=0), quiet)
    assert torch.equal(as_it_is, twice)


def test_too_many_voxels_become_larger_ones(cell_scan):
    for most, shape in ((60_000, (40, 36, 40)), (30_000, (20, 18, 20)), (5_000, (13, 12, 13))):
        options = replace(USUAL, max_voxels=most, corrections=1)
        volume, grid = holographic_tv(cell_scan, CELL, options, quiet)
        assert volume.shape == shape == grid.shape
        assert volume.numel() <= most
        factor = 40 // shape[0]
        assert grid.voxel_size == pytest.approx((factor * PIXEL,) * 3)
        assert overlap(volume, grid, cells(CELL)) > (0.9, 0.8, 0.7)[factor - 1]


def test_progress_is_told_stage_by_stage(cell_scan):
    told: list[tuple[str, float]] = []
    holographic_tv(cell_scan, CELL, replace(USUAL, iterations=25), lambda *step: told.append(step))
    stages = list(dict.fromkeys(stage for stage, _ in told))
    assert stages == ["phase retrieval", "tomography", "agreement with the holograms"]
    assert all(0 <= fraction <= 1 for _, fraction in told)
    assert [fraction for stage, fraction in told if stage == "tomography"] == pytest.approx([k / 25 for k in range(25)])


def test_iterations_are_counted(cell_scan):
    some, more, same = (
        holographic_tv(cell_scan, CELL, replace(USUAL, iterations=n, corrections=0), quiet)[0] for n in (5, 10, 5)
    )
    assert torch.equal(some, same)
    assert not torch.equal(some, more)


def test_no_iterations_are_refused(cell_scan):
    with pytest.raises(InputError, match="iterations"):
        holographic_tv(cell_scan, CELL, HolographicTV(iterations=0), quiet)


# --- what the holograms say about the material --------------------------------------------------------------


def test_delta_is_found_where_the_ratio_is_known(cell_scan):
    assert estimate_delta(cell_scan, CELL.ratio, quiet) == pytest.approx(CELL.delta, rel=0.15)


def test_the_plateau_is_the_mass_weighted_median():
    """Half of the matter lies at or below it; empty and negative voxels do not count."""
    assert plateau(torch.tensor([[[0.0, 1.0, 2.0, 3.0, -9.0]]])) == 2  # masses 1, 2, 3: half of 6 is reached at 2
    assert plateau(torch.tensor([[[0.1] * 5 + [1.0] * 4 + [7.0]]])) == 7  # 0.5 + 4 < 7
    assert plateau(torch.tensor([[[1.0] * 9 + [11.0]]])) == 11  # 9 < 20 / 2
    assert plateau(torch.tensor([[[0.1] * 5 + [1.0] * 4 + [3.0]]])) == 1
    with pytest.raises(InputError, match="no matter"):
        plateau(torch.zeros(2, 2, 2))


def test_the_start_finds_light_that_drifts_anew_beside_the_matter():
    """Air says little of light behind bodies: what is left there would be matter, alike in neighbouring views."""
    scan = scan_of(cells(CELL), Views.evenly_spaced(8, SHAPE, PIXEL))
    lamp = UnevenLight(light_pattern=0.04, light_pattern_px=8.0, light_drift_px=20.0, light_seed=1).on(8, SHAPE)
    rng = np.random.default_rng(0)
    frames = np.stack([lamp.recorded(frame, n, 1e5, rng) for n, frame in enumerate(scan.frames)]).astype(np.float32)
    task = prepared(Task(replace(scan, frames=frames), MaterialPrior.known(CELL), light=LightOptions("smooth")))
    assert task.uneven is not None
    errors = []
    for relit in (0, 2):
        options = HolographicTV(iterations=80, corrections=0, relit=relit)
        volume, grid = holographic_tv(task.scan, CELL, options, quiet, task.uneven)
        truth = cells(CELL).voxelise(grid).delta / CELL.delta
        errors.append(float(np.linalg.norm(volume.numpy() - truth) / np.linalg.norm(truth)))
    assert errors[1] < 0.4 * errors[0]
