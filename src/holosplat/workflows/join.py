"""Scans of several beams, each with a detector of its own, brought onto one raster."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..checks import in_range, require
from ..geometry import Views
from ..io.atomic import require_apart, require_writable
from ..io.formats import read
from ..io.nxtomo import scan_writer
from ..io.reading import Part
from ..optics.coherence import joined_blur_px
from ..optics.resampling import FLIPS, Flip, Resampling
from ..progress import Advance
from ..scan import PIXEL_RANGE_M, Exposures

LEAST_PIXELS = 8
"""A common field of fewer pixels a side is taken for a mistake."""


def join(
    sources: Sequence[Path],
    out: Path,
    pixel_size: float | None = None,
    flips: Sequence[Flip] = (),
    on_progress: Advance = lambda fraction: None,
    part: Part = Part(),
) -> Exposures:
    """One scan file `out` of all frames of the scans `sources`, one a beam, in their order.

    Each frame is brought to pixels of `pixel_size` [m] (default: the coarsest of all), over the field that every
    detector has, about its own centre; distances, poses, shifts and times stay its own, its point-spread function is
    carried along. `flips`: for each file, what its detector saw reversed and the file does not say itself. Raw files
    are corrected plainly, and frames keep the photon energy of their beam. part: what is taken of each file.
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
    pitch = _common_pixel(parts, pixel_size)
    shape = _common_shape(parts, pitch)
    joined, resamplings = _joined(parts, shape, pitch)
    described = {"joined": "; ".join(path.name for path in sources), **_shared([scan.provenance for scan in scans])}
    done = 0
    is_test = np.concatenate([scan.is_test for scan in scans])
    with scan_writer(out, joined, is_test, described) as add:
        for n, (scan, resampling) in enumerate(zip(scans, resamplings)):
            rows, columns = FLIPS[flips[n]] if flips else (False, False)
            for frame in (frame for block in scan.blocks() for frame in block):
                add(resampling(frame[:: -1 if rows else 1, :: -1 if columns else 1]))
                done += 1
                on_progress(done / len(joined))
    return joined


def _common_pixel(parts: list[Exposures], pixel_size: float | None) -> float:
    """The pixel size of the result [m]."""
    coarsest = max(part.views.pixel_size for part in parts)
    return coarsest if pixel_size is None else in_range("--pixel-size", pixel_size, *PIXEL_RANGE_M, unit="metres")


def _common_shape(parts: list[Exposures], pitch: float) -> tuple[int, int]:
    """Rows and columns of the largest field, about their centres, that all detectors have."""
    rows, columns = (
        math.floor(min(part.views.shape[axis] * part.views.pixel_size for part in parts) / pitch * (1 + 1e-9))
        for axis in range(2)
    )
    require(
        min(rows, columns) >= LEAST_PIXELS,
        f"the field that all detectors have would be {rows} × {columns} pixels of {pitch:g} m; take a smaller "
        "--pixel-size.",
    )
    return rows, columns


def _joined(parts: list[Exposures], shape: tuple[int, int], pitch: float) -> tuple[Exposures, list[Resampling]]:
    """The exposures of all frames on the common raster, and what brings each part's frames there."""
    resamplings, blurs = [], []
    for part in parts:
        own = part.views.pixel_size
        resampling = Resampling(part.views.shape, own, shape, pitch)
        resamplings.append(resampling)
        blurs.append(joined_blur_px(part.psf_sigma_px * own / pitch, resampling.extra_blur, pitch))
    views = Views(
        np.concatenate([part.views.rotations for part in parts]),
        np.concatenate([part.views.shifts for part in parts]),
        shape,
        pitch,
    )
    energy, distance, time = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("energy_kev", "distance", "time")
    )
    joined = Exposures(views, energy, distance, np.concatenate(blurs), time)
    return joined, resamplings


def _shared(texts: list[dict[str, str]]) -> dict[str, str]:
    """The provenance that all files agree on."""
    return {key: value for key, value in texts[0].items() if all(other.get(key) == value for other in texts[1:])}
