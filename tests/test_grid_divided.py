"""Grids with their voxels divided."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid

UNEVEN = Grid((4, 3, 5), (1.1, 0.8, 0.9), (-4.0, -2.9, 3.7))


def test_parts_lie_where_their_voxel_lies():
    fine = UNEVEN.divided((2, 3, 5))
    assert fine.shape == (20, 9, 10)
    assert fine.voxel_size == pytest.approx((0.55, 0.8 / 3, 0.18))
    for axis, parts, factor in zip(UNEVEN.axes(), fine.axes(), (2, 3, 5)):
        assert np.allclose(parts.reshape(-1, factor).mean(1), axis, atol=1e-12)


def test_ones_divide_nothing_and_less_is_refused():
    assert UNEVEN.divided((1, 1, 1)) is UNEVEN
    with pytest.raises(InputError, match=r"must be at least 1, but they are \(2, 0, 1\)"):
        UNEVEN.divided((2, 0, 1))
