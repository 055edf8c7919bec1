"""Tomographies of thickness: what each method has on paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.discs import ANGLES, PITCH, anyhow, ball_lines, ball_truth, quiet, turned
from holosplat.baselines import PrimalDual
from holosplat.baselines.algebraic import (
    Algebraic,
    Ramp,
    _masks,
    _orthogonal_sets,
    angular_weights,
    art,
    filtered_backprojection,
    ramp,
    sirt,
)
from holosplat.baselines.rays import rays_of
from holosplat.baselines.tomography import TotalVariation, misfit_spectrum, total_variation
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.projectors.voxels import LatticeProjector, SliceProjector
from holosplat.projectors.voxels.slices import voxel_shadows

# --- filtered back-projection -------------------------------------------------------------------------------


def test_the_ramp_is_that_of_kak_and_slaney():
    """|f| but for the lowest frequencies, and at zero not zero: the kernel's sum over the padded length."""
    response, frequency = ramp(1024, Ramp("ramlak", 1.0)), np.fft.rfftfreq(1024)
    assert np.abs(response.numpy() - frequency)[1:-1].max() < 1e-3
    assert 0 < float(response[0]) < 1e-3
    kernel = torch.fft.irfft(response, n=1024)
    assert torch.allclose(kernel[:4], torch.tensor([0.25, -1 / np.pi**2, 0, -1 / (9 * np.pi**2)]).double())


def test_the_windows_end_where_they_should():
    for window, end in (("ramlak", 1.0), ("shepp-logan", 2 / np.pi), ("hann", 0.0)):
        found = ramp(64, Ramp(window, 0.5)) / ramp(64, Ramp("ramlak", 1.0))
        assert float(found[0]) == pytest.approx(1)
        assert float(found[16]) == pytest.approx(end, abs=1e-12)
        assert float(found[17:].abs().max()) == 0


def test_angular_weights_are_half_the_gaps():
    weights = np.rad2deg(angular_weights(turned([0.0, 170.0, 200.0, 90.0])).numpy())  # 200° is 20°
    assert weights == pytest.approx([15, 45, 45, 75])
    assert np.rad2deg(angular_weights(turned([33.0])).numpy()) == pytest.approx(180)
    assert np.rad2deg(angular_weights(turned([10.0, 10.0, 100.0])).numpy()) == pytest.approx([45, 45, 90])


@pytest.mark.parametrize("count", [90, 181])
def test_a_disc_is_flat_after_filtered_backprojection(count):
    """With many views: one inside and zero outside, to a few per mille, on any row."""
    views = turned(list(np.arange(count) * 180 / count), (2, 61), pitch=1.0)
    j = (np.arange(61 * 32) + 0.5) / 32 - 30.5
    chord = 2 * np.sqrt(np.clip(20.0**2 - j**2, 0, None)).reshape(61, 32).mean(1)
    lines = torch.from_numpy(chord).float().expand(count, 2, 61)
    grid = Grid.of_views(views)
    volume = filtered_backprojection(lines, views, grid, None, quiet, options=Ramp("ramlak", 1.0))
    x, _, z = grid.axes()
    radius = np.hypot(x, z[:, None])
    inside, outside = volume[:, 0].numpy()[radius < 15], volume[:, 0].numpy()[(radius > 25) & (radius < 29)]
    assert inside.mean() == pytest.approx(1, abs=2e-3)
    assert np.abs(outside.mean()) < 2e-3
    assert inside.std() < 0.02
    assert torch.equal(volume[:, 0], volume[:, 1])
    assert torch.allclose(volume, volume.flip(2), atol=1e-3)  # no part of a pixel aside


def test_the_disc_is_nearer_with_finer_pixels():
    """The error inside a disc falls at least in proportion to the pixel."""
    errors = []
    for width in (31, 61, 121):
        views = turned(list(np.arange(240) * 0.75), (1, width), pitch=1 / width)
        j = ((np.arange(width * 16) + 0.5) / 16 - width / 2) / width
        chord = 2 * np.sqrt(np.clip(0.3**2 - j**2, 0, None)).reshape(width, 16).mean(1)
        grid = Grid.of_views(views)
        lines = torch.from_numpy(chord).float().expand(240, 1, width)
        volume = filtered_backprojection(lines, views, grid, None, quiet, options=Ramp("hann", 1.0))[:, 0].numpy()
        x, _, z = grid.axes()
        errors.append(np.abs(volume - 1)[np.hypot(x, z[:, None]) < 0.2].mean())
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]


# --- algebraic ----------------------------------------------------------------------------------------------


def dense(views: Views) -> tuple[np.ndarray, np.ndarray, Grid]:
    """The slice matrix in pixels, random lines of one slice, and the grid, in float64."""
    flat = Views(views.rotations, views.shifts / PITCH, views.shape, 1.0)
    grid = Grid.of_views(flat)
    lines = np.random.default_rng(0).uniform(0, 3, (len(views), 1, views.shape[1]))
    return voxel_shadows(grid, flat).toarray().T.astype(float), lines, Grid.of_views(views)


@pytest.mark.parametrize("begun", [False, True], ids=["from zero", "from a start"])
def test_sirt_is_that_of_gregor_and_benson(begun):
    """Three sweeps against the formula, with a full matrix in float64; a start's own lines are not in those given."""
    views = turned(ANGLES[:4], (1, 9))
    matrix, lines, grid = dense(views)
    per_ray, per_voxel = 1 / matrix.sum(1), 1 / matrix.sum(0)
    start = np.random.default_rng(1).uniform(0, 0.4, 81) if begun else np.zeros(81)
    x, beyond = start, lines - (matrix @ start).reshape(lines.shape)
    for _ in range(3):
        x = np.clip(x + 1.3 * per_voxel * (matrix.T @ (per_ray * (lines.ravel() - matrix @ x))), 0, 0.4)
    options = Algebraic(sweeps=3, relaxation=1.3, nonnegative=True)
    given = torch.from_numpy(start).float().reshape(9, 1, 9)
    known = {"options": options, "start": given if begun else None}
    found = sirt(torch.from_numpy(PITCH * beyond), views, grid, 0.4, quiet, **known)
    assert np.abs(found.numpy().ravel() - x).max() < 1e-5
    assert torch.equal(given, torch.from_numpy(start).float().reshape(9, 1, 9))


def test_art_is_that_of_kaczmarz():
    """Two sweeps against ray after ray, in the order of the views and of their sets."""
    views = turned(ANGLES[:4], (1, 9))
    matrix, lines, grid = dense(views)
    rows, values = matrix.reshape(4, 9, 81), lines.reshape(4, 9)
    x = np.zeros(81)
    for _ in range(2):
        for v in np.argsort(np.arange(4) * 0.5 * (np.sqrt(5) - 1) % 1):
            for j in (j for first in range(3) for j in range(first, 9, 3)):
                x = x + 0.7 * rows[v, j] * (values[v, j] - rows[v, j] @ x) / (rows[v, j] @ rows[v, j])
    options = Algebraic(sweeps=2, relaxation=0.7)
    found = art(torch.from_numpy(PITCH * lines), views, grid, None, quiet, options=options)
    assert np.abs(found.numpy().ravel() - x).max() < 1e-5


@pytest.mark.parametrize("views", [turned(), anyhow(3, (9, 11))], ids=["slices", "lattice"])
@pytest.mark.parametrize("refine", [1, 2])
def test_rays_of_a_set_share_no_voxel(views, refine):
    """A Aᵀ is diagonal on each set: a ray's own backprojection reaches no other of its set."""
    rays = rays_of(torch.zeros(len(views), *views.shape), views, Grid.of_views(views, refine))
    assert type(rays.projector) is (SliceProjector if views.shares_axis else LatticeProjector)
    masks = _masks(rays)
    assert torch.equal(sum(masks), torch.ones(1, *rays.views.shape))
    signs = torch.randint(0, 2, (1, *rays.views.shape), generator=torch.Generator().manual_seed(0)) * 2.0 - 1
    for view in _orthogonal_sets(rays)[:3]:
        for mask, scale in zip(masks, view.scales):
            chosen = view.projector.lines_in(mask * signs)
            back = view.projector.project(view.projector.backproject(chosen)) * scale
            seen = scale > 0
            assert torch.allclose(back[seen], chosen[seen], atol=1e-4)


def test_algebraic_methods_converge_to_what_explains_the_lines():
    views = turned(ANGLES[:5])
    lines, grid = ball_lines(views), Grid.of_views(views)
    for method, sweeps in ((sirt, 300), (art, 60)):
        volume = method(lines, views, grid, None, quiet, options=Algebraic(sweeps=sweeps, relaxation=1.0))
        rays = rays_of(lines, views, grid)
        rest = rays.projector.project(rays.projector.volume_in(volume)) - rays.measured
        assert float(rest.norm() / rays.measured.norm()) < 0.02


@pytest.mark.parametrize("options", [{"sweeps": 0}, {"relaxation": 2.0}, {"relaxation": 0.0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match=r"sweeps|relaxation"):
        Algebraic(**options)


# --- total variation ----------------------------------------------------------------------------------------


def test_the_spectrum_of_white_noise_is_its_variance():
    views = turned(list(np.arange(20) * 9.0), (31, 25))
    rays = rays_of(torch.zeros(20, 31, 25), views, Grid.of_views(views))
    noise = 3 * torch.randn(20, 31, 25, generator=torch.Generator().manual_seed(0))
    spectrum = misfit_spectrum(rays, noise)
    assert spectrum.shape == (25, 16)  # of lines in the projector's order, [V, W, H]
    assert spectrum.numpy() == pytest.approx(9, rel=0.25)
    assert float(spectrum.mean()) == pytest.approx(9, rel=0.02)


class Identity:
    """A projector that sees the volume itself."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.array_shape = shape

    def project(self, array: Tensor) -> Tensor:
        """The volume."""
        return array.clone()

    backproject = volume_in = volume_out = lines_in = lines_out = project


def test_a_discounted_frequency_is_left_to_total_variation():
    """Without total variation the solution is the data; with it, the less a frequency is trusted the more it moves.

    On one slice with a smooth wave, the total variation of a plane wave of small amplitude is removed where trust is
    low, and the wave stays where it is high.
    """
    wave = 0.5 + 0.2 * torch.cos(2 * np.pi * torch.arange(16) / 16).expand(1, 12, 16)
    kept = []
    for trust in (0.01, 100.0):
        solver = PrimalDual(Identity((1, 12, 16)), torch.zeros(1, 12, 16), 0.02, None)
        solver.discount(torch.full((12, 9), trust))
        solver.run(wave, 800)
        kept.append(float(solver.volume.std() / wave.std()))
    assert kept[0] > 0.95
    assert kept[1] < 0.05


def test_uniform_discount_is_the_weight_in_other_words():
    """`½|r|²/S + λ TV` has the solution of `½|r|² + λ S TV`."""
    images = torch.rand(3, 8, 9, generator=torch.Generator().manual_seed(0))
    one = PrimalDual(Identity((3, 8, 9)), torch.zeros(3, 8, 9), 0.1, 1.0)
    two = PrimalDual(Identity((3, 8, 9)), torch.zeros(3, 8, 9), 0.3, 1.0)
    one.discount(torch.tensor(3.0))
    one.run(images, 1500)
    two.run(images, 1500)
    assert torch.allclose(one.volume, two.volume, atol=2e-3)


def smooth_noise(views: Views, strength: float) -> Tensor:
    """Noise [V, H, W] in metres that lives at low frequencies, as that of retrieved thickness does."""
    white = torch.randn(len(views), *views.shape, generator=torch.Generator().manual_seed(3))
    f2 = torch.fft.fftfreq(views.shape[0])[:, None] ** 2 + torch.fft.rfftfreq(views.shape[1]) ** 2
    low = torch.fft.irfft2(torch.fft.rfft2(white) / (1 + 400 * f2), s=views.shape)
    return strength * PITCH * low / low.std()


def test_discount_helps_where_low_frequencies_are_noisy():
    """And does little harm where there is no noise."""
    views = turned(list(np.arange(12) * 15.0), (21, 25))
    grid = Grid.of_views(views)
    truth = ball_truth(grid)
    errors = {}
    for strength in (0.0, 1.5):
        lines = ball_lines(views) + (smooth_noise(views, strength) if strength else 0)
        for discount in (0.0, 0.5):
            options = TotalVariation(discount=discount)
            volume = total_variation(lines, views, grid, 1.0, quiet, options=options).numpy()
            errors[strength, discount] = np.linalg.norm(volume - truth) / np.linalg.norm(truth)
    assert errors[1.5, 0.5] < 0.9 * errors[1.5, 0.0]
    assert errors[0.0, 0.5] < 1.1 * errors[0.0, 0.0]


def test_no_discount_is_the_plain_solver():
    views = turned()
    rays = rays_of(ball_lines(views), views, Grid.of_views(views))
    solver = PrimalDual(rays.projector, torch.zeros(rays.grid.shape), 0.5, 1.0)
    solver.run(ball_lines(views) / PITCH, 25)
    options = replace(TotalVariation(), first=10, iterations=15, discount=0.0)
    found = total_variation(ball_lines(views), views, Grid.of_views(views), 1.0, quiet, options=options)
    assert torch.allclose(found, solver.volume, atol=1e-6)
