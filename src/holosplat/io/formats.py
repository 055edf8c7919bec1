"""Every format that the project knows: of scans, by the content of a path, and of volumes, by the suffix of a file.

A run folder is one of them: its scan is that which `source.json` names, read as the run read it. Volumes of shares that
others wrote, as TIFF images, say what their numbers are by `StackMeaning`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from ..checks import InputError, finite, require
from ..geometry import Grid
from ..matter import DeltaBeta
from ..plugins import Extended
from ..progress import Advance
from ..ranges import Within, checked_dataclass
from ..scan import Scan
from ..volume import Object, Volume
from . import arrays, euxfel, images, nxtomo
from .angles import in_order
from .hdf5 import open_hdf5
from .hdf5_guard import is_vouched
from .ome import TIFF_SUFFIXES, ZARR_SUFFIX, read_ome_tiff, read_ome_zarr, require_zarr, write_ome_tiff, write_ome_zarr
from .paraview import read_vti, write_vti
from .plain_values import both, read_both, read_mrc, read_nrrd, write_mrc, write_nrrd
from .raw_file import Loader, Retrieved, ScanFile, Writer, folder_with
from .reading import Reading
from .stacks import all_images
from .stored_frames import Mended, with_fields
from .table import Table
from .volumes import ALONE, REFRACTION, VOXEL_RANGE_M, Beside, Contents, Stored, read_stored, write_voxels

SOURCE, SUMMARY = "source.json", "summary.json"


def run_reading(path: str | Path) -> Reading:
    """How the run folder `path` read its scan, with --allow-external only as the reader allows it (`Told.vouch`);
    `InputError` for a damaged source.json."""
    table = Table.read(Path(path) / SOURCE)
    time_frame = table.values.get("time_frame")
    known = time_frame is None or time_frame in ("all", "still") or isinstance(time_frame, int)
    require(known, f"{table.label('time_frame')} must be a number, 'all' or null, but it is {time_frame!r}.")
    said = Reading.from_table(table.values.get("reading", {}), f"{table.label('reading')}")
    told = replace(said.told, allow_external=is_vouched(Path(path)))
    return Reading(told, replace(said.part, time_frame=time_frame))


def run_source(scan: Path, reading: Reading) -> dict[str, object]:
    """What source.json says of a run of `scan`, read in a certain way."""
    return {"scan": str(scan.resolve()), "time_frame": reading.part.time_frame, "reading": reading.as_table()}


def read_run_scan(path: str | Path) -> Scan:
    """The scan of the run folder `path`, read as the run read it, with the geometry that it refined. Errors:
    `InputError` when the scan is gone or cannot be read."""
    table = Table.read(Path(path) / SOURCE)
    source, summary = Path(table.text("scan")), Path(path) / SUMMARY
    there = source.exists() and source.resolve() != Path(path).resolve()
    require(there, f"{table.label('scan')} must name the run's scan, but {source} is not there or none; name another.")
    scan = read_as(source, run_reading(path))
    found = Table.read(summary).values.get("geometry") if summary.is_file() else None
    if found is None:
        return scan
    table, n = Table(summary, found, "geometry."), len(scan)
    rotations, shifts = table.numbers("rotations", (n, 3, 3)), table.numbers("shifts", (n, 2))
    planned = scan.exposures
    old = "pixel_sizes" not in found
    sizes = planned.views.pixel_sizes if old else table.numbers("pixel_sizes", (n,))
    views = replace(planned.views, rotations=rotations, shifts=shifts, scales=sizes / planned.views.pitch)
    exposures = replace(planned, views=views, distance=table.numbers("distance", (n,)))
    return scan.taken(exposures)


def read_marks(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Those of the attributes `names` that the file has at its top. Errors: `InputError`."""
    with open_hdf5(path) as file:
        return {name: str(file.attrs[name]) for name in names if name in file.attrs}


LOADERS: tuple[Loader, ...] = (
    nxtomo.LOADER,
    arrays.EXCHANGE,
    arrays.LOADER,
    images.TIFF,
    images.LOADER,
    images.NIKON,
    euxfel.LOADER,
    Loader(
        *("run", f"a run folder, with config.json and {SOURCE}", folder_with("config.json", SOURCE)),
        lambda path, given: read_run_scan(path),
    ),
)
"""Every format of ours that scans are read from; a new one is a file and a line here (docs/adding.md)."""
ADDED: Extended[Loader] = Extended({}, "holosplat.loaders")
"""Those of other packages, by name."""


def _write_nxtomo(out: Path, scan: Scan, options: Mapping[str, Any], retrieved: Retrieved | None) -> str:
    require(not out.is_dir(), f"{out} must be a file to write, but it is a folder; add a file name.")
    nxtomo.write_scan(out, scan)
    return ""


def _write_tiff_scan(out: Path, scan: Scan, options: Mapping[str, Any], retrieved: Retrieved | None) -> str:
    images.write_tiff(out, scan, options.get("tiff", "stack"))
    return ""


WRITERS: Extended[Writer] = Extended(
    {"nxtomo": Writer(_write_nxtomo), "tiff": Writer(_write_tiff_scan, ("tiff",))}, "holosplat.writers"
)
"""Every format that scans are written in, by name; other packages add theirs (docs/adding.md)."""


def read(path: str | Path, given: Mapping[str, Any] | None = None) -> Scan:
    """Read the scan at `path`, a file or folder of any format in `LOADERS` or `ADDED`.

    given: values that files lack, or that replace theirs, by name (`Loader.takes`): energy_kev [keV], distance [m],
    pixel_size [m], angles_deg [N], and the others of `Loader.takes`.

    The frames [N, H, W] are read when they are used. Errors: `InputError` for a path that does not exist, holds no
    known scan or a damaged one, and for `given` values that do not belong to its format.

    Examples:

        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(4, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, hs.DeltaBeta(5.8e-7, 2.6e-10))
        >>> exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.05)
        >>> hs.write_scan("scan.nxs", hs.simulate(scene, exposures))
        >>> hs.read("scan.nxs")
        Scan(4 frames of 16 × 16 pixels, 1 of them held out)
        >>> hs.read("scan.nxs", {"distance": 0.06}).exposures.distance
        array([0.06, 0.06, 0.06, 0.06])
    """
    given = given or {}
    return _loader_for(path, given).read(Path(path), given)


def read_as(path: str | Path, reading: Reading, joined: bool = True) -> Scan:
    """The scan at `path`, as `read`, with the metadata and the part of `reading`; joined: as of `Reading.applied`."""
    return _read(path, reading, False, joined)


def read_frames(path: str | Path, reading: Reading, joined: bool = True) -> Scan:
    """The scan of `read_as`, for those who take the logarithm of its frames: pixels that are not above 0 are missing,
    and their number is said."""
    return _read(path, reading, True, joined)


def _read(path: str | Path, reading: Reading, mended: bool, joined: bool) -> Scan:
    reading.told.vouch(Path(path))
    scan = read(path, reading.told.given(loader_of(path).takes))
    if mended:
        frames = Mended(scan, scan.source.shape)
        scan = Scan.of(frames, scan.exposures, scan.is_test, scan.provenance, scan.light)
    return reading.applied(scan, joined)


@contextmanager
def open_raw(path: str | Path, given: Mapping[str, Any]) -> Iterator[ScanFile]:
    """The file or folder at `path`, open frame by frame with its flats and darks and those that are `given`. Errors:
    `InputError` as of `read`, and for a format of corrected frames."""
    loader = _loader_for(path, given)
    if loader.opens is None:
        raise InputError(f"{path} holds corrected frames already ({loader.name}); use it as it is.")
    with loader.opens(Path(path), given) as file:
        yield with_fields(file, given)


def _loader_for(path: str | Path, given: Mapping[str, Any]) -> Loader:
    """The loader of `path`; `InputError` for values that it does not take."""
    loader = loader_of(path)
    stray = [name for name in given if name not in loader.takes]
    require(not stray, f"{', '.join(stray)}: not for a source in {loader.name}; leave it away.")
    return loader


def loader_of(path: str | Path) -> Loader:
    """The loader of `path`; `InputError` if none or more than one recognises it."""
    found = Path(path)
    require(found.exists(), f"{path} must be a scan, but there is no such file or folder; check the path.")
    every = (*LOADERS, *ADDED.values())
    loaders = [loader for loader in every if loader.recognises(found)]
    loaders = [loader for loader in loaders if not loader.is_general] or loaders
    if len(loaders) == 1:
        return loaders[0]
    if loaders:
        kinds = " and ".join(loader.name for loader in loaders)
        raise InputError(f"{path} must be a scan of one format, but it is ambiguous: {kinds}; keep the files of one.")
    known = "; ".join(f"{loader.mark} ({loader.name})" for loader in every)
    raise InputError(f"{path} must be a scan, but it {_content(found)}, which is none of what is known: {known}.")


def _content(path: Path) -> str:
    """What a file, or a folder, holds by the endings of names."""
    if not path.is_dir():
        return f"is a {path.suffix} file" if path.suffix else "is a file without an ending"
    endings = Counter((one.suffix or one.name) + "/" * one.is_dir() for one in path.iterdir())
    if not endings:
        return "is an empty folder"
    return f"holds {', '.join(f'{count} of {name}' for name, count in endings.most_common(3))}"


HDF5_SUFFIXES = (".h5", ".hdf5")


@dataclass(frozen=True)
class VolumeFormat:
    """A format of volumes of δ and β. files: all that it makes; needs: asks for a package."""

    write: Callable[[Path, Object, Grid, Advance, Contents], None]
    read: Callable[[Path], Stored]
    files: Callable[[Path], tuple[Path, ...]] = lambda path: (path,)
    needs: Callable[[], Any] = lambda: None


def _write_tiff(path: Path, obj: Object, grid: Grid, on_progress: Advance, of: Contents) -> None:
    write_ome_tiff(path, obj.voxelise(grid), of)
    on_progress(1.0)


FORMATS = {
    **dict.fromkeys(HDF5_SUFFIXES, VolumeFormat(write_voxels, read_stored)),
    **dict.fromkeys(TIFF_SUFFIXES, VolumeFormat(_write_tiff, read_ome_tiff)),
    ZARR_SUFFIX: VolumeFormat(write_ome_zarr, read_ome_zarr, needs=require_zarr),
    ".vti": VolumeFormat(write_vti, read_vti),
    ".nrrd": VolumeFormat(write_nrrd, partial(read_both, read_one=read_nrrd), both),
    ".mrc": VolumeFormat(write_mrc, partial(read_both, read_one=read_mrc), both),
}


def volume_format(path: Path, called: str = "a volume") -> VolumeFormat:
    """The format of the suffix of `path`, which messages call `called`; `InputError` for others, and for a missing
    package."""
    found = FORMATS.get(path.suffix.lower())
    require(
        found is not None,
        f"{called} must be a file whose name ends with {', '.join(FORMATS)}, by which its format is chosen, but it is "
        f"{path}; name another one.",
    )
    assert found is not None
    found.needs()
    return found


def write_volume_file(
    path: Path,
    obj: Object,
    grid: Grid,
    on_progress: Advance = lambda fraction: None,
    of: Contents = REFRACTION,
    beside: Beside = ALONE,
) -> None:
    """Write δ and β (or arrays `of`) of `obj` on `grid`, by the suffix of `path`, with what is `beside` them in
    HDF5."""
    if beside and path.suffix.lower() in HDF5_SUFFIXES:
        write_voxels(path, obj, grid, on_progress, of, beside)
    else:
        volume_format(path).write(path, obj, grid, on_progress, of)


def of_time(path: Path, frame: int) -> Path:
    """The path with the number of a time, _t0000 say, before its suffixes, of which .ome.zarr and .ome.tif are two."""
    stem, ome, _ = path.stem.partition(".ome")
    return path.with_name(f"{stem}_t{frame:04d}{ome}{path.suffix}")


def read_volume_file(path: Path, delta_told: bool = True) -> Volume:
    """δ and β of a volume file of any format, by its suffix; without delta_told β stands for δ."""
    return volume_format(path).read(path).volume(path, delta_told)


@checked_dataclass
class StackMeaning:
    """What a stack of TIFF images shows.

    voxel_size: edge of its cubic voxels [m]; of: δ and β of a value of one.
    stacked: the axis along which pages follow each other: y for slices across the rotation axis (rows of a page along
    z), z for slices along it (rows of a page along y).
    """

    voxel_size: Annotated[float, Within(*VOXEL_RANGE_M, unit="metres")]
    of: DeltaBeta
    stacked: Literal["y", "z"] = "y"


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
    one = len(shapes) == 1
    require(one, f"{path} must hold grey images of one size, but it holds {', '.join(map(str, shapes)) or 'none'}.")
    return finite(f"{path}", np.stack(pages))
