"""The size of red cells by what a network guesses of them."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.bodies.rest_shape import GUESSED, extent_like, guessed_cells
from holosplat.mesh import TriangleMesh
from holosplat.specimens.membrane.resting import resting_cell


def cells(*factors: float) -> list[TriangleMesh]:
    rest = resting_cell()
    return [TriangleMesh(factor * rest.vertices, rest.faces) for factor in factors]


def test_pieces_do_not_count_as_cells():
    extent = float(np.ptp(resting_cell().vertices, axis=0).max())
    assert extent_like(cells(1.2)) == pytest.approx(1.2 * extent)
    assert extent_like(cells(1.0, 0.5, 1.0, 0.4, 0.5, 0.4, 1.02, 0.3)) == pytest.approx(extent)


def test_guessed_cells_have_that_size_and_may_have_another():
    body = guessed_cells(9e-6)
    assert float(np.ptp(body.mesh(0.5e-6).vertices, axis=0).max()) == pytest.approx(18, rel=1e-3)
    assert body.uncertain == GUESSED
