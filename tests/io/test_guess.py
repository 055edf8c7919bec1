"""What a network guessed, as a file."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.io.volumes import read_guess, read_volume, write_guess
from holosplat.volume import Volume

GRID = Grid((3, 4, 5), (1e-6, 1e-6, 1e-6), (0.0, 1e-6, 2e-6))


@pytest.mark.parametrize("of_copies", [False, True])
@pytest.mark.parametrize("spread", [None, np.random.default_rng(0).random(GRID.shape).astype(np.float32)])
def test_a_guess_comes_back_and_is_a_volume_to_others(tmp_path, spread, of_copies):
    delta = np.random.default_rng(1).random(GRID.shape).astype(np.float32)
    write_guess(tmp_path / "guess.h5", Volume(delta, 1e-3 * delta, GRID), spread, of_copies)

    volume, found, of = read_guess(tmp_path / "guess.h5")

    assert np.array_equal(volume.delta, delta)
    assert volume.grid == read_volume(tmp_path / "guess.h5").grid == GRID
    assert (found is None) == (spread is None)
    assert found is None or (np.array_equal(found, spread) and of == of_copies)


def test_a_spread_of_another_shape_is_refused(tmp_path):
    path, values = tmp_path / "guess.h5", np.ones(GRID.shape, np.float32)
    write_guess(path, Volume(values, values, GRID), values)
    with h5py.File(path, "a") as file:
        del file["spread"]
        file["spread"] = np.ones((2, 2, 2))

    with pytest.raises(InputError, match="/spread must have the shape"):
        read_guess(path)
