"""Runs of the European XFEL: cameras as views, trains and pulses as times, by the package extra_data.

A run is a folder of files RAW-R0001-DA01-S00000.h5 and so on. A camera such as the Shimadzu HPV-X2 is a source
(`SPB_EHD_HPVX2_1/CAM/CAMERA:daqOutput`), whose key `data.image.pixels` holds the frames of each train, [P, H, W].
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, MissingError, UnsaidError, as_written, positive, require, warn
from ..frames import Derived, Taken
from ..preprocess.pixels import filled, lit, mean_frame, relative_intensity
from ..scan import Exposures, Scan
from .hdf5 import open_hdf5
from .raw_file import DARK, FLAT, NOTHING, PROJECTION, TAKES, Loader, ScanFile, exposures_of, together
from .reading import marked

FILES = re.compile(r"(RAW|CORR|PROC)-R\d+-\w+-S\d+\.h5$")
SOURCES = "*HPVX2*"
PIXELS, MASK = "data.image.pixels", "data.image.mask"
RUN = "a run of the European XFEL"
TRAIN_INTERVAL_S = 0.1
"""Trains come ten times a second, and are numbered one by one (Decking et al. 2020, Nature Photonics 14, 391)."""


@dataclass(frozen=True)
class KeyStack:
    """The frames [n, H, W] of one camera, those of a train one after another; places: train and pulse of each frame;
    is_marked: whether the run has masks of its pixels (`MASK`)."""

    path: Path
    source: str
    places: tuple[tuple[int, int], ...]
    shape: tuple[int, int, int]
    is_marked: bool = False

    def __getitem__(self, index: tuple[int, slice]) -> np.ndarray:
        return self._read(PIXELS, index[0])[index[1]]

    def defective(self, number: int) -> np.ndarray:
        """[H, W] bool: the pixels of a frame that the facility marks as defective."""
        return self._read(MASK, number) != 0 if self.is_marked else np.zeros(self.shape[1:], dtype=bool)

    def _read(self, name: str, number: int) -> np.ndarray:
        from extra_data import by_id

        train, pulse = self.places[number]
        with as_written(self.path, RUN):
            key = _run(str(self.path))[self.source, name]
            single = len(key.entry_shape) == 2
            frame = key.select_trains(by_id[[train]]).ndarray(roi=() if single else (slice(pulse, pulse + 1),))
            return frame.reshape(self.shape[1:])


@dataclass(frozen=True)
class ModuleFrames(Derived):
    """The frames of several cameras, each corrected by its own fields: frame t·M + m is that of camera m at time t.

    dark, light: [M, H, W] mean dark field, and mean flat field less that; light None where there are no flats.
    mask: [M, H, W] bool, pixels without light. These, those that the facility marks, and values that are no numbers
    are missing.
    """

    stacks: tuple[KeyStack, ...]
    dark: np.ndarray
    light: np.ndarray | None
    mask: np.ndarray
    shape: tuple[int, int, int]

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        frames, marked = (
            np.empty((len(numbers), *self.shape[1:]), dtype=np.float32),
            self.mask[numbers % len(self.mask)],
        )
        for i, n in enumerate(numbers):
            time, camera = divmod(int(n), len(self.stacks))
            raw = self.stacks[camera][time, slice(0, self.shape[1])].astype(np.float64)
            frames[i] = raw if self.light is None else relative_intensity(raw, self.dark[camera], self.light[camera])
            marked[i] |= self.stacks[camera].defective(time)
        return filled(str(self.stacks[0].path), frames, ~np.isfinite(frames) & ~marked, marked, numbers)


def read_euxfel(path: Path, given: Mapping[str, Any] = NOTHING) -> Scan:
    """All cameras of a run as the views of a scan, at every train and pulse that is taken.

    given: energy_kev, distance, pixel_size, angles_deg of the cameras; sources, names of cameras with * and ?; trains
    and pulses, numbers and ranges counted from 0; frame_rate of the camera [Hz]; flats and darks, runs of the same
    cameras. Errors: `InputError` for cameras, trains or pulses that the run does not have, and for what is not said.
    """
    stacks = _cameras(path, given)
    dark = np.stack([_mean(camera, given, "darks") for camera in stacks])
    light = np.stack([_mean(camera, given, "flats") for camera in stacks]) - dark if given.get("flats") else None
    require(light is not None or not given.get("darks"), "--darks needs --flats, by which frames are divided.")
    h, w = stacks[0].shape[1:]
    mask = np.zeros((len(stacks), h, w), dtype=bool)
    if light is not None:
        light, mask = lit(str(path), light, mask)
    frames = ModuleFrames(stacks, dark, light, mask, (len(stacks) * stacks[0].shape[0], h, w))
    exposures = exposures_of(str(path), given, {}, (h, w), np.ones(len(stacks), dtype=bool))
    exposures = exposures.repeated(_times(stacks[0], given))
    return Scan.of(frames, exposures, np.zeros(len(exposures), dtype=bool), _told(stacks))


@contextmanager
def open_euxfel(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """One camera of a run, with the flats and darks of other runs; given and errors as of `read_euxfel`."""
    stacks = _cameras(Path(path), given)
    require(
        len(stacks) == 1,
        f"cameras are corrected one by one, but {path} has {', '.join(stack.source for stack in stacks)}; choose one "
        "by --sources, and join what comes out (holosplat join).",
    )
    camera = stacks[0]
    parts = [
        (PROJECTION, camera),
        *((kind, _other(camera, given, name)) for kind, name in ((FLAT, "flats"), (DARK, "darks"))),
    ]
    joined, kinds = together(str(path), parts)
    shape = (camera.shape[1], camera.shape[2])
    one = exposures_of(str(path), given, {}, shape, np.ones(1, dtype=bool))
    exposures: Exposures = one.repeated(_times(camera, given))
    label, held_out = f"{path}: {camera.source}", np.zeros(len(exposures), dtype=bool)
    mask = np.logical_or.reduce([camera.defective(n) for n in range(camera.shape[0] if camera.is_marked else 1)])
    facts = {"marked": mask, "texts": _told(stacks), "has_given_fields": True}
    yield ScanFile(Path(path), label, joined, kinds, exposures, held_out, **facts)


def _cameras(path: Path, given: Mapping[str, Any]) -> tuple[KeyStack, ...]:
    """A stack for each camera that is wanted, of the trains that all of them have."""
    wanted = [word.strip() for word in str(given.get("sources") or SOURCES).split(",")]
    with as_written(path, RUN):
        run = _run(str(path))
        having = [source for source in sorted(run.instrument_sources) if PIXELS in run.keys_for_source(source)]
        names = [source for source in having if any(fnmatch(source, f"*{word}*") for word in wanted)]
        require(
            len(names) > 0,
            f"{path} must have cameras named {', '.join(wanted)}, but those with {PIXELS} are "
            f"{', '.join(having) or 'none'}; name them by --sources.",
        )
        trains = _trains(path, run, names, given.get("trains"))
        entry = [run[name, PIXELS].entry_shape for name in names]
        require(
            len(entry[0]) in (2, 3) and all(shape == entry[0] for shape in entry),
            f"{path}: all cameras must have the same frames, [pulses, rows, columns], but theirs are "
            f"{', '.join(str(tuple(shape)) for shape in entry)}; take one by --sources.",
        )
        kinds = {np.dtype(run[name, PIXELS].dtype) for name in names}
        require(
            all(kind.kind in "iuf" for kind in kinds) and 0 not in entry[0],
            f"{path}: {PIXELS} must hold numbers, but holds {', '.join(map(str, kinds))} {tuple(entry[0])}.",
        )
        count = 1 if len(entry[0]) == 2 else entry[0][0]
        pulses = np.flatnonzero(marked("--pulses", given.get("pulses") or ":", count))
        places = tuple((int(train), int(pulse)) for train in trains for pulse in pulses)
        shape = (len(places), *entry[0][-2:])
        masks = [MASK in run.keys_for_source(name) and run[name, MASK].entry_shape == entry[0] for name in names]
        return tuple(KeyStack(path, name, places, shape, has) for name, has in zip(names, masks))


def _trains(path: Path, run: Any, names: list[str], wanted: str | None) -> np.ndarray:
    """The trains of which all cameras have frames, in their order, with a warning of lost ones between them."""
    having = [set(run[name, PIXELS].drop_empty_trains().train_ids) for name in names]
    common, known = set.intersection(*having), set(run.train_ids).union(*having)
    every = min(np.diff(sorted(known)), default=1)
    lost = sorted((known | set(range(min(known, default=0), max(known, default=0), int(every)))) - common)
    if lost and common:
        shown = ", ".join(map(str, lost[:8])) + (" …" if len(lost) > 8 else "")
        warn(
            f"{path}: {len(lost)} of {len(lost) + len(common)} trains are lost, for not all cameras have them: {shown}"
        )
    require(len(common) > 0, f"{path} has no train of which all of {', '.join(names)} have frames; name others.")
    trains = np.array(sorted(common), dtype=np.int64)
    return trains[marked("--trains", wanted or ":", len(trains))]


def _times(stack: KeyStack, given: Mapping[str, Any]) -> np.ndarray:
    """[n] seconds since the first frame."""
    trains, pulses = np.array(stack.places).T
    several = len(np.unique(pulses)) > 1
    rate = given.get("frame_rate")
    if several and rate is None:
        raise UnsaidError(
            f"{stack.path} does not say how often the camera takes a frame; say it by --frame-rate, such as 1.128e6.",
            {"frame_rate": 1e6},
        )
    period = 1 / positive("--frame-rate", rate, "Hz") if several else 0.0
    return TRAIN_INTERVAL_S * (trains - trains[0]) + period * (pulses - pulses[0])


def _other(camera: KeyStack, given: Mapping[str, Any], name: str) -> KeyStack | None:
    """The frames of the same camera in another run, of all its trains."""
    if not given.get(name):
        return None
    return _cameras(Path(given[name]), {"sources": camera.source, "pulses": given.get("pulses")})[0]


def _mean(camera: KeyStack, given: Mapping[str, Any], name: str) -> np.ndarray:
    """The mean frame [H, W] of the same camera in another run; zeros where there is none."""
    other, shape = _other(camera, given, name), camera.shape[1:]
    if other is None:
        return np.zeros(shape)
    require(
        other.shape[1:] == shape, f"{given[name]} must have frames of {shape} pixels, but they have {other.shape[1:]}."
    )
    return mean_frame(
        (other[n, slice(0, shape[0])].astype(np.float64) for n in range(other.shape[0])), (shape[0], shape[1])
    )


def _told(stacks: tuple[KeyStack, ...]) -> dict[str, str]:
    trains = sorted({train for train, _ in stacks[0].places})
    return {"euxfel_sources": ", ".join(s.source for s in stacks), "euxfel_trains": f"{trains[0]} … {trains[-1]}"}


@lru_cache(maxsize=4)
def _run(path: str) -> Any:
    """The run of the files in a folder, each of which is looked at as every HDF5 file is (`open_hdf5`)."""
    try:
        from extra_data import DataCollection
    except ImportError:
        raise MissingError(
            'runs of the European XFEL need extra_data; install it by pip install "holosplat[euxfel]".'
        ) from None
    try:
        files = sorted(file for file in Path(path).iterdir() if FILES.match(file.name))
        for file in files:
            with open_hdf5(file):
                pass
        return DataCollection.from_paths([str(file) for file in files], is_single_run=True)
    except InputError:
        raise
    except Exception as error:  # extra_data raises many kinds for damaged files
        raise InputError(f"{path} must be {RUN}, but opening it failed: {error}.") from None


LOADER = Loader(
    *("euxfel", "a run of the European XFEL (RAW-R….h5)"),
    *(lambda path: path.is_dir() and any(FILES.match(file.name) for file in path.iterdir()), read_euxfel),
    *((*TAKES, "sources", "trains", "pulses", "frame_rate"), open_euxfel),
)
