"""The view in three dimensions: the parts that it shows, and its text in the page.

Objects as the page embeds them: small integers, and the numbers that bring them back.
Lengths are in raster pixels of the view. Places are stored as 16 bits of the box that holds them (an error of the box
over 131 072), volumes as 8 bits of their range (1/512 of it at most, which averages out along a ray), deviations and
amplitudes of Gaussians as half floats (2^-12 of their value).
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from markupsafe import Markup

from ...geometry import Grid, Views
from ...matter import Matter
from ...representations import GaussianCloud, MovingSurfaces, Stored, SurfaceMesh
from ...scan import Exposures
from ...units import wavenumber
from ...volume import Volume
from ..style import SIGNED_MAP, palette

MOST_COLUMNS = 320
"""Raster pixels along the longer edge of the view's frame."""
FINE_COLUMNS = 160
"""Detector pixels along it up to which the raster is twice as fine, for the waves' sake."""
MOST_VIEWS = 64
"""Views of the scan that can be chosen."""


@dataclass(frozen=True)
class View3D:
    """What the view shows: objects by name, slices by the same names, and how frames are taken of them.

    parts: the first is shown at first; slices: volumes of some of the parts; exposures: of the frame that the view
    imitates (one); views: of the scan, which can be chosen; labels: theirs; grey: limits of the frames' grey scale;
    delta_told: whether δ is known, and with it the phase; else absorption is shown; ends: the phase shift [rad], or the
    absorption, between which colours go; picture: the first view as a `data:` URI, where WebGL is missing.
    """

    parts: Mapping[str, ViewPart]
    slices: Mapping[str, ViewPart]
    exposures: Exposures
    views: Views
    labels: tuple[str, ...]
    grey: tuple[float, float]
    ends: tuple[float, float]
    picture: str = ""
    delta_told: bool = True


def raster_of(rows: int, columns: int, pixel: float) -> tuple[int, int, float]:
    """Rows, columns and pixel [m] of the raster of the view of a detector of `rows` × `columns` of `pixel` [m].

    Twice as fine as a small detector; coarser than a large one, whose fringes it then does not show.
    """
    longest = max(rows, columns)
    factor = 0.5 if longest <= FINE_COLUMNS else max(1, -(-longest // MOST_COLUMNS))
    return round(rows / factor), round(columns / factor), pixel * factor


def html(view: View3D) -> Markup:
    """The view as a part of the page: its elements, data and script; nothing is loaded from elsewhere."""
    header, blob = packed(view)
    data = base64.b64encode(zlib.compress(blob, 9)).decode()
    # In a script element "<" could end it; JSON may write it as an escape.
    text = json.dumps(header, separators=(",", ":")).replace("<", "\\u003c")
    return Markup(_source("view.html")).format(
        picture=view.picture, header=Markup(text), data=Markup(data), script=Markup(_source("view.js"))
    )


def packed(view: View3D) -> tuple[dict[str, Any], bytes]:
    """What describes the arrays, and their bytes, each aligned to four."""
    blob = bytearray()

    def described(part: ViewPart) -> dict[str, Any]:
        arrays = {}
        for name, array in part.arrays.items():
            blob.extend(b"\0" * (-len(blob) % 4))
            arrays[name] = {"type": array.dtype.name, "shape": list(array.shape), "at": len(blob)}
            blob.extend(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes())
        return {"kind": part.kind, "arrays": arrays, "channels": [list(c) for c in part.channels], **part.facts}

    optical = view.exposures.optical
    rows, columns, pixel = raster_of(*view.exposures.views.shape, view.exposures.views.pitch)
    energy = float(view.exposures.energy_kev[0])
    return {
        "rows": rows,
        "columns": columns,
        "pixel": pixel,
        "detector_pixel": view.exposures.views.pitch,
        "k": float(wavenumber(energy)),
        "distance": float(optical.distance[0]),
        "psf": float(optical.psf_sigma_px[0]) * view.exposures.views.pitch / pixel,
        "parts": {name: described(part) for name, part in view.parts.items()},
        "slices": {name: described(part) for name, part in view.slices.items()},
        "rotations": [r.ravel().round(7).tolist() for r in view.views.rotations[:MOST_VIEWS]],
        "shifts": (view.views.shifts[:MOST_VIEWS] / pixel).round(5).tolist(),
        "labels": list(view.labels[:MOST_VIEWS]),
        "grey": list(view.grey),
        "phase": view.ends,
        "delta_told": view.delta_told,
        "colours": palette().ravel().tolist(),
        "signed": palette(SIGNED_MAP).ravel().tolist(),
    }, bytes(blob)


@cache
def _source(name: str) -> str:
    return files(__package__ or "").joinpath(name).read_text(encoding="utf-8")


MOST_GAUSSIANS = 64_000
"""Gaussians that a page holds (1.4 MB before compression)."""
LEFT_OUT = 1e-3
"""Share of the mass that the faintest Gaussians may have together to be left out."""
MOST_FACES = 120_000
"""Triangles that a page holds (as much)."""
MOST_COEFFICIENTS = 250_000
"""Vertices times coefficients of paths that a page holds."""
MOST_TIMES = 48
"""Steps of the slider of time."""
VOLUME_BYTES, SLICE_BYTES = 600_000, 200_000
"""Bytes that a volume that stands for an object may take, compressed, and one that slices are cut from: it is binned
until it does."""


@dataclass(frozen=True)
class ViewPart:
    """The representation of one object in the view.

    kind: `gaussians`, `surfaces`, `paths` or `volume`; arrays: by name; facts: what brings them back, as JSON holds it;
    channels: (δ, β) of a value of one.
    """

    kind: str
    arrays: Mapping[str, np.ndarray]
    facts: Mapping[str, Any]
    channels: tuple[tuple[float, float], ...] = field(default=())


def part_of(obj: Stored, volume: Volume, pixel: float, times: np.ndarray | None = None) -> ViewPart:
    """What stands for `obj`, exactly where the page can hold it, else by its `volume`.

    pixel: of the raster [m]; times: [T] at which something that moves is shown [s].
    """
    if isinstance(obj, GaussianCloud) and (found := _gaussians(obj, pixel)):
        return found
    if isinstance(obj, SurfaceMesh) and len(obj.faces) <= MOST_FACES:
        vertices = obj.vertices.detach().double().numpy() * (obj.unit_length / pixel)
        bits, low, step = _in_bits(vertices, 16)
        arrays = {"vertices": bits, "faces": _small(obj.faces.numpy())}
        return ViewPart("surfaces", arrays, {"low": low, "step": step}, _channels(obj.matter))
    if isinstance(obj, MovingSurfaces) and times is not None and obj.coefficients[..., 0].numel() <= MOST_COEFFICIENTS:
        coefficients = obj.coefficients.detach().double().numpy() * (obj.unit_length / pixel)
        bits, low, step = _in_bits(coefficients, 16)
        shown = np.linspace(times[0], times[-1], min(MOST_TIMES, 4 * len(times) - 3))
        arrays = {
            "coefficients": bits,
            "faces": _small(obj.faces.numpy()),
            "weights": obj.basis.weights(shown).astype(np.float32),
        }
        facts = {"low": low, "step": step, "paths": len(bits), "times_us": [round(1e6 * t, 4) for t in shown]}
        return ViewPart("paths", arrays, facts, _channels(obj.matter))
    return volume_part(volume, pixel, VOLUME_BYTES)


def volume_part(volume: Volume, pixel: float, most_bytes: int) -> ViewPart:
    """δ and β of a volume, binned until it takes at most `most_bytes` compressed."""
    found = _voxels(volume, pixel)
    for factor in range(2, max(volume.grid.shape)):
        if len(zlib.compress(found.arrays["values"].tobytes(), 6)) <= most_bytes:
            break
        found = _voxels(binned(volume, factor), pixel)
    return found


def _voxels(volume: Volume, pixel: float) -> ViewPart:
    """δ and β of a volume; β as its least-squares share of δ where it is one, so that one channel does."""
    share = _share(volume)
    values = [volume.delta] if share is not None else [volume.delta, volume.beta]
    stored = [_in_bits(np.asarray(v, dtype=np.float64), 8) for v in values]
    channels = ((1.0, share),) if share is not None else ((1.0, 0.0), (0.0, 1.0))
    grid = volume.grid
    return ViewPart(
        "volume",
        {"values": np.stack([bits for bits, _, _ in stored])},
        {
            "low": [low for _, low, _ in stored],
            "step": [step for _, _, step in stored],
            "ends": [_ends(v, step) for v, (_, _, step) in zip(values, stored)],
            "voxel": [float(size) / pixel for size in grid.voxel_size],
            "middle": [float(c) / pixel for c in grid.centre],
        },
        channels,
    )


def _ends(values: np.ndarray, step: float) -> tuple[float, float]:
    """The least and the greatest value, with 0; what is less than a stored `step` off 0 is rounding."""
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    return (low if -low >= step else 0.0), (high if high >= step else 0.0)


def binned(volume: Volume, factor: int) -> Volume:
    """Means over blocks of `factor`³ voxels, with nothing beyond the box."""
    grid = volume.grid
    coarse = [-(-n // factor) for n in grid.shape]
    beyond = [(0, factor * m - n) for m, n in zip(coarse, grid.shape)]
    blocks = [n for m in coarse for n in (m, factor)]
    delta, beta = (np.pad(v, beyond).reshape(blocks).mean(axis=(1, 3, 5)) for v in (volume.delta, volume.beta))
    x, y, z = (o + 0.5 * (factor - 1) * size for o, size in zip(grid.origin, grid.voxel_size))
    dx, dy, dz = (factor * size for size in grid.voxel_size)
    return Volume(delta, beta, Grid((coarse[0], coarse[1], coarse[2]), (dx, dy, dz), (x, y, z)))


def _share(volume: Volume) -> float | None:
    """β over δ if it is the same everywhere within a thousandth of the largest β."""
    delta, beta = (np.asarray(v, dtype=np.float64) for v in (volume.delta, volume.beta))
    square = float(np.sum(delta * delta))
    share = float(np.sum(delta * beta)) / square if square > 0 else 0.0
    return share if np.abs(beta - share * delta).max(initial=0.0) <= 1e-3 * np.abs(beta).max(initial=0.0) else None


def _gaussians(cloud: GaussianCloud, pixel: float) -> ViewPart | None:
    """Gaussians without those that are too faint together to matter; None if they are still too many."""
    with torch.no_grad():
        mass = cloud.masses().abs().sum(dim=1).double().numpy()
        order = np.argsort(mass)
        faint = int(np.searchsorted(np.cumsum(mass[order]), LEFT_OUT * mass.sum())) if len(mass) > MOST_GAUSSIANS else 0
        kept = np.sort(order[faint:])
        if len(kept) > MOST_GAUSSIANS or len(kept) == 0:
            return None
        unit = cloud.unit_length / pixel
        turned = torch.nn.functional.normalize(cloud.quaternions, dim=1)
        centres, low, step = _in_bits((cloud.centres.double() * unit).numpy()[kept], 16)
        arrays = {
            "centres": centres,
            "scales": (cloud.scales * unit).numpy()[kept].astype(np.float16),
            "quaternions": np.rint(32767 * turned.numpy()[kept]).astype(np.int16),
            "amplitudes": cloud.amplitudes.numpy()[kept].astype(np.float16),
        }
    return ViewPart("gaussians", arrays, {"low": low, "step": step, "count": len(kept)}, _channels(cloud.matter))


def _channels(matter: Matter) -> tuple[tuple[float, float], ...]:
    return tuple((float(c.delta), float(c.beta)) for c in matter.channels)


def _small(faces: np.ndarray) -> np.ndarray:
    return faces.astype(np.uint16 if faces.max(initial=0) < 65536 else np.uint32)


def _in_bits(values: np.ndarray, bits: int) -> tuple[np.ndarray, float, float]:
    """Whole numbers of `bits`, and the `low` and `step` that make `low + step n` of them."""
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    step = (high - low) / (2**bits - 2) or 1.0
    low = step * np.floor(low / step)  # so that zero is one of the numbers: most of a volume is empty
    return np.rint((values - low) / step).astype(np.uint8 if bits == 8 else np.uint16), low, step
