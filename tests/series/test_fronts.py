"""Spherical fronts: in volumes of known ones, and in what frames tell of a shock, with errors that cover the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

import holosplat as hs
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior
from holosplat.methods import SmoothVolume
from holosplat.optics.background import LightOptions
from holosplat.scan import Exposures
from holosplat.series.fronts import BEHIND, BETWEEN, FRONT_COLUMNS, PLACED, Front, front_rows
from holosplat.specimens import Substances
from holosplat.volume import Volume
from holosplat.workflows.totals import TotalMatter
from holosplat_bench.specimens.gas_waves import ExpandingShock

GRID = Grid.centred((31, 25, 37), 0.5e-6, (1e-6, 0.0, 0.0))
DELTA = 4e-7
WATER = parse_material("water").delta_beta(20.0)


@pytest.fixture(autouse=True)
def _unjudged() -> None:
    """Here totals are asked for."""


def shock(radius: float, noise: float = 0.0) -> Volume:
    """A front of that many voxels about (1, -2, 0.5), compressed behind it, rarefied in the middle, in noise."""
    z, y, x = np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in GRID.shape), indexing="ij")
    away = np.sqrt((x - 1) ** 2 + (y + 2) ** 2 + (z - 0.5) ** 2)
    values = np.clip(radius - away + 0.5, 0, 1) * (1 - 0.12 * (radius - away)) - 3 * (away < 2.5)
    values = values + noise * np.random.default_rng(0).normal(size=values.shape)
    return Volume(DELTA * values, 0 * values, GRID)


def test_a_front_is_found_with_radius_step_and_errors():
    """To a tenth of a voxel, in noise of a fifth of its step, beside a stronger jump in its middle."""
    found = Front.of(shock(8.3, noise=0.2))
    assert found.radius == pytest.approx(8.3 * 0.5e-6, abs=0.1 * 0.5e-6)
    assert found.step == pytest.approx(0.91 * DELTA, rel=0.05)  # the mean over a voxel and a half
    middle = np.array(GRID.origin) + 0.5e-6 * (0.5 * (np.array(GRID.shape[::-1]) - 1) + [1, -2, 0.5])
    assert found.centre == pytest.approx(middle, abs=0.1 * 0.5e-6)
    assert found.kind == "compression"
    assert 0 < found.errors[3] < 0.1 * 0.5e-6
    assert abs(found.radius - 8.3 * 0.5e-6) < 4 * found.errors[3]
    with pytest.raises(InputError, match="a front needs matter"):
        Front.of(Volume(np.zeros(GRID.shape), np.zeros(GRID.shape), GRID))


@pytest.mark.parametrize("share", [0.0, 0.5], ids=["thin", "thicker"])
def test_the_front_of_a_thin_shell_is_not_drawn_inside(share):
    """What a young shock compresses is thinner than the fitted shell, and falls off in a curve behind the front."""
    water, grid = parse_material("water").delta_beta(20.0), Grid.centred((44, 45, 46), 1e-6)
    kind = ExpandingShock(44e-6)
    found = Front.of(kind.drawn(Substances(water, medium=water), 1).scene.at(share).voxelise(grid))
    assert found.radius == pytest.approx(kind.radius(share), abs=0.1e-6)


def test_what_hardly_anything_is_far_out_is_no_front():
    """A shell of a thousandth of the step, beyond which there is nothing at all."""
    faint = shock(8.3)
    z, y, x = np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in GRID.shape), indexing="ij")
    shell = np.abs(np.sqrt((x - 1) ** 2 + (y + 2) ** 2 + (z - 0.5) ** 2) - 12) < 0.5
    found = Front.of(replace(faint, delta=faint.delta + 1e-3 * DELTA * shell))
    assert found.radius == pytest.approx(8.3 * 0.5e-6, abs=0.1 * 0.5e-6)


def test_a_front_runs_at_a_speed_with_its_error():
    radii, times = [6.0, 6.8, 7.6, 8.4, 9.2, 10.0], 1e-6 * np.arange(6)
    rows = list(front_rows(range(6), times.tolist(), [Front.of(shock(radius, noise=0.05)) for radius in radii]))
    assert len(rows[0]) == len(FRONT_COLUMNS)
    for row in rows:
        assert float(str(row[9])) == pytest.approx(0.4, abs=0.03)  # 0.8 voxels of 0.5 µm a µs
        assert 0 < float(str(row[10])) < 0.03


@pytest.mark.parametrize(
    ("radius", "profile"),
    [
        (5.95, [-45.8, -40.5, -33.2, -15.7, 5.64, 9.68, 2.16, -0.34, 0.0]),
        (9.07, [-48.5, -38.6, -34.3, -25.5, -11.4, -2.9, 1.08, 5.42, 6.37, 1.79, -0.41, 0.16, 0.0]),
    ],
)
def test_ripple_before_a_front_is_none(radius, profile):
    """Rings of three hundredths of the largest δ, as explained volumes have; they were fitted as the front."""
    z, y, x = np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in (41, 39, 40)), indexing="ij")
    delta = 1e-8 * np.interp(np.sqrt(x**2 + y**2 + z**2), np.arange(len(profile)) + 0.5, profile)
    grid = Grid.centred((41, 39, 40), 1e-6)
    found = Front.of(Volume(delta, 0 * delta, grid))
    assert found.radius == pytest.approx(radius * 1e-6, abs=0.4e-6)
    assert found.kind == "compression"
    other = Front.of(Volume(-delta, 0 * delta, grid))
    assert (other.kind, other.step) == ("rarefaction", pytest.approx(-found.step))


def test_the_place_of_a_jump_between_radii_is_as_uncertain_as_is_said():
    """Values at radii that are a spacing apart, by least squares of a jump anywhere between two."""
    x = np.arange(0.005, 40, 0.01)
    hats, off = np.maximum(1 - np.abs(x[:, None] - np.arange(41)), 0), list[float]()
    near = np.arange(-0.5, 0.5, 0.01)
    for place in np.arange(0.05, 1, 0.1):
        seen = hats @ np.linalg.lstsq(hats, (x < 20 + place).astype(float), rcond=None)[0]
        left, shell = list[float](), (x > 20 + place - BEHIND) & (x < 26)
        for at in near:
            design = np.stack([ndtr((20 + place + at - x[shell]) / BETWEEN), np.ones(shell.sum())], axis=1)
            left.append(float(np.linalg.lstsq(design, seen[shell], rcond=None)[1][0]))
        off.append(near[np.argmin(left)])
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(PLACED, abs=0.01)


def test_errors_of_a_shock_in_frames_cover_the_truth():
    """Of centre, radius, step and speed: what is off is of the size that is said. They were 30 to 1000 times less."""
    shape, times = (37, 40), np.linspace(0, 1, 5)
    views, kind = Views.from_angles([0.0, 45.0, 90.0, 135.0], shape, 1e-6), ExpandingShock(31e-6)
    drawn, prior = kind.drawn(Substances(WATER, medium=WATER), 3), MaterialPrior.of_ratio(WATER.ratio)
    fronts, off = list[Front](), list[list[float]]()
    for number, time in enumerate(times):
        scene, exposures = drawn.scene.at(float(time)), Exposures.of(views, 20.0, 0.1)
        none = np.zeros(4, dtype=bool)
        scan = hs.simulate(scene, exposures, photons_per_pixel=3000.0, seed=number, is_test=none)
        light = LightOptions("even", still="none", noise="white")
        done = hs.reconstruct(scan, prior.on_both_sides().about_a_point(), SmoothVolume(), light=light)
        assert done.total is not None
        told = TotalMatter.from_dict(done.total.as_dict()).profile
        assert told is not None
        grid = Grid.of_views(views)
        front, true = Front.of(done.object.voxelise(grid), told), Front.of(scene.voxelise(grid))
        away = [*(front.centre - true.centre), front.radius - kind.radius(time), front.step - true.step]
        fronts, off = [*fronts, front], [*off, (away / front.errors).tolist()]
    assert 0.5 < np.sqrt(np.mean(np.square(off)[:, :3])) < 2
    assert 0.5 < np.sqrt(np.mean(np.square(off)[:, 3])) < 2
    assert 0.5 < np.sqrt(np.mean(np.square(off)[:, 4])) < 2
    rows = list(front_rows(range(5), times.tolist(), fronts))
    middle = [(kind.radius(t + 0.01) - kind.radius(t - 0.01)) / 0.02 for t in times[1:-1]]
    speeds = [(float(str(row[9])), float(str(row[10]))) for row in rows[1:-1]]
    assert all(abs(speed - true) < 3 * error for (speed, error), true in zip(speeds, middle))
    assert all(0 < error < 0.2 * speed for speed, error in speeds)
