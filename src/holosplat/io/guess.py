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


def write_guess(path: Path, volume: Volume, spread: np.ndarray | None) -> None:
    """Write δ and β that were guessed, as `write_volume` has them, and beside them /spread [Z, Y, X], the standard
    deviation of occupancy where there is one."""
    with new_hdf5(path, 12 * volume.delta.size) as file:
        file.attrs.update({"voxel_size": np.array(volume.grid.voxel_size), "origin": np.array(volume.grid.origin)})
        for name in NAMES:
            put(file, name, getattr(volume, name))
        if spread is not None:
            put(file, SPREAD, spread.astype(np.float32))


def read_guess(path: Path) -> tuple[Volume, np.ndarray | None]:
    """What `write_guess` wrote; `InputError` for other files."""
    volume = read_volume(path)
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        if fields.find(SPREAD) is None:
            return volume, None
        values = np.asarray(fields.dataset(SPREAD)[()], dtype=np.float32)
    return volume, finite(f"{path}: /spread", shaped(f"{path}: /spread", values, volume.grid.shape))
