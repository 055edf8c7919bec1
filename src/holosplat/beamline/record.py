"""The camera and the free-electron laser: a scan of relative intensities becomes raw counts, with flats and darks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from ..checks import require
from ..io.atomic import require_apart, require_writable
from ..io.formats import loader_of, read
from ..io.hdf5 import new_hdf5, put
from ..io.nxtomo import RawLayout, scan_writer
from ..io.raw_file import DARK, FLAT, PROJECTION
from ..io.reading import Part
from ..io.scan_file import open_scan
from ..optics.camera import Camera, Illumination, PulseModel, Pulses, Sensor
from ..optics.coherence import joined_blur_px
from ..optics.noise import PHOTON_RANGE
from ..optics.resampling import FLIPS, Flip
from ..progress import Advance
from ..ranges import Many, Seed, Within, checked_dataclass
from ..scan import Exposures, Scan

DEAD_BIT, HOT_BIT = 1 << 1, 1 << 3
"""Bits of NeXus' `pixel_mask`: dead, over-responding."""


@checked_dataclass
class RecordingOptions:
    """Options of a recording."""

    photons_per_pixel: Annotated[float, Within(*PHOTON_RANGE)] = 10_000.0
    """Mean photons detected in a pixel without the object."""
    flats: Many = 100
    """Frames without the object, each of a pulse of its own; they come before the projections."""
    darks: Many = 20
    """Frames without light; they come first."""
    flip: Flip = "none"
    """The order that the detector reverses: of its rows, of its columns, or of both."""
    seed: Seed = 0
    """Seed of everything random."""


@dataclass(frozen=True)
class Recorded:
    """The recording: numbers of frames, the camera's gain [counts a photon], defective and saturated pixels.

    saturated: the saturated part of the projections' good pixels.
    """

    projections: int
    flats: int
    darks: int
    gain: float
    defects: int
    saturated: float


@dataclass(frozen=True)
class _Bench:
    """All that is drawn once: the sensor, the light, the pulses of flats and projections, and the dice for the rest."""

    sensor: Sensor
    model: PulseModel
    flats: Pulses
    projections: Pulses
    rng: np.random.Generator

    @classmethod
    def drawn(cls, scan: Scan, options: RecordingOptions, camera: Camera, light: Illumination) -> _Bench:
        shape = scan.views.shape
        of_sensor, of_model, of_flats, of_projections, rest = np.random.default_rng(options.seed).spawn(5)
        model = PulseModel.drawn(light, shape, of_model)
        return cls(
            Sensor.drawn(camera, shape, options.photons_per_pixel, of_sensor),
            model,
            model.pulses(options.flats, of_flats),
            model.pulses(len(scan), of_projections),
            rest,
        )


def record(
    source: Path,
    out: Path,
    options: RecordingOptions,
    camera: Camera,
    light: Illumination,
    truth: Path | None = None,
    on_progress: Advance = lambda fraction: None,
    *,
    part: Part = Part(),
) -> Recorded:
    """Record the noise-free scan `source`, or a part, as raw counts into `out`: darks, flats, a pulse a projection.

    The file is NXtomo with `image_key`, uint16, frame by frame. `truth` gets the values that a reconstruction must not
    know: the light's mean, components and weights, pulse energies, and the sensor's maps (HDF5). `InputError` when the
    scan already has photon noise, is raw itself, or holds no light.
    """
    for path in (out, truth) if truth else (out,):
        require_writable(path)
    require_apart(out, source, *([truth] if truth else []))
    require_apart(truth or out, source)
    _require_corrected(source)
    scan = part.of(read(source))
    photons = scan.provenance.get("photons_per_pixel", "none")
    require(
        photons == "none",
        f"{source} must be noise-free, but it has the noise of {photons} photons; simulate it without.",
    )
    bench = _Bench.drawn(scan, options, camera, light)
    kinds = np.repeat([DARK, FLAT, PROJECTION], [options.darks, options.flats, len(scan)])
    mask = DEAD_BIT * bench.sensor.dead.astype(np.uint32) + HOT_BIT * bench.sensor.hot.astype(np.uint32)
    layout = RawLayout(kinds, _flipped(mask, options.flip), flips=FLIPS[options.flip])
    exposures, is_test = _all_frames(scan, options, camera)
    provenance = scan.provenance | _provenance(options, camera, light)
    saturated = 0
    with scan_writer(out, exposures, is_test, provenance, layout) as add:
        for number, kind in enumerate(layout.kinds):
            counts = bench.sensor.read_out(_photons(bench, scan, options, number), bench.rng)
            if kind == PROJECTION:
                saturated += int((counts[~bench.sensor.defects] == camera.most).sum())
            add(_flipped(counts, options.flip))
            on_progress((number + 1) / len(layout.kinds))
    if truth is not None:
        _write_truth(truth, bench, options)
    good = len(scan) * int((~bench.sensor.defects).sum())
    defects = int(bench.sensor.defects.sum())
    gain = camera.gain_for(options.photons_per_pixel)
    return Recorded(
        len(exposures) - options.flats - options.darks, options.flats, options.darks, gain, defects, saturated / good
    )


def _require_corrected(source: Path) -> None:
    """`InputError` for a file with other frames than projections, which are counts."""
    if loader_of(source).name != "nxtomo":
        return
    with open_scan(source) as file:
        only = bool((file.kinds == PROJECTION).all())
    require(only, f"{source} must hold projections only, but it has flats, darks or invalid frames: it is raw already.")


def _photons(bench: _Bench, scan: Scan, options: RecordingOptions, number: int) -> np.ndarray:
    """Photons [H, W] expected in frame `number` of all: darks first, then flats, then projections."""
    shape = scan.views.shape
    flat, projection = number - options.darks, number - options.darks - options.flats
    if flat < 0:
        return np.zeros(shape)
    if projection < 0:
        return options.photons_per_pixel * bench.model.light(bench.flats, flat)
    relative = np.clip(scan.source[projection].astype(np.float64), 0, None)
    return options.photons_per_pixel * bench.model.light(bench.projections, projection) * relative


def _all_frames(scan: Scan, options: RecordingOptions, camera: Camera) -> tuple[Exposures, np.ndarray]:
    """Exposures and split of all frames; darks and flats, which have no pose, repeat those of the first projection."""
    before, exposures = options.darks + options.flats, scan.exposures
    blurred = joined_blur_px(exposures.psf_sigma_px, camera.scintillator_px, 1.0)
    index = np.concatenate([np.zeros(before, dtype=int), np.arange(len(exposures))])
    is_test = np.concatenate([np.zeros(before, dtype=bool), scan.is_test])
    return replace(exposures, psf_sigma_px=blurred)[index], is_test


def _flipped(image: np.ndarray, flip: Flip) -> np.ndarray:
    rows, columns = FLIPS[flip]
    return image[:: -1 if rows else 1, :: -1 if columns else 1]


def _provenance(options: RecordingOptions, camera: Camera, light: Illumination) -> dict[str, str]:
    """The options; the random draws are in the truth file only."""
    return {
        f"{name}.{key}": str(value)
        for name, group in (("recorded", options), ("camera", camera), ("illumination", light))
        for key, value in vars(group).items()
    } | {"photons_per_pixel": f"{options.photons_per_pixel:g}"}


def _write_truth(path: Path, bench: _Bench, options: RecordingOptions) -> None:
    """The random draws, upright: light, pulses and sensor."""
    with new_hdf5(path) as file:
        file.attrs["photons_per_pixel"] = options.photons_per_pixel
        for name in ("mean", "components", "deviations"):
            put(file, f"light/{name}", getattr(bench.model, name))
        for name, pulses in (("flats", bench.flats), ("projections", bench.projections)):
            put(file, f"{name}/energy", pulses.energy)
            put(file, f"{name}/weights", pulses.weights)
        for name in ("gain", "offset", "dead", "hot"):
            put(file, f"sensor/{name}", getattr(bench.sensor, name))
