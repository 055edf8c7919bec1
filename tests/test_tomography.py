"""Tomographies of thickness: the contract of the table, and what each method has on paper.

Lengths are in metres where a method takes them; the phantoms are boxes and balls on small, uneven rasters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.baselines import TOMOGRAPHIES, PrimalDual
from holosplat.baselines.algebraic import Algebraic, _masks, _orthogonal_sets, art, sirt
from holosplat.baselines.filtered_backprojection import Ramp, angular_weights, filtered_backprojection, ramp
from holosplat.baselines.rays import rays_of
from holosplat.baselines.tomography import TotalVariation, misfit_spectrum, total_variation
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.metrics import dice
from holosplat.projectors.voxels import LatticeProjector, SliceProjector
from holosplat.projectors.voxels.slices import slice_matrix

PITCH = 2.5e-6
SHAPE = (7, 25)
"""Rows and columns of the detector: rectangular and odd."""
ANGLES = [0.0, 17.0, 31.0, 60.0, 75.0, 90.0, 121.0, 133.0, 149.0, 166.0]
"""Uneven ones."""
BALL = (2.0, 0.4, -3.0, 5.0)
"""x, y, z and radius [pixels]."""


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Arrays are tiny here: a second thread would only wait for the first."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def quiet(fraction: float) -> None:
    """No progress to show."""


def turned(angles=ANGLES, shape=SHAPE, shifts=None, pitch=PITCH) -> Views:
    """Views about y, with detector shifts (in pixels)."""
    offsets = np.zeros((len(angles), 2)) if shifts is None else np.asarray(shifts)
    return Views(rotation_y(angles), pitch * offsets, shape, pitch)


def anyhow(count=8, shape=(21, 25)) -> Views:
    """Views without a common axis, with shifts of their own."""
    shifts = np.random.default_rng(0).uniform(-1, 1, (count, 2))
    return Views(Rotation.random(count, random_state=5).as_matrix(), PITCH * shifts, shape, PITCH)


def ball_lines(views: Views, ball=BALL, fine=6) -> Tensor:
    """Thickness [V, H, W] in metres of a ball: chords, averaged over pixels."""
    pitch, (h, w) = views.pixel_size, views.shape
    i, j = ((np.arange(n * fine) + 0.5) / fine - n / 2 for n in (h, w))
    images = []
    for rotation, shift in zip(views.rotations, views.shifts / pitch):
        x, y = (rotation @ np.array(ball[:3]))[:2] - shift
        chord = 2 * np.sqrt(np.clip(ball[3] ** 2 - (j - x) ** 2 - (i[:, None] - y) ** 2, 0, None))
        images.append(chord.reshape(h, fine, w, fine).mean((1, 3)))
    return torch.from_numpy(pitch * np.stack(images)).float()


def ball_truth(grid: Grid, pitch=PITCH, ball=BALL) -> np.ndarray:
    """Whether voxels [Z, Y, X] lie inside the ball."""
    x, y, z = (axis / pitch for axis in grid.axes())
    return (x - ball[0]) ** 2 + (y[:, None] - ball[1]) ** 2 + (z[:, None, None] - ball[2]) ** 2 < ball[3] ** 2


def solved(name: str, views: Views, upper: float | None = 1.0, lines: Tensor | None = None) -> tuple[Tensor, Grid]:
    grid = Grid.of_views(views)
    return TOMOGRAPHIES[name](ball_lines(views) if lines is None else lines, views, grid, upper, quiet), grid


every = pytest.mark.parametrize("name", TOMOGRAPHIES)
iterative = pytest.mark.parametrize("name", [name for name in TOMOGRAPHIES if name != "fbp"])
LEAST_DICE = {"fbp": 0.85, "art": 0.93, "sirt": 0.85, "sirt-nonneg": 0.93, "tv": 0.94}


# --- the contract -------------------------------------------------------------------------------------------


@every
def test_a_ball_is_found_from_uneven_angles(name):
    volume, grid = solved(name, turned())
    assert volume.shape == grid.shape
    assert volume.dtype == torch.float32
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name]


@every
def test_the_mass_is_right(name):
    volume, _ = solved(name, turned(), upper=None)
    mass = float(volume.sum()) / float(ball_lines(turned()).sum() / PITCH / len(ANGLES))
    assert mass == pytest.approx(1, abs=0.2 if name == "fbp" else 0.02)  # fbp: also outside the field of view


@every
def test_detectors_may_be_shifted(name):
    shifts = [(2 * np.sin(i), 0.0) for i in range(len(ANGLES))]
    volume, grid = solved(name, turned(shifts=shifts))
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name]


@iterative
def test_views_may_have_any_orientation(name):
    volume, grid = solved(name, anyhow())
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name] - 0.05


def test_filtered_backprojection_needs_a_common_axis():
    with pytest.raises(InputError, match="filtered back-projection needs views that turn about the y axis"):
        solved("fbp", anyhow())


@every
def test_nothing_gives_nothing(name):
    volume, _ = solved(name, turned(), lines=torch.zeros(len(ANGLES), *SHAPE))
    assert float(volume.abs().max()) == 0


@every
def test_the_unit_of_length_does_not_matter(name):
    """The same scan in other metres: the same occupancy; twice as thick: no new shape (without bounds)."""
    views, other = turned(), turned(pitch=40 * PITCH)
    one, two = solved(name, views)[0], solved(name, other)[0]
    assert torch.allclose(one, two, atol=2e-4)


@pytest.mark.parametrize("name", ["fbp", "sirt", "art", "sirt-nonneg"])
def test_occupancy_is_proportional_to_thickness(name):
    views = turned()
    one, two = solved(name, views, None)[0], solved(name, views, None, 2 * ball_lines(views))[0]
    assert torch.allclose(2 * one, two, atol=1e-4)


@every
@pytest.mark.parametrize("upper", [0.7, 1.0])
def test_the_upper_bound_is_kept(name, upper):
    views = turned()
    volume, _ = solved(name, views, upper, 1.5 * ball_lines(views))
    assert float(volume.max()) == pytest.approx(upper)
    assert float(solved(name, views, None, 1.5 * ball_lines(views))[0].max()) > 1.1


@every
def test_progress_is_told(name):
    told: list[float] = []
    views = turned()
    TOMOGRAPHIES[name](ball_lines(views), views, Grid.of_views(views), 1.0, told.append)
    assert told == sorted(told)
    assert told[0] == 0
    assert 0.7 < told[-1] < 1


@every
def test_bad_input_is_refused(name):
    views = turned()
    with pytest.raises(InputError, match=r"must have the shape \(10, 7, 25\)"):
        solved(name, views, lines=torch.zeros(9, *SHAPE))
    broken = ball_lines(views)
    broken[0, 0, 3] = torch.nan
    with pytest.raises(InputError, match="must be finite, but 1 are not"):
        solved(name, views, lines=broken)
    with pytest.raises(InputError, match="upper bound of the occupancy must be a positive number"):
        solved(name, views, 0.0)


@every
def test_voxels_may_be_finer_than_pixels(name):
    views = turned()
    grid = Grid.of_views(views, 2)
    volume = TOMOGRAPHIES[name](ball_lines(views), views, grid, 1.0, quiet)
    assert volume.shape == (50, 14, 50)
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name] - 0.05


@pytest.mark.parametrize("name", ["art", "sirt-nonneg", "tv"])
def test_these_keep_the_occupancy_from_below(name):
    assert float(solved(name, turned(), None)[0].min()) == 0


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
    return slice_matrix(grid, flat).toarray(), lines, Grid.of_views(views)


def test_sirt_is_that_of_gregor_and_benson():
    """Three sweeps against the formula, with a full matrix in float64."""
    views = turned(ANGLES[:4], (1, 9))
    matrix, lines, grid = dense(views)
    per_ray, per_voxel = 1 / matrix.sum(1), 1 / matrix.sum(0)
    x = np.zeros(81)
    for _ in range(3):
        x = np.clip(x + 1.3 * per_voxel * (matrix.T @ (per_ray * (lines.ravel() - matrix @ x))), 0, 0.4)
    options = Algebraic(sweeps=3, relaxation=1.3, nonnegative=True)
    found = sirt(torch.from_numpy(PITCH * lines), views, grid, 0.4, quiet, options=options)
    assert np.abs(found.numpy().ravel() - x).max() < 1e-5


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
