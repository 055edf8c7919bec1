"""Scans of every format that the project knows: `read` recognises the format by the content of a path.

A run folder is one of them: its scan is that which `source.json` names, read as the run read it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from ..checks import InputError, require
from ..frames import Frames
from ..scan import Scan
from . import arrays, euxfel, images, nerf_synthetic, nxtomo, r2_gaussian, tiff
from .hdf5 import open_hdf5
from .hdf5_guard import is_vouched
from .raw_file import Loader, ScanFile, folder_with
from .reading import Reading
from .stored_frames import Mended, with_fields
from .table import Table

SOURCE, SUMMARY = "source.json", "summary.json"


def run_reading(path: str | Path) -> Reading:
    """How the run folder `path` read its scan; `InputError` for a source.json that is damaged.

    Whether the scan may bring values of other files, the folder does not decide: it is as whoever reads it allows
    (`Told.vouch`).
    """
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
    """The scan of the run folder `path`, read as the run read it: its frames of the time that the run is of, too.

    Where the run refined the geometry, its frames are where it found them. Errors: `InputError` when the scan is no
    longer there or cannot be read.
    """
    table = Table.read(Path(path) / SOURCE)
    scan = Path(table.text("scan"))
    there = scan.exists() and scan.resolve() != Path(path).resolve()
    require(there, f"{table.label('scan')} must name the run's scan, but {scan} is not there or none; name another.")
    return _where_found(Path(path) / SUMMARY, read_as(scan, run_reading(path)))


def _where_found(summary: Path, scan: Scan) -> Scan:
    """`scan` with the exposures that `summary` has, if the run found any; errors: `InputError` for other frames."""
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


ScanFormat = Literal["nxtomo", "nerf-synthetic", "tiff", "r2-gaussian"]
"""Formats that scans are written in."""

LOADERS: tuple[Loader, ...] = (
    nxtomo.LOADER,
    arrays.EXCHANGE,
    arrays.LOADER,
    tiff.LOADER,
    images.LOADER,
    euxfel.LOADER,
    nerf_synthetic.LOADER,
    r2_gaussian.LOADER,
    Loader(
        *("run", f"a run folder, with config.json and {SOURCE}", folder_with("config.json", SOURCE)),
        lambda path, given: read_run_scan(path),
    ),
)
"""Every format that scans are read from; a new one is a file and a line here (docs/adding.md)."""


def read(path: str | Path, given: Mapping[str, Any] | None = None) -> Scan:
    """Read the scan at `path`, a file or folder of any format in `LOADERS`.

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
    """The scan at `path`, as `read`, with what is said of it beside its files, and cut to the part that is taken.

    joined: as of `Reading.applied`.
    """
    return _read(path, reading, False, joined)


def read_frames(path: str | Path, reading: Reading, joined: bool = True) -> Scan:
    """The scan at `path`, as `read_as`, for those who take the logarithm of its frames or compare with them: pixels
    that are not above 0 are missing, and their number is said."""
    return _read(path, reading, True, joined)


def _read(path: str | Path, reading: Reading, mended: bool, joined: bool) -> Scan:
    reading.told.vouch(Path(path))
    scan = read(path, reading.told.given(loader_of(path).takes))
    if mended:
        source = Mended(scan.source, None if isinstance(scan.source, Frames) else scan.missing)
        scan = Scan.of(source, scan.exposures, scan.is_test, scan.provenance, scan.light)
    return reading.applied(scan, joined)


@contextmanager
def open_raw(path: str | Path, given: Mapping[str, Any]) -> Iterator[ScanFile]:
    """The file or folder at `path`, open frame by frame, with its flats and darks and those that are `given`.

    Errors: `InputError` as of `read`, and for a format whose frames are corrected already.
    """
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
    loaders = [loader for loader in LOADERS if loader.recognises(found)]
    loaders = [loader for loader in loaders if not loader.is_general] or loaders
    if len(loaders) == 1:
        return loaders[0]
    if loaders:
        kinds = " and ".join(loader.name for loader in loaders)
        raise InputError(f"{path} must be a scan of one format, but it is ambiguous: {kinds}; keep the files of one.")
    known = "; ".join(f"{loader.mark} ({loader.name})" for loader in LOADERS)
    raise InputError(f"{path} must be a scan, but it {_content(found)}, which is none of what is known: {known}.")


def _content(path: Path) -> str:
    """What a file, or a folder, holds by the endings of names."""
    if not path.is_dir():
        return f"is a {path.suffix} file" if path.suffix else "is a file without an ending"
    endings = Counter((one.suffix or one.name) + "/" * one.is_dir() for one in path.iterdir())
    if not endings:
        return "is an empty folder"
    return f"holds {', '.join(f'{count} of {name}' for name, count in endings.most_common(3))}"
