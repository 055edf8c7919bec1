"""Frames as images of other programs (TIFF, PNG) or an array (.npy): a file, or a folder of images, flats and darks.

In a folder, files named flat… and dark… (or in folders of such names) correct the others, which may be in a folder of
their own, such as projections. A text file named …angles… beside them holds their angles. Capitals do not matter.

Scans from and to TIFF files (float32) beside a `scan.json` of how each frame was taken (docs/converting.md).
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..checks import InputError, finite, note, require, require_regular
from ..scan import Scan
from ..units import number_of
from .angles import angles_of, in_order, read_angles, tell_angles
from .atomic import atomic_folder, write_json
from .lock import is_hidden
from .raw_file import DARK, FLAT, NOTHING, PROJECTION, RAW_TAKES, Loader, ScanFile
from .stacks import IMAGES, ImageStack, all_images, images_in, stack_of
from .stored_frames import light_frames, raw_loader
from .table import Table, beam_table, exposure_table, read_exposures

FIELDS = {FLAT: "flat|white|open_?beam|bright|refs?(?![a-z])|refhst", DARK: "dark"}
"""How the names of flats and of darks, and of their folders, begin, or a word in them."""
FOLDERS = {
    FLAT: "references?|ff|hf|ob|i0|air|blanks?|empty|gain|background|open[ _-]?beam",
    DARK: "dc|df|d0|offsets?|bias|black",
}
"""Names of folders of flats and of darks beside these."""
KINDS = {FLAT: "flats", DARK: "darks"}
ARRAYS = (".npy", ".npz", ".h5", ".hdf5", ".hdf", ".nxs", ".nx")
"""Endings of files of flats and darks that are no images."""
NUMPY = (".npy", ".npz")
PROJECTIONS = re.compile("proj|tomo|sample|radio", re.IGNORECASE)
"""How the names of folders of projections begin."""
ANGLES = (".txt", ".csv", ".dat", ".log", ".tlt", ".npy")
"""Endings of files of angles."""


@contextmanager
def open_images(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """An image file, or images in a folder (of names that `files` says); frames are not read; `given` and errors as of
    `open_scan`."""
    source = Path(path)
    parts = [(PROJECTION, stack_of(source))] if source.is_file() else _in_folder(source, given.get("files"))
    found = {} if source.is_file() or given.get("angles_deg") is not None else _angles(source)
    greys = _greys(source, parts, given)
    file = ScanFile.of(source, [*parts, *greys], given, found)
    _tell_order(file)
    yield replace(file, are_counts=not greys)


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
    """The projections in a folder, or in a folder within it, and the flats and darks beside them."""
    places = _places(folder)
    light = {kind: _fields_of_light(folder, places, kind) for kind in FIELDS}
    apart = {_kind(path) for path in _folders(folder)}
    files = [file for place in places for file in images_in(place, pattern) if _kind(file) in {None, *apart}]
    arrays = [] if places or pattern else _arrays_of(folder, PROJECTION)
    named = f" named {pattern}" if pattern else ""
    require(
        len(files) + len(arrays) > 0, f"{folder} must hold projections ({', '.join(IMAGES)}), but it holds none{named}."
    )
    unread = [path.name for path in _of_images(folder) if _kind(path) is None and path not in places]
    if unread:
        note(f"{folder}: the images in {', '.join(unread)} are not read")
    stack = light_frames(arrays[0], "proj|data", PROJECTION) if arrays else ImageStack.of(in_order(files))
    return [(PROJECTION, stack)] + [item for item in light.items() if item[1] is not None]


def _places(folder: Path) -> list[Path]:
    """The folders of projections: those within `folder` that are named so, or itself, or the only one that is left."""
    inner = [path for path in _of_images(folder) if _kind(path) is None]
    named = [path for path in inner if PROJECTIONS.match(path.name)]
    own = [file for file in images_in(folder) if _kind(file) is None]
    places = named or ([folder] if own else inner)
    if len(places) > 1:
        raise InputError(
            f"{folder} must hold the projections of one scan, but it has several folders of images: "
            f"{', '.join(path.name for path in places)}; name one of them, with --flats, --darks and --angles."
        )
    return places


def _folders(folder: Path) -> list[Path]:
    """The folders within `folder`, by name."""
    return sorted(path for path in folder.iterdir() if path.is_dir() and not is_hidden(path))


def _of_images(folder: Path) -> list[Path]:
    return [path for path in _folders(folder) if images_in(path)]


def _fields_of_light(folder: Path, places: list[Path], kind: int) -> Any:
    """All images in folders whose names say that they are of `kind`, and images of such names beside the folders; or
    else images of such names among the projections, in `places`, or an array or HDF5 file; None where there are none.

    Errors: `InputError` for a folder of such a name without frames, and for several arrays.
    """
    inner = [path for path in _folders(folder) if _kind(path) == kind]
    images = [file for path in inner for file in images_in(path)]
    images += [file for file in images_in(folder) if _kind(file) == kind]
    if not inner:
        images = images or [file for place in places for file in images_in(place) if _kind(file) == kind]
    if images:
        return ImageStack.of(images)
    files = [file for path in inner for file in _arrays_in(path)] or _arrays_of(folder, kind)
    require(
        len(files) > 0 or not inner,
        f"{', '.join(map(str, inner))} must hold {KINDS[kind]} ({', '.join((*IMAGES, *ARRAYS))}), but it holds none; "
        f"bring them, say them by --{KINDS[kind]}, or take the folder away.",
    )
    require(
        len(files) < 2,
        f"{folder} has several files of {KINDS[kind]}, {', '.join(file.name for file in files)}; say one by "
        f"--{KINDS[kind]}.",
    )
    return light_frames(files[0], FIELDS[kind], kind) if files else None


def _arrays_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in ARRAYS and not is_hidden(file))


def _arrays_of(folder: Path, kind: int) -> list[Path]:
    """The arrays in `folder` whose names say that they are of `kind`; of projections, NumPy's alone."""
    if kind != PROJECTION:
        return [file for file in _arrays_in(folder) if _kind(file) == kind]
    return [file for file in _arrays_in(folder) if file.suffix.lower() in NUMPY and PROJECTIONS.match(file.name)]


def _kind(path: Path) -> int | None:
    """The kind of frames, flats or darks, that the name of a file or folder says."""
    name, words = path.name.lower(), path.suffix == "" and path.is_dir()
    for kind, names in FIELDS.items():
        begins = rf"^({names})|(?<![a-z])({names})(s|_?fields?)?(?![a-z])"
        if re.search(begins, name) or (words and re.fullmatch(FOLDERS[kind], name)):
            return kind
    return None


def _angles(folder: Path) -> dict[str, Any]:
    """The angles of the text file in a folder, or in that of its projections, whose name has `angle` or `theta`."""
    found = sorted(
        file
        for place in dict.fromkeys((folder, *_places(folder)))
        for file in place.iterdir()
        if re.search("angle|theta", file.stem.lower()) and file.suffix.lower() in ANGLES
    )
    require(
        len(found) < 2,
        f"{folder} has several files of angles, {', '.join(f.name for f in found)}; say one by --angles.",
    )
    if not found:
        return {}
    angles = read_angles(found[0])
    tell_angles(angles, str(found[0]))
    return {"angles_deg": angles}


def _tell_order(found: ScanFile) -> None:
    """Say which files are the first and the last projection, with their angles, and count the flats and darks."""
    first, angles = found.stacks[0], angles_of(found.exposures.views)
    if not isinstance(first, ImageStack) or angles is None or len(angles) < 2:
        return
    ends = ", ".join(
        f"{which} {first.name(n)} at {round(angles[n], 6) + 0.0:.6g}°" for which, n in (("first", 0), ("last", -1))
    )
    counts = [f", {count} {name}" for kind, name in KINDS.items() if (count := len(found.numbers(kind)))]
    note(f"{found.path}: {number_of(len(angles), 'projection')} ({ends}){''.join(counts)}")


def _recognises(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in (*IMAGES, ".npy")
    folders = any(PROJECTIONS.match(one.name) or _kind(one) for one in _of_images(path))
    return bool(images_in(path)) or folders or bool(_arrays_of(path, PROJECTION))


MARK = f"images ({', '.join(IMAGES)}), one file or a folder of them, or an array (.npy)"
OF_IMAGES = (*RAW_TAKES, "files", "black", "white")
LOADER = raw_loader("images", MARK, _recognises, open_images, OF_IMAGES, is_general=True)


XTEKCT = ".xtekct"
SECTION = "XTekCT"


@contextmanager
def open_nikon(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """The projections that an `.xtekct` file of a Nikon scanner describes: images beside it, or in its InputFolderName,
    whose names begin with its Name.

    Distances and pixels [mm] are those at the detector of a cone of rays, which `magnified` makes parallel; images are
    divided by WhiteLevel. given: what the file does not say, by name (`TAKES`), such as the photon energy. Errors:
    `InputError` for entries that are missing or no numbers, and for other numbers of images.
    """
    source = Path(path)
    entry = _nikon_entries(source)

    def number(name: str) -> float:
        try:
            found = float(entry[name])
        except (KeyError, ValueError):
            found = np.nan
        require(
            bool(np.isfinite(found)),
            f"{path}: {name} must be a number, but it is {entry.get(name, 'missing')}; correct it.",
        )
        return found

    folder = source.parent / entry.get("InputFolderName", "").replace("\\", "/")
    require(folder.is_dir(), f"{path}: InputFolderName must be a folder, but {folder} is none; correct it.")
    name = entry.get("Name", "")
    files = [file for file in images_in(folder, given.get("files")) if file.name.startswith(name)]
    require(len(files) > 0, f"{folder} must hold images whose names begin with {name!r}, but it holds none.")
    stack, count = ImageStack.of(in_order(files)), int(number("Projections"))
    require(
        stack.shape[0] == count,
        f"{path}: Projections must be the number of images named {name}, {stack.shape[0]}, but it is {count}; choose "
        "them by --files.",
    )
    across, down = (1e-3 * number(f"DetectorPixelSize{axis}") for axis in "XY")
    require(
        bool(np.isclose(across, down)), f"{path}: detector pixels must be square, but they are {across} by {down} m."
    )
    before, behind = (1e-3 * number(name) for name in ("SrcToObject", "SrcToDetector"))
    require(behind > before > 0, f"{path}: SrcToDetector must be above SrcToObject, and that above 0; correct them.")
    found: dict[str, Any] = {"distance": behind - before, "pixel_size": across, "source_distance": before}
    found["angles_deg"] = number("InitialAngle") + number("AngularStep") * np.arange(count)
    white = np.full((1, *stack.shape[1:]), number("WhiteLevel"))
    require(bool(white[0, 0, 0] > 0), f"{path}: WhiteLevel must be above 0, but it is {white[0, 0, 0]:g}; correct it.")
    file = ScanFile.of(source, [(PROJECTION, stack), (FLAT, white)], given, found)
    _tell_order(file)
    yield file


def _nikon_entries(path: Path) -> Mapping[str, str]:
    """The entries of the section [XTekCT]."""
    require_regular(path, f"a file of a Nikon scanner ({XTEKCT})")
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment, method-assign]  # capitals matter
    try:
        parser.read_string(path.read_text(encoding="utf-8-sig", errors="replace"))
    except configparser.Error as error:
        first = error.message.splitlines()[0]
        raise InputError(f"{path} must be a text file of [sections], but it is none: {first}") from None
    require(parser.has_section(SECTION), f"{path} must have a section [{SECTION}], but it has none; name another file.")
    return parser[SECTION]


def _is_nikon(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == XTEKCT


NIKON = raw_loader("nikon", f"an {XTEKCT} file of a Nikon scanner", _is_nikon, open_nikon, (*RAW_TAKES, "files"))


FORMAT = "holosplat TIFF 1"
SCAN = "scan.json"
STACK = "frames.tif"

TiffLayout = Literal["stack", "files"]


def write_tiff(path: str | Path, scan: Scan, layout: TiffLayout = "stack") -> None:
    """Write `scan` as a folder: all frames as pages of frames.tif, or one file a frame, and scan.json."""
    import tifffile

    entries = [{**exposure_table(scan.exposures, n), "test": bool(scan.is_test[n])} for n in range(len(scan))]
    with atomic_folder(path) as folder:
        if layout == "stack":
            tifffile.imwrite(folder / STACK, scan.frames, photometric="minisblack", metadata=None)
        else:
            for n, (frame, entry) in enumerate(zip(scan.frames, entries)):
                entry["file"] = f"frame_{n:04d}.tif"
                tifffile.imwrite(folder / entry["file"], frame, photometric="minisblack", metadata=None)
        pages = {"file": STACK} if layout == "stack" else {}
        write_json(folder / SCAN, {"format": FORMAT, **beam_table(scan), **pages, "frames": entries})


def read_tiff(path: str | Path) -> Scan:
    """The scan of a folder with scan.json and the TIFF files that it names: one of many pages, or one a frame."""
    table = Table.read(Path(path) / SCAN)
    table.require_format(FORMAT)
    entries = table.tables("frames")
    require(len(entries) > 0, f"{table.label('frames')} must hold at least one frame, but it holds none.")
    if "file" in table:
        frames = _pages(table.file("file"), len(entries))
    else:
        frames = [_pages(entry.file("file"), 1)[0] for entry in entries]
    h, w = frames[0].shape
    for entry, frame in zip(entries, frames):
        where = entry.where.rstrip(".")
        require(
            frame.shape == (h, w),
            f"{table.path}: the image of {where} must have {(h, w)} pixels as the first, but it has {frame.shape}.",
        )
        finite(f"{table.path}: the image of {where}", frame)
    is_test = np.array(["test" in entry and entry.flag("test") for entry in entries])
    return Scan(np.stack(frames), read_exposures(table, entries, (h, w)), is_test, table.texts("provenance"))


def _pages(file: Path, count: int) -> list[np.ndarray]:
    """The `count` pages of a TIFF file, each [H, W]."""
    pages = all_images(file)
    require(len(pages) == count, f"{file} must hold {count} pages, one a frame, but it holds {len(pages)}.")
    return pages


def _own_folder(path: Path) -> Path | None:
    """The folder of a scan of our own that is named by itself, its scan.json or an image in it; None for others."""
    named = path.name == SCAN or path.suffix.lower() in (".tif", ".tiff")
    folder = path if path.is_dir() else path.parent if named else None
    return folder if folder and (folder / SCAN).is_file() else None


TIFF = Loader(
    *("tiff", f"a folder with {SCAN}, or an image in it", lambda path: _own_folder(path) is not None),
    lambda path, given: read_tiff(_own_folder(path) or path),
)
