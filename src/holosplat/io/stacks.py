"""Frames in image files (TIFF, PNG) and NumPy arrays, read one by one; checks of TIFF files before they are read."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, MissingError, note, require, require_regular
from .guard import RATIO, SMALL, mapped_array, require_declared, require_inflated, require_memory, undamaged
from .lock import is_hidden

IMAGES = (".tif", ".tiff", ".png")


@dataclass(frozen=True)
class ImageStack:
    """Grey images [n, H, W] of files; pages of TIFF files are images of their own.

    pages: file and page of each image; dtype: of the first one, which all others have.
    """

    pages: tuple[tuple[Path, int], ...]
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, files: Sequence[Path]) -> ImageStack:
        """All pages of `files`, in this order. Errors: `InputError` for files that hold no grey images."""
        pages = tuple((file, page) for file in files for page in _pages(file))
        require(len(pages) > 0, f"{files[0]} must hold an image, but it holds none; it may be damaged.")
        first = _image(*pages[0])
        return cls(pages, (len(pages), first.shape[0], first.shape[1]), first.dtype.newbyteorder("="))

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
        found = image.dtype.newbyteorder("=")
        require(
            found == self.dtype,
            f"{file} must hold numbers of {self.dtype} as the first image, but they are {found}, whose scale may be "
            "another; save all images alike, or choose some by --files.",
        )
        return image[rows]


def stack_of(path: Path, pattern: str | None = None) -> ImageStack | np.ndarray:
    """The frames of an image file, of all images in a folder (those that match `pattern`), or of a .npy file.

    A folder's files are taken in the order of their names, with numbers in them counted as numbers.
    """
    if path.suffix.lower() == ".npy" and path.is_file():
        found = mapped_array(path, "a NumPy array")
        require(
            found.ndim in (2, 3) and found.dtype.kind in "iuf",
            f"{path} must hold frames [N, H, W] of numbers, but it holds {found.dtype} of the shape {found.shape}.",
        )
        return found.reshape(-1, *found.shape[-2:])
    files = images_in(path, pattern) if path.is_dir() else [path]
    like = f" named {pattern}" if pattern else ""
    require(len(files) > 0, f"{path} must hold images ({', '.join(IMAGES)}), but it holds none{like}.")
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


def _pages(file: Path) -> list[int]:
    if file.suffix.lower() == ".png":
        return [0]
    with open_tiff(file) as opened:
        found = image_numbers(opened, file)  # first: the axes of OME leave pages that say less of themselves
        if opened.is_imagej or opened.is_ome:
            axes = dict(zip(opened.series[0].axes, opened.series[0].shape))
            several = axes.get("C", 1) > 1 and max(axes.get("T", 1), axes.get("Z", 1)) > 1
            require(
                not several, f"{file} must hold frames of one channel, but it has {axes.get('C')}; save one of them."
            )
        return found


def _image(file: Path, page: int) -> np.ndarray:
    """One grey image [H, W]; of a coloured one whose colours are equal, one of them."""
    with undamaged(file, "a complete image"):
        if file.suffix.lower() == ".png":
            from PIL import Image

            with Image.open(file, formats=("PNG",)) as png:
                image = np.asarray(png.convert("RGB") if png.mode == "P" else png)
        else:
            with open_tiff(file) as opened:
                image = image_values(opened, file, page)
    if image.ndim == 3 and image.shape[2] in (3, 4) and (image[..., :3] == image[..., :1]).all():
        note(f"{file.parent}: images there have three equal colours, of which one is taken")
        image = image[..., 0]
    _require_grey(image, file)
    return image


DEFLATE = (8, 32946)
"""TIFF's numbers of deflate, of which there are two."""
WHITE_IS_ZERO, BLACK_IS_ZERO, COLOURS, PALETTE = range(4)
"""TIFF's photometric interpretations that are read."""
UPRIGHT = 1
APART = 2
"""TIFF's planar configuration of colours that are stored one after another."""


@contextmanager
def open_tiff(file: Path) -> Iterator[Any]:
    """`file` opened by tifffile. Errors: `InputError` for one that is damaged or none."""
    import tifffile

    require_regular(file, "a TIFF file")
    with undamaged(file, "a complete TIFF file"):
        try:
            with tifffile.TiffFile(file) as opened:
                yield opened
        except InputError:
            raise  # its text may hold any word, as a file's name does
        except Exception as error:
            if "imagecodecs" not in str(error):
                raise
            raise MissingError(
                f"{file} is compressed in a way that needs a package ({error}); install it by pip install "
                '"holosplat[codecs]" (imagecodecs), or save the file without compression.'
            ) from None


def image_numbers(opened: Any, file: Path) -> list[int]:
    """The numbers of an open TIFF file's images: whole pages, or planes behind the only page (as of ImageJ). Errors:
    `InputError` for pages in a circle or beyond the end, and for missing planes."""
    places, whole, following, tiff = set[int](), list[int](), 0, opened.tiff  # tifffile leaves pages beyond the end
    while True:
        try:
            page = opened.pages[len(places)]
        except IndexError:
            break
        require(page.offset not in places, f"{file} must hold its pages one after another, but they run in a circle.")
        places.add(page.offset)
        whole += [] if page.is_reduced and whole else [len(places) - 1]
        opened.filehandle.seek(page.offset)
        (tags,) = struct.unpack(tiff.tagnoformat, opened.filehandle.read(tiff.tagnosize))
        opened.filehandle.seek(page.offset + tiff.tagnosize + tags * tiff.tagsize)
        (following,) = struct.unpack(tiff.offsetformat, opened.filehandle.read(tiff.offsetsize))
    require(following == 0, f"{file} must hold its pages whole, but the one after {len(places)} is not; save it anew.")
    if len(whole) == 1:
        return list(range(_planes(opened, file)))
    samples = _samples(opened.pages[0])
    return [page * samples + sample for page in whole for sample in range(samples)]


def _samples(page: Any) -> int:
    """The images in a page: 3 or 4 where tifffile was given so many and took them for colours, one after another."""
    apart = page.is_shaped and int(page.planarconfig) == APART
    return int(page.samplesperpixel) if apart else 1


def _planes(opened: Any, file: Path) -> int:
    """The planes of the one page of an open TIFF file."""
    page, series = opened.pages[0], opened.series[0]
    if (samples := _samples(page)) > 1:
        return samples
    planes = int(np.prod(series.shape, dtype=object)) // max(1, int(np.prod(page.shape, dtype=object)))
    if opened.is_imagej:
        planes = max(planes, int(opened.imagej_metadata.get("images", 1)))
    if planes <= 1:
        return 1
    whole = series.dataoffset is not None and int(page.compression) == 1
    size = file.stat().st_size - (series.dataoffset or 0)
    declared = planes * int(np.prod(page.shape, dtype=object)) * np.dtype(series.dtype).itemsize
    require(
        whole and declared <= size,
        f"{file} must hold {planes} images behind its one page, but it is cut short or compressed; save it anew.",
    )
    return planes


def image_values(opened: Any, file: Path, number: int) -> np.ndarray:
    """The values of image `number` of an open TIFF file, after a look at what it declares.

    It is turned upright as its orientation says, and white that is stored as 0 becomes the greatest number.
    """
    samples, is_plane = _samples(opened.pages[0]), False
    try:
        page = opened.pages[number // samples]
    except IndexError:
        page, is_plane = opened.pages[0], True
    label = f"{file}: an image of {'x'.join(map(str, page.shape))}"
    declared = int(np.prod(page.shape, dtype=object)) * np.dtype(page.dtype or "u1").itemsize
    require_memory(label, declared)
    require_declared(label, declared, file.stat().st_size)
    most = max(SMALL, 2 * declared)  # tiles have margins
    for offset, size in zip(page.dataoffsets, page.databytecounts) if int(page.compression) in DEFLATE else ():
        if size * RATIO > most:
            opened.filehandle.seek(offset)
            require_inflated(label, opened.filehandle.read(size), most)
    if is_plane:  # one of those behind the only page
        opened.filehandle.seek(opened.series[0].dataoffset + number * declared)
        content = opened.filehandle.read(declared)
        whole = len(content) == declared
        require(whole, f"{file} must hold {number + 1} images, but it is cut short; save it anew.")
        values = np.frombuffer(content, np.dtype(page.dtype).newbyteorder(opened.byteorder)).reshape(page.shape)
    else:
        values = page.asarray()
    return _upright(page, _grey(page, values[number % samples] if samples > 1 else values, file), file)


def all_images(file: Path) -> list[np.ndarray]:
    """The grey values of all images of a TIFF file. Errors: `InputError` for one that is damaged or none."""
    with open_tiff(file) as opened:
        images = [image_values(opened, file, number) for number in image_numbers(opened, file)]
    for image in images:
        _require_grey(image, file)
    return images


def _require_grey(image: np.ndarray, file: Path) -> None:
    grey = image.ndim == 2 and image.dtype.kind in "iuf"
    require(grey, f"{file} must hold grey images of numbers, but one is {image.dtype} of the shape {image.shape}.")


def _grey(page: Any, values: np.ndarray, file: Path) -> np.ndarray:
    """Values [rows, columns] that grow with the brightness, whatever numbers the file stores for it."""
    tag = page.tags.get("PhotometricInterpretation")
    kind = BLACK_IS_ZERO if tag is None else int(tag.value)
    known = kind in (WHITE_IS_ZERO, BLACK_IS_ZERO, COLOURS, PALETTE)
    require(known, f"{file} must hold grey images, but it holds {page.photometric!r}; save it as grey.")
    if kind == WHITE_IS_ZERO:
        require(
            values.dtype.kind == "u",
            f"{file} says that 0 is white, which has no meaning for {values.dtype}; save it with 0 as black.",
        )
        note(f"{file.parent}: images there have 0 as white; they are turned to 0 as black")
        return np.asarray((1 << int(page.bitspersample)) - 1 - values, dtype=values.dtype)
    if kind == PALETTE:
        table = np.asarray(page.colormap)
        grey = bool((table == table[0]).all())
        require(grey, f"{file} must hold grey images, but its numbers are those of colours; save it as grey.")
        return table[0][values]
    return values


def _upright(page: Any, values: np.ndarray, file: Path) -> np.ndarray:
    """The image as its orientation (1 to 8 of TIFF 6.0) says that it is seen."""
    tag = page.tags.get("Orientation")
    kind = UPRIGHT if tag is None else int(tag.value)
    if kind == UPRIGHT:
        return values
    require(1 <= kind <= 8, f"{file} must have an orientation from 1 to 8, but it is {kind}; save it anew.")
    note(f"{file.parent}: images there are turned upright, as their orientation {kind} says")
    if kind > 4:  # rows are columns
        values, kind = values.swapaxes(0, 1), {5: 1, 6: 2, 7: 3, 8: 4}[kind]
    return values[:: -1 if kind in (3, 4) else 1, :: -1 if kind in (2, 3) else 1]
