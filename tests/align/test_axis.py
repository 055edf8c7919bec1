"""The axis of turning objects: column and lean of phantoms whose projections are known, and of measured scans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.discs import PITCH, ball_lines
from helpers.filled import filled
from holosplat.align import Axis, AxisOptions, find_axis
from holosplat.align.axis import AXIS, BY_ALL, BY_MIRROR, FOUND, GIVEN, LEAN, LEANING, UPRIGHT
from holosplat.align.consistency import Estimate, combined, polynomials
from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.matter import MaterialPrior
from holosplat.scan import Exposures, Scan

BALLS = ((9.0, -6.0, 4.0, 8.0), (-11.0, 2.0, 7.0, 6.0), (3.0, 9.0, -12.0, 5.0), (-6.0, -12.0, -9.0, 4.0))
"""x, y, z and radius [pixels]."""
SHAPE = (41, 63)


def rolled(angle: float) -> np.ndarray:
    """A turn about the beam by `angle` degrees."""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def scan_of(angles, offset=0.0, roll=0.0, noise=0.0, shape=SHAPE, seed=0) -> Scan:
    """A scan of balls in contact, planned about the middle column; truly `offset` pixels off it, and rolled [deg]."""
    planned = Views.from_angles(angles, shape, PITCH)
    true = replace(planned, rotations=rolled(roll) @ planned.rotations, shifts=planned.shifts - [offset * PITCH, 0.0])
    lines = np.sum([ball_lines(true, ball, 3).numpy() for ball in BALLS], axis=0) / PITCH
    frames = np.exp(-0.02 * lines) + noise * np.random.default_rng(seed).standard_normal(lines.shape)
    return Scan(frames.astype(np.float32), Exposures.of(planned, 20.0, 0.0), np.zeros(len(angles), dtype=bool))


HALF = np.arange(60) * 3.0


@pytest.fixture
def unjudged(monkeypatch) -> None:
    """What the moments say is not held against unseen views, as tests below do of axes near and far."""
    monkeypatch.setattr("holosplat.align.axis._judged", lambda axis, *given: axis)


@pytest.mark.parametrize(("offset", "count"), [(0.0, 60), (-5.3, 60), (7.37, 30), (2.2, 15)])
def test_the_column_is_found_within_its_error(offset, count, unjudged):
    found = find_axis(scan_of(HALF[:: 60 // count], offset, noise=0.002))
    assert abs(found.offset.value - offset) < max(0.05, 3 * found.offset.error)
    assert found.offset.error < 0.15
    assert found.column == pytest.approx(31 + found.offset.value)
    assert not found.leans


@pytest.mark.parametrize("columns", [slice(24, 63), slice(3, 40)], ids=["left", "right"])
def test_frames_half_a_turn_apart_tell_an_axis_near_an_edge(columns, unjudged):
    """Of a half acquisition, most of whose matter each frame misses; odd rows, and other columns than rows."""
    whole = scan_of(np.arange(72) * 5.0, noise=0.002)
    scan = whole.cropped(slice(0, 41), columns)
    found = find_axis(scan.with_views(replace(scan.views, shifts=0 * scan.views.shifts)))
    assert found.column == pytest.approx(31 - columns.start, abs=0.1)
    assert found.place is not None
    assert found.place.choice == BY_MIRROR
    assert "do not show all of the matter" in " ".join(found.lines())


def test_where_frames_show_all_of_the_matter_all_of_them_tell_the_axis(unjudged):
    found = find_axis(scan_of(np.arange(72) * 5.0, -3.3, noise=0.002))
    assert found.offset.value == pytest.approx(-3.3, abs=0.05)
    assert found.lean is not None
    assert found.place is not None
    assert found.place.choice == BY_ALL


def test_the_sense_of_rotation_cannot_be_told(unjudged):
    """The mirrored object that turns the other way gives the same frames: the axis is the same, and it is said."""
    scan = scan_of(HALF, 3.1, noise=0.002)
    backwards = scan.with_views(scan.views.turned_back())
    there, back = find_axis(scan), find_axis(backwards)
    assert back.offset.value == pytest.approx(there.offset.value, abs=1e-6)
    assert any("cannot tell" in line for line in there.lines())


@pytest.mark.parametrize("roll", [1.5, -2.0])
def test_the_lean_is_found_and_put_into_the_exposures(roll, unjudged):
    scan = scan_of(HALF, 4.2, roll, noise=0.002)
    found = find_axis(scan)
    assert found.leans
    assert found.lean is not None
    assert np.rad2deg(np.arctan(found.lean.value)) == pytest.approx(-roll, abs=0.15)
    fixed = found.applied(scan.exposures).views
    np.testing.assert_allclose(fixed.rotations, rolled(roll) @ scan.views.rotations, atol=0.004)
    np.testing.assert_allclose(fixed.shifts[:, 0] / PITCH, -4.2, atol=0.1)
    assert not fixed.shares_axis


def test_dust_that_stays_with_the_detector_does_not_matter(unjudged):
    """One flat field leaves the same faults in all frames; they have no axis."""
    scan = scan_of(HALF, 6.0, noise=0.002)
    dust = 1 + 0.02 * np.random.default_rng(4).standard_normal((1, *SHAPE))
    found = find_axis(Scan((scan.frames * dust).astype(np.float32), scan.exposures, scan.is_test))
    assert found.offset.value == pytest.approx(6.0, abs=0.1)


def test_matter_beyond_the_field_is_survived(unjudged):
    """Fifteen columns cut away on one side, where balls pass in and out."""
    whole = scan_of(HALF, 0.0, noise=0.002)
    found = find_axis(whole.cropped(slice(0, 41), slice(15, 63)))
    assert found.offset.value == pytest.approx(0.0, abs=0.3)
    assert found.column == pytest.approx(31 - 15 + found.offset.value)


def test_detectors_that_move_sideways_are_followed(unjudged):
    shifts = np.stack([np.linspace(-2, 2, len(HALF)), np.zeros(len(HALF))], axis=1) * PITCH
    planned = replace(Views.from_angles(HALF, SHAPE, PITCH), shifts=shifts)
    true = replace(planned, shifts=shifts - [1.7 * PITCH, 0.0])
    lines = np.sum([ball_lines(true, ball, 3).numpy() for ball in BALLS], axis=0) / PITCH
    scan = Scan(np.exp(-0.02 * lines).astype(np.float32), Exposures.of(planned, 20.0, 0.0), np.zeros(60, dtype=bool))
    found = find_axis(scan)
    assert found.offset.value == pytest.approx(1.7, abs=0.05)
    np.testing.assert_allclose(found.applied(scan.exposures).views.shifts, true.shifts, atol=0.05 * PITCH)


def test_bad_scans_are_refused_with_the_reason():
    with pytest.raises(InputError, match="6 views at least"):
        find_axis(scan_of(HALF[::15]))
    tilted = Exposures.of(Views.from_rotations(rolled(20.0) @ rotation_y(HALF), SHAPE, PITCH), 20.0, 0.0)
    with pytest.raises(InputError, match="y axis alone"):
        find_axis(Scan(scan_of(HALF).frames, tilted, np.zeros(60, dtype=bool)))
    with pytest.raises(InputError, match="bands"):
        AxisOptions(bands=0)


def test_moments_of_a_point_are_polynomials_of_the_angle():
    """U_n(s) at s = a cos(θ - b) is a trigonometric polynomial of degree and parity n."""
    angles = np.sort(np.random.default_rng(1).uniform(0, np.pi, 40))
    inside = 0.7 * np.cos(angles - 0.4)
    for n in (2, 5, 8):
        values = np.sin((n + 1) * np.arccos(inside)) / np.sqrt(1 - inside**2)
        space = polynomials(n, angles)
        np.testing.assert_allclose(space @ (space.T @ values), values, atol=1e-9)
        lower = polynomials(n - 1, angles)
        assert np.abs(lower @ (lower.T @ values) - values).max() > 1e-4


def test_estimates_that_scatter_have_larger_errors_and_one_that_is_wrong_counts_little():
    errors = np.full(5, 0.1)
    agreed = combined(np.array([1.0, 1.05, 0.95, 1.02, 0.98]), errors)
    scattered = combined(np.array([1.0, 1.5, 0.5, 1.2, 0.8]), errors)
    assert agreed.error == pytest.approx(0.1 / np.sqrt(5), rel=0.2)
    assert scattered.error > 2 * agreed.error
    assert combined(np.array([1.0, 1.05, 0.95, 1.02, 9.0]), errors).value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("name", "shape", "photons"), [("crack", (31, 32), None), ("jet", (32, 32), 3000.0)])
def test_a_wrong_optimum_of_the_moments_is_not_applied(name, shape, photons):
    """Matter that leaves the field, in eight views: the moments are sure of an axis that is several pixels off."""
    scan = filled(name, shape, 8, photons)
    found = find_axis(scan)
    assert abs(found.offset.value) > 5
    assert found.offset.compared(FOUND).wins
    assert found.stays
    assert not found.leans
    assert found.applied(scan.exposures) is scan.exposures
    said = {each.name: each.choice for each in found.decisions}
    assert said[AXIS] == GIVEN
    assert "the scan's is kept" in found.lines()[0]


@pytest.mark.parametrize(("offset", "roll"), [(1.0, 0.0), (0.0, 2.5)])
def test_an_axis_that_unseen_views_confirm_is_applied(offset, roll):
    """Off by a pixel, or leaning: as many views as of the specimens above, with noise."""
    scan = scan_of(np.arange(8) * 22.5, offset, roll, noise=0.002)
    found = find_axis(scan)
    assert found.judged is not None
    assert found.judged.choice == (LEANING if roll else FOUND)
    shifts = found.applied(scan.exposures).views.shifts[:, 0] / PITCH
    np.testing.assert_allclose(shifts, -offset, atol=0.25)
    assert found.leans == (roll != 0)


def test_holes_in_a_medium_tell_an_axis_far_off():
    """Bubbles, whose δ is said to lie below the water's: volumes of the other sign predict less than no matter."""
    scan = filled("bubbles", (32, 32), 8, 3000.0)
    moved = scan.with_views(replace(scan.views, shifts=scan.views.shifts + [4e-6, 0.0]))
    found = find_axis(moved, prior=MaterialPrior.unknown(-1))
    assert found.judged is not None
    assert found.judged.choice == FOUND
    assert found.offset.value == pytest.approx(4.0, abs=0.5)


def test_a_small_correction_is_left_to_the_moments():
    """It moves matter by less than first volumes resolve; it is applied where it is sure."""
    scan = scan_of(HALF, 0.3, noise=0.002)
    found = find_axis(scan)
    assert found.judged is None
    assert found.applied(scan.exposures).views.shifts[0, 0] / PITCH == pytest.approx(-0.3, abs=0.03)
    unsure = replace(found, offset=Estimate(0.3, 0.1))
    assert unsure.applied(scan.exposures) is scan.exposures
    assert "the difference is not sure" in unsure.lines()[0]


def test_a_lean_that_is_not_sure_is_left():
    unsure = Axis(Estimate(1.0, 0.1), Estimate(0.01, 0.02), 10.0, 40)
    assert not unsure.leans
    assert "left as the scan says" in unsure.lines()[1]
    assert [(one.name, one.choice, one.by) for one in unsure.decisions] == [(LEAN, UPRIGHT, "likelihood ratio")]
    assert Axis(Estimate(1.0, 0.1), Estimate(0.01, 0.001), 10.0, 40).leans
    assert Axis(Estimate(1.0, 0.1), None, 10.0, 40).decisions == ()
    scan = scan_of(HALF[::10])
    np.testing.assert_array_equal(unsure.applied(scan.exposures).views.rotations, scan.views.rotations)


SHARED = Path(__file__).resolve().parents[3] / "shared/data/real"


def measured(name: str, angles=None, every: int = 1) -> Scan:
    """Frames of a measured scan over its mean flat field; angles [deg], if those of the file are not taken."""
    raw = np.load(SHARED / f"{name}.npz")
    flat, dark = (raw[one] if one in raw else raw[f"{one}s"].mean(0) for one in ("flat", "dark"))
    frames = ((raw["counts"] - dark) / (flat - dark)).astype(np.float32)
    angles = raw["angles_deg"] if angles is None else angles
    views = Views.from_angles(angles[::every], frames.shape[1:], 10e-6)
    count = len(frames[::every])
    return Scan(frames[::every], Exposures.of(views, 20.0, 0.0), np.zeros(count, dtype=bool))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured data is not here")
@pytest.mark.parametrize("every", [1, 4])
def test_the_axis_of_the_capsule(every):
    """Undivided by its air, which is 0.71 of the flat and drifts."""
    found = find_axis(measured("savu_24737_bin2", every=every))
    assert found.column == pytest.approx(42.625, abs=0.15)
    assert found.offset.error < 0.15
    assert not found.leans


@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured data is not here")
@pytest.mark.parametrize("every", [1, 6])
def test_the_axis_of_the_tooth(every):
    """Few frames do not tell where the half turn ends, and get the angles of its publishers."""
    found = find_axis(measured("tooth_bin2", None if every == 1 else np.linspace(0, 180, 181), every))
    assert found.column == pytest.approx(147.25, abs=0.3)
    assert found.offset.error < 0.15
    assert found.lean is None
    assert (found.turn is not None) == (every == 1)
