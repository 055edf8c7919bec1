"""Clouds of Gaussians as HDF5 files of version 0.1 held them; `io.objects` writes all kinds now."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..checks import InputError, finite, positive
from ..matter import Matter
from ..representations.gaussians import PARAMETERS, GaussianCloud
from .hdf5 import Fields, attribute_numbers, open_hdf5

FORMAT = "holosplat Gaussians 1"


def read_gaussians(path: Path) -> GaussianCloud:
    """The cloud that version 0.1 wrote; `InputError` if the file is damaged or no such file."""
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        arrays = {fields.label(name): fields.numbers(fields.need(name)) for name in PARAMETERS}
        unit, delta, beta = (
            float(attribute_numbers(f"{path}: @{name}", file.attrs.get(name), (1,))[0])
            for name in ("unit_length", "delta", "beta")
        )
        other = file.attrs.get("second")
        second = None if other is None else attribute_numbers(f"{path}: @second", other, (2,))
    tensors = [torch.from_numpy(finite(label, array).astype(np.float32)) for label, array in arrays.items()]
    if second is not None:
        matter = Matter.several((delta, beta), (float(second[0]), float(second[1])))
    else:
        matter = Matter.one(delta, beta) if tensors[3].shape[1:] == (1,) else Matter.free(delta, beta)
    try:
        return GaussianCloud(tensors, positive("unit_length", unit, "metres"), matter)
    except InputError as error:
        raise InputError(f"{path} must hold Gaussians, but it does not: {error}") from error
