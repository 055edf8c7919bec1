"""What is not known of light that frames were divided by, in NXtomo files (docs/scan_files.md)."""

from __future__ import annotations

import h5py
import numpy as np

from ..checks import InputError, require
from ..divided_light import DividedLight
from .hdf5 import Fields
from .hdf5_writing import put

GROUP = "process/light"
LIGHT = f"entry/{GROUP}"
"""In files of our own."""
ARRAYS = ("covariances", "variances", "powers")
PLACE = ("whole", "corner", "binning")


def write_divided_light(group: h5py.Group, light: DividedLight) -> None:
    """Its arrays, and as attributes where its frames lie in whole ones."""
    put(group, "covariances", light.covariances.astype(np.float32))
    put(group, "variances", light.variances)
    put(group, "powers", light.powers)
    group.attrs.update(whole=light.whole, corner=light.corner, binning=light.binning)


def read_divided_light(fields: Fields, projections: np.ndarray) -> DividedLight | None:
    """That of a file's `projections` [N] bool, or None where it says nothing. Errors: `InputError` for what does not
    fit."""
    group = fields.group.get(GROUP)
    if not isinstance(group, h5py.Group):
        return None
    label = fields.label(GROUP)
    try:
        arrays = [np.asarray(group[name], dtype=np.float64) for name in ARRAYS]
        whole, corner, binning = (np.asarray(group.attrs[name]).astype(int).ravel() for name in PLACE)
        place = (int(whole[0]), int(whole[1])), (int(corner[0]), int(corner[1])), int(binning[0])
        found = DividedLight(arrays[0], arrays[1], arrays[2], *place)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{label} must be what holosplat correct wrote, but it lacks or garbles {error}.") from error
    count = int(projections.sum())
    require(len(found) == count, f"{label} must be of {count} projections, but it is of {len(found)}.")
    return found
