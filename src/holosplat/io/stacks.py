"""Frames in image files (TIFF, PNG) and NumPy arrays, read one by one when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..checks import InputError, require
from .guard import mapped_array
from .leftovers import is_hidden
from .tiff_guard import image_numbers, image_values, open_tiff, require_one_channel

IMAGES = (".tif", ".tiff", ".png")


@dataclass(frozen=True)
class ImageStack:
    """Grey images [n, H, W] of files; pages of TIFF files are images of their own.

    pages: file and page of each image.
    """

    pages: tuple[tuple[Path, int], ...]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, files: Sequence[Path]) -> ImageStack:
        """All pages of `files`, in this order. Errors: `InputError` for files that hold no grey images."""
        pages = tuple((file, page) for file in files for page in _pages(file))
        require(len(pages) > 0, f"{files[0]} must hold an image, but it holds none; it may be damaged.")
        first = _image(*pages[0])
        return cls(pages, (len(pages), *first.shape))

    def name(self, number: int) -> str:
        """The name of the file with image `number`, and which of its images that is, if there are more."""
        file, page = self.pages[number]
        alone = page == 0 and self.pages[number + 1 : number + 2] != ((file, 1),)
        return file.name if alone else f"{file.name}, image {page}"

    def __getitem__(self, index: tuple[int, slice]) -> np.ndarray:
        number, rows = index
        file, page = self.pages[number]
        image = _image(file, page)
        require(
            image.shape == self.shape[1:],
            f"{file} must have {self.shape[1:]} pixels as the first image, but it has {image.shape}.",
        )
        return image[rows]


def stack_of(path: Path, pattern: str | None = None) -> ImageStack | np.ndarray:
    """The frames of an image file, of all images in a folder (those that match `pattern`), or of a .npy file.

    A folder's files are taken in the order of their names, with numbers in them counted as numbers.
    """
    if path.suffix.lower() == ".npy" and path.is_file():
        return _array(path)
    files = images_in(path, pattern) if path.is_dir() else [path]
    require(len(files) > 0, f"{path} must hold images ({', '.join(IMAGES)}), but it holds none{_like(pattern)}.")
    require(files[0].is_file(), f"{path} must be images or a folder of them, but there is nothing; check the path.")
    require(
        _is_image(files[0]),
        f"{path} must be images ({', '.join(IMAGES)}), a folder of them, .npy or HDF5, but it is none; convert it.",
    )
    return ImageStack.of(files)


def images_in(folder: Path, pattern: str | None = None) -> list[Path]:
    """The image files in a folder whose names match `pattern`, by name."""
    return sorted(file for file in folder.glob(pattern or "*") if _is_image(file))


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGES and file.is_file() and not is_hidden(file)


def _like(pattern: str | None) -> str:
    return f" named {pattern}" if pattern else ""


def _array(path: Path) -> np.ndarray:
    found = mapped_array(path, "a NumPy array")
    require(
        found.ndim in (2, 3) and found.dtype.kind in "iuf",
        f"{path} must hold frames [N, H, W] of numbers, but it holds {found.dtype} of the shape {found.shape}.",
    )
    return found.reshape(-1, *found.shape[-2:])


def _pages(file: Path) -> list[int]:
    if file.suffix.lower() == ".png":
        return [0]
    with open_tiff(file) as opened:
        found = image_numbers(opened, file)  # first: the axes of OME leave pages that say less of themselves
        require_one_channel(opened, file)
        return found


def _image(file: Path, page: int) -> np.ndarray:
    """One grey image [H, W]; of a coloured one whose colours are equal, one of them."""
    try:
        image = _png(file) if file.suffix.lower() == ".png" else _tiff(file, page)
    except InputError:
        raise
    except Exception as error:  # tifffile and Pillow raise many kinds for damaged files
        raise InputError(f"{file} must be a complete image, but it is damaged or none: {error}.") from None
    if image.ndim == 3 and image.shape[2] in (3, 4) and (image[..., :3] == image[..., :1]).all():
        image = image[..., 0]
    grey = image.ndim == 2 and image.dtype.kind in "iuf"
    require(grey, f"{file} must hold grey images of numbers, but one is {image.dtype} of the shape {image.shape}.")
    return image


def _png(file: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(file, formats=("PNG",)) as opened:
        return np.asarray(opened.convert("RGB") if opened.mode == "P" else opened)


def _tiff(file: Path, page: int) -> np.ndarray:
    with open_tiff(file) as opened:
        return image_values(opened, file, page)
