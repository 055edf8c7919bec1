"""Matter that changes in time: kept volumes, times of collapse and growth, and waves beside exact solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import root_scalar

from holosplat.beamline.simulate import Shutter, simulate
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.scan import Exposures
from holosplat.specimens import ContinuousScene, Drawn, MeshScene, Substances
from holosplat_bench.specimens.changing import (
    RAYLEIGH,
    Collapse,
    CrushedLattice,
    MergingDrops,
    PinchingJet,
    bubble_radius,
    growth_rate,
)
from holosplat_bench.specimens.fluids import FASTEST
from holosplat_bench.specimens.gas_waves import ExpandingShock, Fluid, Radial, waves
from holosplat_bench.specimens.rods import RodScene

SIZE = 40e-6
WATER = DeltaBeta(5e-7, 2e-10)
IN_AIR, IN_WATER = Substances(WATER), Substances(WATER, medium=WATER)
SHARES = (0.0, 0.3, 0.36, 0.5, 0.8, 1.0)
VIEWS = Views.from_angles([0.0, 50.0], (33, 39), 1.5e-6)


def bodies(found: Drawn, share: float) -> tuple[TriangleMesh, ...]:
    """Those of a time."""
    scene = found.scene.at(share)
    assert isinstance(scene, MeshScene)
    return scene.meshes


def test_merging_drops_keep_their_volume_and_their_centre():
    """Two bodies before contact, one after; at the end a ball about the centre of both."""
    kind = MergingDrops(SIZE, contact=0.35)
    found, whole = kind.drawn(IN_AIR, 3), 4 / 3 * np.pi * (kind.radii**3).sum()
    for share in SHARES:
        volumes = [mesh.volume for mesh in bodies(found, share)]
        assert len(volumes) == (2 if share < 0.35 else 1)
        assert sum(volumes) == pytest.approx(whole, rel=1e-9)
        volume = found.scene.at(share).voxelise(Grid.of_views(VIEWS))
        x, y, z = volume.grid.axes()
        for axis, at in ((2, x), (1, y), (0, z)):
            others = tuple(a for a in range(3) if a != axis)
            assert abs(volume.delta.sum(others) @ at / volume.delta.sum()) < 0.02 * 1.5e-6
    away = np.linalg.norm(bodies(found, 1.0)[0].vertices, axis=1)
    assert away == pytest.approx((3 * whole / (4 * np.pi)) ** (1 / 3), rel=2e-3)


def test_the_neck_of_merging_drops_grows_with_the_root_of_time():
    kind = MergingDrops(SIZE, ratio=1.0)

    def neck(after: float) -> float:
        (body,) = bodies(kind.drawn(IN_AIR, 3), kind.contact + after * (1 - kind.contact))
        axis = np.linalg.eigh(body.vertices.T @ body.vertices)[1][:, -1]
        along = body.vertices @ axis
        across = np.linalg.norm(body.vertices - np.outer(along, axis), axis=1)
        return float(across[np.argmin(abs(along))])

    assert neck(0.02) / neck(0.005) == pytest.approx(2.0, rel=0.1)


def test_an_empty_bubble_collapses_in_rayleighs_time():
    """0.915 R √(ρ/p) (Rayleigh 1917), on the way R'² = 2/3 (R⁻³ - 1)."""
    found = bubble_radius(0.0, 0.0, 2.0)
    assert found.t_max == pytest.approx(RAYLEIGH, rel=1e-4)
    radius, rate = found(0.8)
    assert rate**2 == pytest.approx(2 / 3 * (radius**-3 - 1), rel=1e-6)


def test_gas_lets_a_bubble_swing_and_sound_takes_from_it():
    """Near its balance it swings by Minnaert's frequency, √(3 κ); with sound it does not come back to where it was."""
    near = bubble_radius(0.999, 0.0, 8.0)  # nearly in balance
    times = np.linspace(0.5, 4.5, 4000)
    assert times[near(times)[0].argmax()] == pytest.approx(2 * np.pi / np.sqrt(3 * 1.4), rel=0.01)
    still, loud = (bubble_radius(0.1, mach, 4.0)(np.linspace(1.2, 4.0, 2000))[0] for mach in (0.0, 0.05))
    assert still.max() == pytest.approx(1.0, abs=1e-4)
    assert loud.max() < 0.97


def test_a_collapse_keeps_the_liquid():
    kind = Collapse(SIZE)
    found = kind.drawn(IN_AIR, 2)
    liquids, bubbles = [], []
    for share in SHARES:
        volumes = {mesh.name: mesh.volume for mesh in bodies(found, share)}
        bubbles.append(volumes["bubble"])
        liquids.append(volumes["jet"] - volumes["bubble"])
        assert volumes["bubble"] == pytest.approx(4 / 3 * np.pi * kind.radius(share) ** 3, rel=1e-9)
    assert np.ptp(liquids) < 0.003 * bubbles[0]
    assert bubbles[-1] < 0.1 * bubbles[0]
    assert kind.radius(-0.01) == kind.radius(0.01)


def test_the_wave_of_the_pinching_jet_grows_fastest():
    """Rayleigh's rate: largest at a wavelength of 9.02 radii, 0.3433; none for shorter ones than the girth."""
    rates = [growth_rate(2 * np.pi / wave) for wave in (0.97 * FASTEST, FASTEST, 1.03 * FASTEST)]
    assert rates[1] == max(rates)
    assert rates[1] == pytest.approx(0.3433, abs=1e-4)
    assert growth_rate(1.0) == growth_rate(1.2) == 0.0


def test_a_pinching_jet_keeps_its_volume():
    kind = PinchingJet(SIZE / 5)
    found, whole = kind.drawn(IN_AIR, 1), 9 * FASTEST * np.pi * (SIZE / 10) ** 3
    for share in (0.0, 0.4, 0.599, 0.6, 0.8, 1.0):
        volumes = [mesh.volume for mesh in bodies(found, share)]
        assert len(volumes) == (1 if share < 0.6 else 9)
        assert sum(volumes) == pytest.approx(whole, rel=2e-3)
    assert kind.swelling(kind.pinch) == pytest.approx(1.0)
    last = bodies(found, 1.0)[4].vertices
    away = np.linalg.norm(last - 0.5 * (last.min(0) + last.max(0)), axis=1)
    assert np.ptp(away) < 0.002 * away.mean()


def test_a_crushed_lattice_loses_height_and_keeps_its_struts():
    kind = CrushedLattice(SIZE, strain=0.3)
    scene = kind.drawn(IN_AIR, 1).scene
    first, last = (scene.at(share) for share in (0.0, 1.0))
    assert isinstance(first, RodScene)
    assert isinstance(last, RodScene)
    top = kind.moved(np.array([0.0, 0.5 * SIZE, 0.0]), 1.0)
    assert top[1] == pytest.approx(0.35 * SIZE)
    for before, after in zip(first.rods, last.rods):
        lengths = [np.linalg.norm(rod.end - rod.start) for rod in (before, after)]
        assert after.radius**2 * lengths[1] == pytest.approx(before.radius**2 * lengths[0], rel=1e-9)


def riemann(left, right, gamma: float, at: np.ndarray) -> np.ndarray:
    """Density of the exact solution at `x / t` (Toro 2009, chapter 4), of an ideal gas: a rarefaction and a shock."""
    (rl, ul, pl), (rr, ur, pr) = left, right
    cl, cr, n = np.sqrt(gamma * pl / rl), np.sqrt(gamma * pr / rr), (gamma - 1) / (2 * gamma)

    def behind(p: float) -> tuple[float, float]:
        fan = ul + 2 * cl / (gamma - 1) * (1 - (p / pl) ** n)
        jump = ur + (p - pr) * np.sqrt(2 / ((gamma + 1) * rr) / (p + (gamma - 1) / (gamma + 1) * pr))
        return fan, jump

    p = float(root_scalar(lambda p: np.subtract(*behind(p)), bracket=(pr, pl)).root)
    u, ratio = behind(p)[0], (gamma - 1) / (gamma + 1)
    inner, outer = rl * (p / pl) ** (1 / gamma), rr * (p / pr + ratio) / (ratio * p / pr + 1)
    shock = ur + cr * np.sqrt((gamma + 1) / (2 * gamma) * p / pr + (gamma - 1) / (2 * gamma))
    fan = rl * np.maximum(2 / (gamma + 1) + ratio / cl * (ul - at), 0) ** (2 / (gamma - 1))
    tail = u - cl * (p / pl) ** n
    return np.select([at < ul - cl, at < tail, at < u, at < shock], [rl, fan, inner, outer], rr)


def test_plane_waves_are_those_of_the_exact_riemann_problem():
    """Sod's tube (1978), and the same in a liquid, whose pressure is that of the gas less its stiffness."""
    left, right, edges = (1.0, 0.0, 1.0), (0.125, 0.0, 0.1), np.linspace(-0.5, 0.5, 301)
    middles = 0.5 * (edges[1:] + edges[:-1])
    state = np.where(middles < 0, np.array(left)[:, None], np.array(right)[:, None])
    errors = []
    for every in (3, 1):  # the error falls with the cells, as it does where there are jumps
        found = waves(state[:, ::every], edges[::every], Fluid(1.4), [0.2], spherical=False)[0, 0]
        errors.append(float(abs(found - riemann(left, right, 1.4, middles[every // 2 :: every] / 0.2)).mean()))
    assert errors[1] < 0.006
    assert errors[1] < 0.5 * errors[0]
    liquid = state - np.array([0, 0, 3.0])[:, None]
    same = waves(liquid, edges, Fluid(1.4, 3.0), [0.2], spherical=False)[0, 0]
    assert same == pytest.approx(waves(state, edges, Fluid(1.4), [0.2], spherical=False)[0, 0], abs=1e-9)


def test_a_point_explosion_runs_as_sedov_says():
    """r = 1.0328 (E t² / ρ)^(1/5) for γ = 1.4 (Sedov 1946); behind the front no gas is lost."""
    edges = np.linspace(0, 1, 101)
    middles, volumes = 0.5 * (edges[1:] + edges[:-1]), 4 / 3 * np.pi * np.diff(edges**3)
    core = volumes[:6].sum()
    state = np.stack([np.ones(100), np.zeros(100), np.where(np.arange(100) < 6, 0.4 / core, 1e-6)])
    times = np.array([0.15, 0.3, 0.5])
    density = waves(state, edges, Fluid(1.4), times, spherical=True)[:, 0]
    fronts = middles[density.argmax(axis=1)] + 0.5 * edges[1]
    assert fronts == pytest.approx(1.0328 * times**0.4, rel=0.02)
    assert density @ volumes == pytest.approx(volumes.sum(), rel=1e-9)
    assert density.max() > 3.5  # 6 where the front has no width


def test_lines_through_shells_are_those_of_balls():
    edges = np.linspace(0, 1, 5)
    shells = Radial(edges, np.array([3.0, -1.0, 0.5, 2.0]))
    b = np.array([0.1, 0.3, 0.6, 0.9, 1.1])
    chords = 2 * np.sqrt(np.maximum(np.subtract.outer(edges**2, b**2), 0))
    exact = shells.values @ np.diff(chords, axis=0)
    assert shells.chord(b**2) == pytest.approx(exact, abs=2e-3)
    assert shells.density(np.square([0.2, 0.3, 0.99, 1.0])) == pytest.approx([3.0, -1.0, 2.0, 0.0])
    s = (np.arange(4000) + 0.5) / 4000
    assert shells.mass == pytest.approx(float((shells.density(s**2) * 4 * np.pi * s**2).mean()), rel=1e-6)


def test_a_shock_grows_and_weakens():
    kind = ExpandingShock(SIZE, pressure=2.0)
    found = kind.drawn(IN_WATER, 1)
    radii = [kind.radius(share) for share in (0.0, 0.5, 1.0)]
    assert [radii[0], radii[2]] == pytest.approx([0.175 * SIZE, 0.5 * SIZE], rel=1e-3)
    speeds = np.diff(radii)
    assert speeds[0] > speeds[1]
    jumps = []
    for share, radius in zip((0.0, 0.5, 1.0), radii):
        scene, within = found.scene.at(share), found.regions["within"].at(share)
        assert isinstance(scene, ContinuousScene)
        assert isinstance(within, ContinuousScene)
        assert within.mass.delta == pytest.approx(4 / 3 * np.pi * radius**3, rel=1e-6)
        shells = scene.elements[0].profile
        jumps.append(float(shells.density(np.linspace(0.8, 0.999, 50) ** 2).max()))
    assert jumps[0] > jumps[1] > jumps[2] > 0.01
    with pytest.raises(InputError, match="a shock needs a medium"):
        kind.drawn(IN_AIR, 1)
    with pytest.raises(InputError, match="core must be below first"):
        ExpandingShock(SIZE, core=0.5).drawn(IN_WATER, 1)


def test_an_exposure_blurs_what_changes():
    """A frame is the mean over its pulses, at which the matter is drawn anew, also before the first time."""
    found = Collapse(SIZE).drawn(IN_AIR, 2).over(2e-5)
    exposures = Exposures.of(VIEWS[[0]], 20.0, 0.05).repeated(np.array([1.5e-5]))
    still = replace(exposures, time=np.zeros(1))
    blurred = simulate(found.scene, exposures, shutter=Shutter(4e-6, 2)).frames
    sharp = [simulate(found.scene.at(time), still).frames for time in (1.4e-5, 1.6e-5)]
    assert blurred == pytest.approx(np.mean(sharp, axis=0), abs=1e-6)
    assert abs(sharp[0] - sharp[1]).max() > 0.01
    assert found.scene.missing_field(VIEWS) > 0


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Collapse(SIZE, bubble=0.9), "bubble must be at most 0.8"),
        (Collapse(SIZE, dent=0.95), "dent must be at most 0.9"),
        (PinchingJet(SIZE, amplitude=0.8), "amplitude must be below 0.7"),
        (CrushedLattice(SIZE, strain=0.5), "strain must be at most 0.4"),
    ],
)
def test_shapes_that_cannot_be_are_refused(kind, said):
    with pytest.raises(InputError, match=said):
        kind.drawn(IN_AIR, 0)
