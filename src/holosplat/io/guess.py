"""What a network guessed of a run's matter, and where its guesses differ, as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..checks import finite, shaped
from ..volume import Volume
from .hdf5 import Fields, open_hdf5
from .hdf5_writing import new_hdf5, put
from .volumes import NAMES, read_volume

SPREAD = "spread"
OF, VIEWS, COPIES = "of", "views", "copies"
"""An attribute of the spread: of guesses without one of the views each, or of copies of the scene."""


def write_guess(path: Path, volume: Volume, spread: np.ndarray | None, of_copies: bool = False) -> None:
    """Write δ and β that were guessed, as `write_volume` has them, and beside them /spread [Z, Y, X], the standard
    deviation of occupancy, where there is one; of_copies: in guesses of copies of the scene."""
    with new_hdf5(path, 12 * volume.delta.size) as file:
        file.attrs.update({"voxel_size": np.array(volume.grid.voxel_size), "origin": np.array(volume.grid.origin)})
        for name in NAMES:
            put(file, name, getattr(volume, name))
        if spread is not None:
            put(file, SPREAD, spread.astype(np.float32)).attrs[OF] = COPIES if of_copies else VIEWS


def read_guess(path: Path) -> tuple[Volume, np.ndarray | None, bool]:
    """What `write_guess` wrote: the volume, the spread, and whether that is of copies; `InputError` for other files."""
    volume = read_volume(path)
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        if fields.find(SPREAD) is None:
            return volume, None, False
        dataset = fields.dataset(SPREAD)
        values, of_copies = np.asarray(dataset[()], dtype=np.float32), dataset.attrs.get(OF) == COPIES
    return volume, finite(f"{path}: /spread", shaped(f"{path}: /spread", values, volume.grid.shape)), of_copies
