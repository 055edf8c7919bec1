"""Motion in parts: bodies that move, turn and stretch as polynomials say, and what half-sets leave of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holosplat.motion.split import Split, Window, believed, shrunk
from holosplat.specimens.red_cells import icosphere

TIMES = np.linspace(1.0, 2.5, 11)
SHAPE = icosphere(1)[0] * np.array([3.0, 2.0, 1.5])
WEIGHTS = np.ones(len(SHAPE))
SPIN = np.array([0.2, -0.1, 0.3])


def moved(times: np.ndarray, stretch: float = 0.05) -> np.ndarray:
    """[T, P, 3]: an accelerated middle, an even turn about an axis, and a stretch that grows evenly in body axes."""
    s = times[:, None] - TIMES[-1]
    centre = np.array([1.0, 2, 3]) + s * [0.5, 4, 0] + s**2 * [0, -0.3, 0.2]
    grown = SHAPE * (1 + stretch * s[..., None] * np.array([1.0, -0.5, -0.5]))
    return centre[:, None] + np.einsum("tij,tpj->tpi", Rotation.from_rotvec(s * SPIN).as_matrix(), grown)


def split(places: np.ndarray, degree: int = 2) -> Split:
    return Split.of(places, TIMES, Window(TIMES[0], TIMES[-1], degree), WEIGHTS, len(TIMES) - 1)


def test_polynomials_go_on_exactly():
    """Of any shape, beyond the window too; and the powers are apart: the lower ones do not change with the degree."""
    window = Window(1.0, 2.5, 2)
    values = np.stack([1 - TIMES, TIMES**2, 0 * TIMES], axis=1)[:, None]
    found = window.coefficients(TIMES, values)
    later = np.array([0.0, 3.0, 7.0])
    assert window.values(later, found)[:, 0] == pytest.approx(np.stack([1 - later, later**2, 0 * later], 1))
    assert Window(1.0, 2.5, 1).coefficients(np.array([1.0, 2.5]), np.array([2.0, 5.0])) == pytest.approx([3.5, 1.5])


def test_a_body_goes_on_as_it_moves():
    """Twice as far as the window; the turn and the stretch are even, so that nothing is left of them."""
    later, window = TIMES[-1] + np.array([0.0, 1.5, 3.0]), Window(TIMES[0], TIMES[-1])
    found = split(moved(TIMES))
    assert found.places(later, window) == pytest.approx(moved(later), abs=1e-6)
    assert np.abs(found.rest).max() < 1e-6


def test_a_stiff_body_keeps_its_last_shape():
    window, later = Window(TIMES[0], TIMES[-1]), TIMES[-1] + np.array([2.0])
    found = split(moved(TIMES)).stiffened(window).places(later, window)
    turn = Rotation.from_rotvec(2.0 * SPIN).as_matrix()
    middle = moved(later).mean(1)
    assert found[0] - middle == pytest.approx(SHAPE @ turn.T, abs=1e-6)


def test_what_is_noise_is_not_believed():
    """Of many bodies: coefficients that half-sets agree on are kept, those of noise alone vanish."""
    random, window = np.random.default_rng(0), Window(TIMES[0], TIMES[-1])
    clean = [split(moved(TIMES, 0.05 * random.normal()) + random.normal(size=3)) for _ in range(60)]

    def noisy(scale: float) -> list[Split]:
        """Noise on the accelerations of turns."""
        off = scale * random.normal(size=(60, 3, 3)) * [[0], [0], [1]]
        return [Split(one.shape, one.centre, one.turn + o, one.stretch, one.rest) for one, o in zip(clean, off)]

    first, second = noisy(0.2), noisy(0.2)
    both = [Split(a.shape, a.centre, 0.5 * (a.turn + b.turn), a.stretch, a.rest) for a, b in zip(first, second)]
    kept = shrunk(both, (first, second))
    noise = np.array([one.turn[2] for one in both])
    assert np.abs([one.turn[2] for one in kept]).mean() < 0.5 * np.abs(noise).mean()
    assert np.array([one.turn[:2] for one in kept]) == pytest.approx(np.array([one.turn[:2] for one in both]))
    assert np.array([one.centre for one in kept]) == pytest.approx(np.array([one.centre for one in both]))
    again = shrunk(both, None)[3]
    assert again.places(TIMES, window) == pytest.approx(both[3].places(TIMES, window), abs=1e-6)


def test_belief_is_the_part_that_is_no_noise():
    """τ² = 3, σ² = 1 in all bodies; a body with ten times the noise of the others is believed less."""
    square, noise = np.full((5, 1), 4.0), np.ones((5, 1))
    assert believed(noise, square) == pytest.approx(0.75)
    noise[0] = 10.0
    assert believed(noise, square)[0] == pytest.approx(3 / (3 + 4))
    assert believed(0 * noise, 0 * square) == pytest.approx(1)
    assert believed(noise, 0.5 * noise) == pytest.approx(0)
