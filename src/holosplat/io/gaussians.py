"""Clouds of Gaussians as HDF5 files."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import torch

from ..representations.gaussians import PARAMETERS, GaussianCloud
from .atomic import atomic_path
from .hdf5 import Fields, attribute_numbers, open_hdf5

FORMAT = "holosplat Gaussians 1"


def write_gaussians(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud: its parameters (float32, as the class documents them), `unit_length` [m] and its materials."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            format=FORMAT,
            unit_length=cloud.unit_length,
            unit_length_units="m",
            delta=cloud.delta,
            beta=cloud.beta,
        )
        if cloud.second is not None:
            file.attrs["second"] = cloud.second
        for name, parameter in zip(PARAMETERS, cloud.parameters):
            file[name] = parameter.detach().numpy()


def read_gaussians(path: Path) -> GaussianCloud:
    """The cloud that `write_gaussians` wrote; `InputError` if the file is damaged or no such file."""
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        arrays = [fields.numbers(fields.need(name)).astype(np.float32) for name in PARAMETERS]
        unit, delta, beta = (
            float(attribute_numbers(f"{path}: @{name}", file.attrs.get(name), (1,))[0])
            for name in ("unit_length", "delta", "beta")
        )
        other = file.attrs.get("second")
        second = None if other is None else attribute_numbers(f"{path}: @second", other, (2,))
    return GaussianCloud(
        [torch.from_numpy(a) for a in arrays], unit, delta, beta, None if second is None else (second[0], second[1])
    )
