"""Phase and thickness of single frames, to an HDF5 file or a folder of TIFF files (docs/export.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..checks import require, shaped
from ..scan import Exposures
from .atomic import atomic_folder, write_json
from .hdf5 import new_hdf5, put
from .table import exposure_table

FORMAT = "holosplat phase maps 1"
HDF5 = (".h5", ".hdf5")
UNITS = {"phase": "rad", "thickness": "m", "light": "relative intensity"}


@dataclass(frozen=True)
class PhaseMaps:
    """Maps [V, H, W] of V frames by name: phase [rad], perhaps thickness [m] and light (relative); exposures of the
    frames; facts: texts on material, method and the like."""

    maps: Mapping[str, np.ndarray]
    exposures: Exposures
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        strange = set(self.maps) - set(UNITS)
        require("phase" in self.maps, "phase maps must hold the phase, but it is missing; add it.")
        require(not strange, f"phase maps must be of {', '.join(UNITS)}, but there is {', '.join(strange)}; leave it.")
        for name, images in self.maps.items():
            shaped(name, images, (len(self.exposures), *self.exposures.views.shape))


def is_file(path: Path) -> bool:
    """Whether phase maps at `path` are one HDF5 file, by its name, and not a folder."""
    return path.suffix.lower() in HDF5


def write_phase_maps(path: Path, found: PhaseMaps) -> None:
    """Write an HDF5 file if `path` ends on .h5 or .hdf5, else a folder: a TIFF stack a map (float32), and maps.json."""
    exposures, views = found.exposures, found.exposures.views
    pixels = views.pixel_size if views.has_one_pixel else views.pixel_sizes
    if is_file(path):
        with new_hdf5(path, sum(4 * images.size for images in found.maps.values())) as file:
            file.attrs["format"] = FORMAT
            file.attrs.update(found.facts)
            arrays = {name: (images.astype(np.float32), UNITS[name]) for name, images in found.maps.items()}
            numbers = {"pixel_size": (pixels, "m"), "distance": (exposures.distance, "m")}
            for name, (values, unit) in (arrays | numbers | {"energy": (exposures.energy_kev, "keV")}).items():
                put(file, name, values).attrs["units"] = unit
            put(file, "rotations", views.rotations)
        return
    import tifffile

    table = {
        "format": FORMAT,
        "maps": {name: {"file": f"{name}.tif", "unit": UNITS[name]} for name in found.maps},
        "facts": dict(found.facts),
        "pixel_size_m": np.asarray(pixels).tolist(),
        "energy_kev": exposures.energy_kev.tolist(),
        "frames": [exposure_table(exposures, n) for n in range(len(exposures))],
    }
    how = {"photometric": "minisblack", "metadata": None}
    with atomic_folder(path) as folder:
        for name, images in found.maps.items():
            text = f"{name}, {UNITS[name]}".encode()
            tifffile.imwrite(folder / f"{name}.tif", images.astype(np.float32), description=text, **how)
        write_json(folder / "maps.json", table)
