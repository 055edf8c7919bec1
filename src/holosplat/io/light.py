"""The light of a run's training frames, as a file."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from ..optics.background import ORDER, Background
from .atomic import atomic_path

FORMAT = "holosplat light 1"


def write_light(path: Path, light: Background) -> None:
    """Coefficients [V, (K + 1)²] of `exp(Σ c m)`, m the products of cosines of 0 to K half waves of `smooth_modes`."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["half_waves"] = ORDER
        file.attrs["shape"] = np.asarray(light.shape)
        file["coefficients"] = light.coefficients.numpy()
        file["variances"] = light.variances.numpy()
