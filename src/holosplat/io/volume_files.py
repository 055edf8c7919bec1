"""Volumes as specimens: files that say what they are, and stacks of TIFF images, which the user explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import finite, in_range, require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..ranges import Small, ranged
from ..volume import Volume
from .file_order import in_order
from .ome_tiff import TIFF_SUFFIXES
from .tiff_guard import all_images
from .volume_formats import read_volume_file
from .volumes import VOXEL_RANGE_M


@dataclass(frozen=True)
@ranged
class StackMeaning:
    """What a stack of TIFF images shows.

    voxel_size: edge of its cubic voxels [m]; of: δ and β of a value of one.
    stacked: the axis along which pages follow each other: y for slices across the rotation axis (rows of a page along
    z), z for slices along it (rows of a page along y).
    """

    voxel_size: Small
    of: DeltaBeta
    stacked: Literal["y", "z"] = "y"

    def __post_init__(self) -> None:
        in_range("voxel_size", self.voxel_size, *VOXEL_RANGE_M, unit="metres")
        require(self.stacked in ("y", "z"), f"stacked must be y or z, but it is {self.stacked!r}.")


def read_specimen(paths: Sequence[Path], meaning: StackMeaning | None) -> Volume:
    """The volume of one file that says what it is (`read_volume_file`); or of TIFF files, one of many pages, or many in
    the order of their names, about the origin.

    meaning: of TIFF files that do not say it themselves. Errors: `InputError` for other files, for several without a
    meaning, for formats that say it with one, and for images of different sizes.
    """
    if meaning is None:
        require(
            len(paths) == 1, f"a volume must be one file, but there are {len(paths)}; for images, give --voxel-size."
        )
        return read_volume_file(paths[0])
    for path in paths:
        require(
            path.suffix.lower() in TIFF_SUFFIXES,
            f"--voxel-size and the like are of TIFF images, but {path} is none; leave them out where files say it.",
        )
    values = np.concatenate([_pages(path) for path in in_order(paths)])
    if meaning.stacked == "y":
        values = values.transpose(1, 0, 2)
    values = values.astype(np.float64)
    grid = Grid.centred((values.shape[0], values.shape[1], values.shape[2]), meaning.voxel_size)
    return Volume(meaning.of.delta * values, meaning.of.beta * values, grid)


def _pages(path: Path) -> np.ndarray:
    """The pages [P, rows, columns] of a TIFF file."""
    require(path.is_file(), f"{path} must be a TIFF file, but there is none; correct the path.")
    pages = all_images(path)
    shapes = sorted({page.shape for page in pages})
    grey = len(shapes) == 1 and len(shapes[0]) == 2 and all(page.dtype.kind in "iuf" for page in pages)
    require(grey, f"{path} must hold grey images of one size, but it holds {', '.join(map(str, shapes)) or 'none'}.")
    return finite(f"{path}", np.stack(pages))
