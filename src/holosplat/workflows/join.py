"""Scans of several beams, each with a detector of its own, in one file: as they are, or brought onto one raster."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..checks import in_range, require
from ..divided_light import DividedLight
from ..geometry import Views
from ..io.atomic import require_apart, require_writable
from ..io.beams import read_beams
from ..io.formats import read
from ..io.nxtomo import scan_writer
from ..io.reading import Part
from ..optics.coherence import joined_blur_px
from ..optics.resampling import FLIPS, Flip, Resampling
from ..progress import Advance
from ..scan import PIXEL_RANGE_M, Exposures, Scan

LEAST_PIXELS = 8
"""A common field of fewer pixels a side is taken for a mistake."""


def join(
    sources: Sequence[Path],
    out: Path,
    pixel_size: float | None = None,
    flips: Sequence[Flip] = (),
    on_progress: Advance = lambda fraction: None,
    part: Part = Part(),
    geometry: Path | None = None,
) -> Exposures:
    """One scan file `out` of all frames of the scans `sources`, one a beam, in their order.

    Frames of several pixel sizes stay as they are, if they have as many pixels. With `pixel_size` [m], and where the
    files' own is the same, each frame is brought to such pixels, over the field that every detector has, about its own
    centre. Distances, poses, shifts and times stay its own, its point-spread function is
    carried along. `flips`: for each file, what its detector saw reversed and the file does not say itself. Raw files
    are corrected plainly, and frames keep the photon energy of their beam. part: what is taken of each file.
    geometry: file of `io.beams` that says where all frames are, in the place of what their files say; a view a frame.
    """
    require_writable(out)
    require_apart(out, *sources)
    require(len(sources) >= 2, "join needs at least two scan files, one a beam.")
    require(
        len(flips) in (0, len(sources)),
        f"--flip must say one of {', '.join(FLIPS)} for each of the {len(sources)} files, but it says {len(flips)}.",
    )
    scans = [part.of(read(source)) for source in sources]
    parts = [scan.exposures for scan in scans]
    joined, resamplings = _on_one_raster(parts, pixel_size) if _share_pixel(parts, pixel_size) else _as_they_are(parts)
    joined = joined if geometry is None else _placed(joined, geometry)
    described = {"joined": "; ".join(path.name for path in sources), **_shared([scan.provenance for scan in scans])}
    done = 0
    is_test = np.concatenate([scan.is_test for scan in scans])
    with scan_writer(out, joined, is_test, described, light=_light(scans, flips, joined)) as add:
        for n, (scan, resampling) in enumerate(zip(scans, resamplings)):
            rows, columns = FLIPS[flips[n]] if flips else (False, False)
            for frame, missing in _one_by_one(scan):
                turn = (slice(None, None, -1 if rows else 1), slice(None, None, -1 if columns else 1))
                turned, lacks = frame[turn], None if missing is None else missing[turn]
                if resampling is not None:
                    turned = resampling(turned)
                    lacks = None if lacks is None else resampling(lacks.astype(np.float32)) > 0.5  # most of it
                add(turned, lacks)
                done += 1
                on_progress(done / len(joined))
    return joined


def _one_by_one(scan: Scan) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """The frames [H, W], each with its missing pixels."""
    for frames, missing in scan.blocks_with_missing():
        yield from ((frame, None if missing is None else missing[i]) for i, frame in enumerate(frames))


def _placed(joined: Exposures, geometry: Path) -> Exposures:
    """The exposures of the file `geometry`, on the same pixels; errors: `InputError` where it says others."""
    found = read_beams(geometry).on(joined)
    same = np.allclose(found.views.pixel_sizes, joined.views.pixel_sizes, rtol=1e-6, atol=0)
    require(same, f"{geometry} says other pixel sizes than the frames have; join first, and give it to what follows.")
    return replace(found, views=replace(joined.views, rotations=found.views.rotations, shifts=found.views.shifts))


def _light(scans: Sequence[Scan], flips: Sequence[Flip], joined: Exposures) -> DividedLight | None:
    """What is not known of light that all frames were divided by; None where it is not said of all of them, or where
    they are brought to another raster."""
    views, parts = joined.views, list[DividedLight]()
    for n, scan in enumerate(scans):
        own = scan.views
        same = own.shape == views.shape and (not views.has_one_pixel or np.isclose(own.pixel_size, views.pixel_size))
        if scan.light is None or not same:
            return None
        rows, columns = FLIPS[flips[n]] if flips else (False, False)
        parts.append(scan.light.reversed(rows, columns, (views.shape[0], views.shape[1])))
    return DividedLight.joined(parts)


def _share_pixel(parts: list[Exposures], pixel_size: float | None) -> bool:
    """Whether the result has one pixel size: the one that is asked for, or that of all parts."""
    sizes = np.concatenate([part.views.pixel_sizes for part in parts])
    return pixel_size is not None or bool(np.allclose(sizes, sizes[0], rtol=1e-6, atol=0))


def _as_they_are(parts: list[Exposures]) -> tuple[Exposures, list[Resampling | None]]:
    """The exposures of all frames on their own rasters, which nothing needs to bring there."""
    shapes = sorted({part.views.shape for part in parts})
    said = " and ".join(f"{h} × {w}" for h, w in shapes)
    require(
        len(shapes) == 1,
        f"frames of several pixel sizes must have as many pixels, but they have {said}; cut all to one shape "
        "(--crop ROWS,COLUMNS), or bring them to one raster (--pixel-size).",
    )
    sizes = np.concatenate([part.views.pixel_sizes for part in parts])
    blurs = np.concatenate([part.psf_sigma_px for part in parts])
    return _exposures(parts, shapes[0], sizes, blurs), [None] * len(parts)


def _on_one_raster(parts: list[Exposures], pixel_size: float | None) -> tuple[Exposures, list[Resampling | None]]:
    """The exposures of all frames on the common raster, and what brings each part's frames there."""
    if pixel_size is not None:
        in_range("--pixel-size", pixel_size, *PIXEL_RANGE_M, unit="metres")
    pitch = max(part.views.pixel_size for part in parts) if pixel_size is None else pixel_size
    rows, columns = (
        math.floor(min(part.views.shape[axis] * part.views.pixel_size for part in parts) / pitch * (1 + 1e-9))
        for axis in range(2)
    )
    require(
        min(rows, columns) >= LEAST_PIXELS,
        f"the field that all detectors have would be {rows} × {columns} pixels of {pitch:g} m; take a smaller "
        "--pixel-size.",
    )
    shape = rows, columns
    resamplings, blurs = list[Resampling | None](), []
    for part in parts:
        own = part.views.pixel_size
        resampling = Resampling(part.views.shape, own, shape, pitch)
        resamplings.append(resampling)
        blurs.append(joined_blur_px(part.psf_sigma_px * own / pitch, resampling.extra_blur, pitch))
    return _exposures(parts, shape, pitch, np.concatenate(blurs)), resamplings


def _exposures(
    parts: list[Exposures], shape: tuple[int, int], pixel_size: float | np.ndarray, blurs: np.ndarray
) -> Exposures:
    sources = [part.views.sources for part in parts if part.views.sources is not None]
    require(
        len(sources) in (0, len(parts)),
        f"files must all have cones of rays or none, but {len(sources)} of {len(parts)} have them; join those apart.",
    )
    views = Views.of_pixels(
        np.concatenate([part.views.rotations for part in parts]),
        np.concatenate([part.views.shifts for part in parts]),
        shape,
        pixel_size,
    )
    views = replace(views, sources=np.concatenate(sources)) if sources else views
    energy, distance, time, bandwidth = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("energy_kev", "distance", "time", "bandwidth")
    )
    return Exposures(views, energy, distance, blurs, time, bandwidth=bandwidth)


def _shared(texts: list[dict[str, str]]) -> dict[str, str]:
    """The provenance that all files agree on."""
    return {key: value for key, value in texts[0].items() if all(other.get(key) == value for other in texts[1:])}
