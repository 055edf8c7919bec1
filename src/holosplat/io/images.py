"""Frames as images of other programs, TIFF or PNG: one file, or a folder of them, with flats and darks beside it.

In a folder, files named flat… and dark… (or in folders named flats and darks) correct the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import require
from .loader import Loader
from .nerf_synthetic import LOADER as NERF
from .r2_gaussian import LOADER as R2
from .raw_file import DARK, FLAT, NOTHING, PROJECTION, TAKES, ScanFile, exposures_of, reader, together
from .stacks import IMAGES, ImageStack, images_in, stack_of
from .tiff import LOADER as TIFF

FIELDS = ((FLAT, ("flats", "flat")), (DARK, ("darks", "dark")))


@contextmanager
def open_images(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """An image file, or all images in a folder (of those names that `files` says), checked except for the frames.

    given: what the images do not say, by name (`TAKES`). Errors: `InputError` for damaged images, and for values that
    are not said, with the option that says them.
    """
    source = Path(path)
    parts = [(PROJECTION, stack_of(source))] if source.is_file() else _in_folder(source, given.get("files"))
    stacks, kinds = together(str(path), [*parts, *_greys(source, parts, given)])
    projections = kinds == PROJECTION
    exposures = exposures_of(str(path), given, {}, stacks[0].shape[1:], projections)  # type: ignore[arg-type]
    nothing_held_out = np.zeros(int(projections.sum()), dtype=bool)
    yield ScanFile(source, str(path), stacks, kinds, exposures, nothing_held_out, kinds_label=str(path))


def _greys(path: Path, parts: list[tuple[int, Any]], given: Mapping[str, Any]) -> list[tuple[int, Any]]:
    """Flat and dark frames of one value each that bring grey images of whole numbers to the intensities that are said.

    `white` (default 1) is the intensity of the greatest number that a pixel can hold, `black` (default 0) that of 0.
    """
    if given.get("white") is None and given.get("black") is None:
        return []
    white, black = given.get("white", 1.0), given.get("black", 0.0)
    frames = parts[0][1]
    dtype = np.asarray(frames[0, slice(0, 1)]).dtype
    require(white > black, f"--white must be more than --black, but they are {white:g} and {black:g}.")
    require(
        dtype.kind in "iu",
        f"{path} holds intensities of {dtype}; leave --white and --black, which are for grey images.",
    )
    require(len(parts) == 1, f"{path} has flats or darks; leave --white and --black.")
    step = np.iinfo(dtype).max / (white - black)
    dark = np.full((1, *frames.shape[1:]), -black * step)
    return [(FLAT, dark + step), (DARK, dark)]


def _in_folder(folder: Path, pattern: str | None) -> list[tuple[int, Any]]:
    """The projections in a folder, and the flats and darks beside them."""
    beside = {kind: _fields_of_light(folder, names) for kind, names in FIELDS}
    taken = {file for files in beside.values() for file in files}
    files = [file for file in images_in(folder, pattern) if file not in taken]
    named = f" named {pattern}" if pattern else ""
    require(len(files) > 0, f"{folder} must hold projections ({', '.join(IMAGES)}), but it holds none{named}.")
    parts: list[tuple[int, Any]] = [(PROJECTION, ImageStack.of(files))]
    return parts + [(kind, ImageStack.of(found)) for kind, found in beside.items() if found]


def _fields_of_light(folder: Path, names: tuple[str, ...]) -> list[Path]:
    """Images whose names begin with one of `names`, or all in a folder of such a name."""
    inner = [file for name in names if (folder / name).is_dir() for file in images_in(folder / name)]
    return inner + [file for file in images_in(folder) if file.name.lower().startswith(names[-1])]


def _recognises(path: Path) -> bool:
    if any(loader.recognises(path) for loader in (TIFF, NERF, R2)):
        return False
    return path.suffix.lower() in IMAGES if path.is_file() else bool(images_in(path))


LOADER = Loader(
    *("images", f"images ({', '.join(IMAGES)}), one file or a folder of them", _recognises, reader(open_images)),
    *((*TAKES, "files", "black", "white"), open_images),
)
