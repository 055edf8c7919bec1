"""Faults that stay in their pixels are told from an object that turns."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.preprocess import fixed_pattern

SHAPE, COUNT = (15, 64), 40


def frames(pattern: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Two balls, one off the axis, that turn over 180° before faulty pixels."""
    draw, x, y = np.random.default_rng(2), np.arange(SHAPE[1]) - 31.5, np.arange(SHAPE[0])[:, None] - 7.0
    made = []
    for angle in np.linspace(0, np.pi, COUNT, endpoint=False):
        chords = [np.sqrt(np.clip(r**2 - (x - a * np.cos(angle)) ** 2 - y**2, 0, None)) for a, r in ((17, 6), (0, 9))]
        made.append(np.exp(-0.01 * sum(chords)) * pattern * (1 + noise * draw.normal(size=SHAPE)))
    return np.stack(made)


def test_a_pattern_is_found_beside_what_turns():
    pattern = np.exp(0.02 * np.random.default_rng(1).normal(size=SHAPE))
    fine = np.log(pattern)
    for noise in (0.0, 0.01):
        shown = frames(pattern, noise)
        found = fixed_pattern(lambda i, shown=shown: shown[i], COUNT, 9)
        left = np.std(np.log(found) - fine)
        assert left < 0.55 * np.std(fine)  # the median of nine columns takes some of it
        corrected = shown / found
        clean = frames(np.ones(SHAPE), noise)
        assert np.std(corrected / clean - 1) < 0.55 * np.std(shown / clean - 1)


def test_without_faults_hardly_anything_is_taken():
    """The axis' own ball keeps its rims in place, which is all that is lost: less than a twentieth of its shadow."""
    clean = frames(np.ones(SHAPE))
    found = fixed_pattern(lambda i: clean[i], COUNT, 5)
    assert np.abs(np.log(found)).max() < 0.05 * np.abs(np.log(clean)).max()


def test_a_dead_column_is_one_and_no_more():
    pattern = np.ones(SHAPE)
    pattern[:, 5] = 0.9
    shown = frames(pattern)
    found = fixed_pattern(lambda i: shown[i], COUNT, 5)
    assert found[:, 5] == pytest.approx(0.9, abs=0.005)
    assert np.delete(found, 5, axis=1) == pytest.approx(1.0, abs=0.01)


def test_what_cannot_be_told_is_refused():
    for width in (0, 4, 33):
        with pytest.raises(InputError, match="rings must be an odd number"):
            fixed_pattern(lambda i: np.ones(SHAPE), COUNT, width)
    with pytest.raises(InputError, match="at least 8 projections"):
        fixed_pattern(lambda i: np.ones(SHAPE), 7, 5)
