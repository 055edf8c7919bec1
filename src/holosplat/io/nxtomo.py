"""Scans from and to NeXus NXtomo files (HDF5): the table in docs/scan_files.md, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from ..checks import finite, require, shaped
from ..divided_light import DividedLight
from ..scan import ENERGY_RANGE_KEV, Exposures, Scan
from ..units import wavelength
from ..version import __version__
from .hdf5 import new_hdf5, put, room_for
from .light import LIGHT, write_divided_light
from .nxtomo_geometry import CONE, DATA_NAMES, FLIPS
from .raw_file import NOTHING, PROJECTION, RAW_TAKES
from .scan_file import ANGLES, IMAGE_KEY, MASK, SPLIT, open_scan
from .stored_frames import raw_loader


@dataclass(frozen=True)
class RawLayout:
    """The fields of a file of raw counts beside a scan's exposures.

    kinds: [N] image keys of all frames (0 projection, 1 flat, 2 dark).
    mask: [H, W] `pixel_mask` of NXdetector, 0 for good pixels, as stored.
    flips: whether the stored frames are upside down, and mirrored left to right.
    """

    kinds: np.ndarray
    mask: np.ndarray
    flips: tuple[bool, bool] = (False, False)


class Add(Protocol):
    """Takes the next frame of a file."""

    def __call__(self, frame: np.ndarray, missing: np.ndarray | None = None, /) -> None:
        """frame: [H, W]; missing: [H, W] bool, pixels without a value."""
        ...


def read_scan(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Scan:
    """The projections of an NXtomo file, read when they are asked for, as (frame - mean dark) / (mean flat - mean dark)
    if it has such frames; `given` and errors as of `open_scan`."""
    return LOADER.read(Path(path), given)


def write_scan(path: str | Path, scan: Scan) -> None:
    """Write a scan as NXtomo (docs/scan_files.md); `path` is replaced only once all is written.

    Missing pixels are written as NaN.

    Errors: `InputError` where `path` cannot be written.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(4, shape=(16, 20), pixel_size=1e-6)
        >>> exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.05)
        >>> scan = hs.Scan(np.ones((4, 16, 20)), exposures, is_test=np.zeros(4))
        >>> hs.write_scan("scan.nxs", scan)
        >>> hs.read("scan.nxs")
        Scan(4 frames of 16 × 20 pixels, 0 of them held out)
    """
    with scan_writer(path, scan.exposures, scan.is_test, scan.provenance, light=scan.light) as add:
        for frames, missing in scan.blocks_with_missing():
            for i, frame in enumerate(frames):
                add(frame, None if missing is None else missing[i])


@contextmanager
def scan_writer(
    path: str | Path,
    exposures: Exposures,
    is_test: np.ndarray,
    provenance: dict[str, str],
    raw: RawLayout | None = None,
    light: DividedLight | None = None,
    *,
    mask: np.ndarray | None = None,
) -> Iterator[Add]:
    """A scan file that grows frame by frame: yields a function that takes the next frame, [H, W] relative intensity,
    and its missing pixels [H, W] bool or None, which become NaN.

    With `raw` the file holds counts (uint16), and exposures and is_test describe all its frames. mask: [H, W] bool,
    pixels that are missing in all frames, whose values were filled. light: what is not
    known of light that the frames were divided by, if they were.

    The file appears at `path` when the block ends and all frames are there, and not at all when the block raises
    (Ctrl-C too): no frame is kept in memory. is_test: [N] bool. `view_rotation` holds the poses exactly;
    `rotation_angle`, which other programs read, the nearest rotation about y. Provenance goes to
    /entry/process/provenance, one text a dataset. Errors: `InputError` for frames of another shape, not finite,
    or not as many as there are exposures, and where the file cannot be written.
    """
    for key, value in provenance.items():
        good = isinstance(key, str) and isinstance(value, str) and key and "\0" not in key + value
        require(bool(good), f"provenance must map names to texts, but {key!r} maps to {value!r}; correct it.")
    is_test = shaped("split", np.asarray(is_test, dtype=bool), (len(exposures),))
    count = 0
    size = len(exposures) * math.prod(exposures.views.shape) * (2 if raw else 4)
    with new_hdf5(path, size) as file:
        data = _write_entry(file, exposures, is_test, provenance, raw)
        if mask is not None:
            put(file, f"entry/{MASK}", mask.astype(np.uint32))
        if light is not None:
            write_divided_light(_group(file, LIGHT, "NXcollection"), light)

        def add(frame: np.ndarray, missing: np.ndarray | None = None) -> None:
            nonlocal count
            require(count < len(data), f"a scan of {len(data)} exposures takes as many frames, but there are more.")
            checked = finite("frames", shaped("frame", np.asarray(frame), exposures.views.shape))
            data[count] = checked if missing is None else np.where(missing, np.nan, checked)
            count += 1

        yield add
        require(count == len(data), f"a scan of {len(data)} exposures needs as many frames, but there are {count}.")


def _write_entry(
    file: h5py.File,
    exposures: Exposures,
    is_test: np.ndarray,
    provenance: dict[str, str],
    raw: RawLayout | None,
) -> h5py.Dataset:
    """All of a scan file but its frames, whose dataset is returned."""
    file.attrs.update(NX_class="NXroot", default="entry", creator=f"holosplat {__version__}")
    entry = _group(file, "entry", "NXentry", default="data")
    entry["definition"] = "NXtomo"
    put(entry, SPLIT, is_test.astype(np.uint8))
    data = _write_instrument(_group(entry, "instrument", "NXinstrument"), exposures, raw)
    sample, rotations = _group(entry, "sample", "NXsample"), exposures.views.rotations
    sample["name"] = "sample"
    put(sample, "view_rotation", rotations)
    # R(θ) is nearest to R where tr(R(θ)ᵀ R) = cos θ (R00 + R22) + sin θ (R02 - R20) is largest.
    theta = np.arctan2(rotations[:, 0, 2] - rotations[:, 2, 0], rotations[:, 0, 0] + rotations[:, 2, 2])
    _put(sample, "rotation_angle", np.rad2deg(theta), "deg")
    _put(sample, "time", exposures.time, "s")
    _write_process(_group(entry, "process", "NXprocess"), provenance)
    plot = _group(entry, "data", "NXdata", signal="data", axes=["rotation_angle", ".", "."])
    for source in (DATA_NAMES[0], IMAGE_KEY, ANGLES[0]):
        entry[source].attrs["target"] = f"/entry/{source}"
        plot[source.rsplit("/", 1)[1]] = entry[source]
    return data


def _group(parent: h5py.Group, name: str, nx_class: str, **attributes: str | list[str]) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    group.attrs.update(attributes)
    return group


def _put(group: h5py.Group, name: str, value: np.ndarray | float, units: str) -> None:
    put(group, name, value).attrs["units"] = units


def _write_instrument(instrument: h5py.Group, exposures: Exposures, raw: RawLayout | None) -> h5py.Dataset:
    source = _group(instrument, "source", "NXsource")
    energy = float(exposures.energy_kev[0]) if exposures.has_one_energy else exposures.energy_kev
    beam = _group(instrument, "beam", "NXbeam")
    if exposures.energy_kev.min() < ENERGY_RANGE_KEV[0]:  # light; of electrons a wavelength is told as an energy
        _put(beam, "incident_wavelength", wavelength(np.asarray(energy)), "m")
    else:
        source["probe"] = "x-ray"
        _put(beam, "incident_energy", energy, "keV")
    if np.any(exposures.bandwidth):
        _put(beam, "incident_energy_spread", exposures.energy_kev * exposures.bandwidth, "keV")
    detector = _group(instrument, "detector", "NXdetector")
    shape = (len(exposures), *exposures.views.shape)
    data = room_for(detector, "data", shape, np.uint16 if raw else np.float32, chunk=(1, *shape[1:]))
    put(
        detector,
        "image_key",
        np.asarray(raw.kinds if raw else np.full(len(exposures), PROJECTION), dtype=np.int32),
    )
    if raw is not None:
        put(detector, MASK.rsplit("/", 1)[1], np.asarray(raw.mask, dtype=np.uint32))
        for name, flipped in zip(FLIPS, raw.flips):
            detector[name.rsplit("/", 1)[1]] = flipped
    views = exposures.views
    for axis in "xy":
        _put(detector, f"{axis}_pixel_size", views.pixel_size if views.has_one_pixel else views.pixel_sizes, "m")
    same = bool((exposures.distance == exposures.distance[0]).all())  # a scalar is what most programs expect
    _put(detector, "distance", exposures.distance[0] if same else exposures.distance, "m")
    _put(detector, "shift", exposures.views.shifts, "m")
    if views.sources is not None:
        _put(detector, CONE.rsplit("/", 1)[1], views.sources, "m")
    _put(detector, "psf_sigma", exposures.psf_sigma_px, "px")
    return data


def _write_process(process: h5py.Group, provenance: dict[str, str]) -> None:
    process["program"], process["version"] = "holosplat", __version__
    texts = _group(process, "provenance", "NXcollection")
    for key, value in provenance.items():
        texts[_escaped(key)] = value


def _escaped(key: str) -> str:
    """A provenance name as an HDF5 name, in which "/" and a lone "." have a meaning of their own."""
    escaped = key.replace("%", "%25").replace("/", "%2F")
    return escaped.replace(".", "%2E") if set(escaped) == {"."} else escaped


def _recognises(path: Path) -> bool:
    return path.is_file() and h5py.is_hdf5(path)


LOADER = raw_loader("nxtomo", "an HDF5 file", _recognises, open_scan, (*RAW_TAKES, "entry"), is_general=True)
