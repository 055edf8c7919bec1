"""Images of TIFF files that nobody vouches for: they hold what they declare, and no more, and are turned upright."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, MissingError, note, require, require_regular
from .guard import RATIO, SMALL, require_declared, require_inflated, require_memory

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
    try:
        with tifffile.TiffFile(file) as opened:
            yield opened
    except (InputError, MemoryError):
        raise
    except Exception as error:  # tifffile raises many kinds for damaged files
        if "imagecodecs" in str(error):
            raise MissingError(
                f"{file} is compressed in a way that needs a package ({error}); install it by pip install "
                '"holosplat[codecs]" (imagecodecs), or save the file without compression.'
            ) from None
        raise InputError(f"{file} must be a complete TIFF file, but it is damaged or none: {error}.") from None


def image_numbers(opened: Any, file: Path) -> list[int]:
    """The numbers of the images of an open TIFF file: its pages, without smaller copies of others, or, where there is
    one page, the planes behind it (ImageJ writes large stacks so). Errors: `InputError` for pages that run in a circle
    or beyond its end, and for fewer planes than ImageJ declares."""
    places, whole, following = set[int](), list[int](), 0
    while True:
        try:
            page = opened.pages[len(places)]
        except IndexError:
            break
        require(page.offset not in places, f"{file} must hold its pages one after another, but they run in a circle.")
        places.add(page.offset)
        whole += [] if page.is_reduced and whole else [len(places) - 1]
        following = _next_page(opened, page)
    require(following == 0, f"{file} must hold its pages whole, but the one after {len(places)} is not; save it anew.")
    if len(whole) == 1:
        return list(range(_planes(opened, file)))
    samples = _samples(opened.pages[0])
    return [page * samples + sample for page in whole for sample in range(samples)]


def require_one_channel(opened: Any, file: Path) -> None:
    """`InputError` for a hyperstack of ImageJ or OME whose images are those of several channels."""
    if opened.is_imagej or opened.is_ome:
        axes = dict(zip(opened.series[0].axes, opened.series[0].shape))
        several = axes.get("C", 1) > 1 and max(axes.get("T", 1), axes.get("Z", 1)) > 1
        require(not several, f"{file} must hold frames of one channel, but it has {axes.get('C')}; save one of them.")


def _next_page(opened: Any, page: Any) -> int:
    """Where the page after `page` begins [bytes]; 0 for none. tifffile leaves pages beyond the end of a file."""
    tiff, handle = opened.tiff, opened.filehandle
    handle.seek(page.offset)
    (tags,) = struct.unpack(tiff.tagnoformat, handle.read(tiff.tagnosize))
    handle.seek(page.offset + tiff.tagnosize + tags * tiff.tagsize)
    (found,) = struct.unpack(tiff.offsetformat, handle.read(tiff.offsetsize))
    return int(found)


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
    samples = _samples(opened.pages[0])
    try:
        page, plane = opened.pages[number // samples], None
    except IndexError:
        page, plane = opened.pages[0], number
    label = f"{file}: an image of {'x'.join(map(str, page.shape))}"
    declared = int(np.prod(page.shape, dtype=object)) * np.dtype(page.dtype or "u1").itemsize
    require_memory(label, declared)
    require_declared(label, declared, file.stat().st_size)
    if int(page.compression) in DEFLATE:
        _require_segments(page, label, declared)
    values = page.asarray() if plane is None else _plane(opened, plane, file)
    return _upright(page, _grey(page, values[number % samples] if samples > 1 else values, file), file)


def _plane(opened: Any, number: int, file: Path) -> np.ndarray:
    """Plane `number` behind the one page of an open TIFF file."""
    page = opened.pages[0]
    dtype = np.dtype(page.dtype).newbyteorder(opened.byteorder)
    size = int(np.prod(page.shape)) * dtype.itemsize
    opened.filehandle.seek(opened.series[0].dataoffset + number * size)
    content = opened.filehandle.read(size)
    require(len(content) == size, f"{file} must hold {number + 1} images, but it is cut short; save it anew.")
    return np.frombuffer(content, dtype).reshape(page.shape)


def all_images(file: Path) -> list[np.ndarray]:
    """The values of all images of a TIFF file. Errors: `InputError` for one that is damaged or none."""
    with open_tiff(file) as opened:
        return [image_values(opened, file, number) for number in image_numbers(opened, file)]


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


def _require_segments(page: Any, label: str, declared: int) -> None:
    """Strips and tiles of a page unpack to no more than the page declares (tiles have margins: twice that)."""
    handle = page.parent.filehandle
    for offset, size in zip(page.dataoffsets, page.databytecounts):
        if size * RATIO > max(SMALL, 2 * declared):
            handle.seek(offset)
            require_inflated(label, handle.read(size), max(SMALL, 2 * declared))
