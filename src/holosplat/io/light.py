"""The light of a run's training frames, as a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np

from ..checks import InputError, finite
from ..optics.background import ORDER, Background
from .hdf5 import open_hdf5
from .hdf5_writing import new_hdf5, put

FORMAT = "holosplat light 1"


def write_light(
    path: Path,
    light: Background | None,
    still: np.ndarray | None = None,
    marks: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Coefficients [V, (K + 1)²] of `exp(Σ c m)`, m the products of cosines of 0 to K half waves of `smooth_modes`, and
    the light [H, W] that all frames have in common; None: there is none.
    marks: further attributes."""
    with new_hdf5(path) as file:
        file.attrs.update(marks, format=FORMAT)
        if light is not None:
            file.attrs["half_waves"] = ORDER
            file.attrs["shape"] = np.asarray(light.shape)
            put(file, "coefficients", light.coefficients.numpy())
            put(file, "variances", light.variances.numpy())
        if still is not None:
            put(file, "still", still.astype(np.float32))


def read_still_light(path: Path) -> np.ndarray | None:
    """The light [H, W] that all frames have in common; None where the file has none. Errors: `InputError`."""
    with open_hdf5(path) as file:
        found = file.get("still")
        if found is None:
            return None
        if not isinstance(found, h5py.Dataset) or found.ndim != 2:
            raise InputError(f"{path}: /still must be an image [H, W], but it is not; reconstruct anew.")
        return finite(f"{path}: /still", np.asarray(found[()], dtype=np.float32))
