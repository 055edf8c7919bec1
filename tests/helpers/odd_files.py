"""A scan of eight frames, and files of it as other programs leave them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

from holosplat.geometry import Views, rotation_y
from holosplat.io.reading import Reading, Told
from holosplat.scan import Exposures, Scan

N, SHAPE, PIXEL = 8, (20, 24), 3.2e-6
KNOWN = {"energy_kev": 20.0, "distance": 0.1, "pixel_size": PIXEL}
ANGLES = np.arange(N) * 22.5
FRAMES = 1 + np.arange(N * SHAPE[0] * SHAPE[1], dtype=np.uint16).reshape(N, *SHAPE)


def said(**values: object) -> Reading:
    """What is said beside files of such frames."""
    return Reading(Told(**{**KNOWN, **values}))  # type: ignore[arg-type]


def images(folder: Path, names: list[str], frames: np.ndarray) -> Path:
    """A folder of TIFF images."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in zip(names, frames):
        tifffile.imwrite(folder / name, frame)
    return folder


def numbered(count: int) -> list[str]:
    """Names of images in their order."""
    return [f"{n:03d}.tif" for n in range(count)]


def a_scan(angles: np.ndarray = ANGLES, frames: np.ndarray | None = None) -> Scan:
    """The frames as relative intensities."""
    views = Views.from_rotations(rotation_y(angles), SHAPE, PIXEL)
    frames = FRAMES / 5000 if frames is None else frames
    return Scan(frames, Exposures.of(views, 20.0, 0.1), np.zeros(len(angles), bool))
