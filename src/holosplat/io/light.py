"""The light of a run's training frames as a file, and the light that a scan's frames were divided by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import h5py
import numpy as np

from ..checks import InputError, as_written, finite, require
from ..divided_light import DividedLight
from .hdf5 import Fields, new_hdf5, open_hdf5, put

if TYPE_CHECKING:
    from ..optics.background import Background

FORMAT = "holosplat light 1"


def write_light(
    path: Path,
    light: Background | None,
    still: np.ndarray | None = None,
    marks: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write the light of frames: coefficients [V, (K + 1)²] of exp(Σ c m), m the products of cosines of 0 to K half
    waves (`smooth_modes`), and the light [H, W] that all frames have in common; None: there is none.

    marks: more attributes.
    """
    from ..optics.background import ORDER  # needs torch, which takes longer than all else

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
    """The light of a file's `projections` [N] bool; None without such. Errors: `InputError` for what does not fit."""
    group = fields.group.get(GROUP)
    if not isinstance(group, h5py.Group):
        return None
    label = fields.label(GROUP)
    with as_written(label, "what holosplat correct wrote"):
        arrays = [np.asarray(group[name], dtype=np.float64) for name in ARRAYS]
        whole, corner, binning = (np.asarray(group.attrs[name]).astype(int).ravel() for name in PLACE)
        place = (int(whole[0]), int(whole[1])), (int(corner[0]), int(corner[1])), int(binning[0])
        found = DividedLight(arrays[0], arrays[1], arrays[2], *place)
    count = int(projections.sum())
    require(len(found) == count, f"{label} must be of {count} projections, but it is of {len(found)}.")
    return found
