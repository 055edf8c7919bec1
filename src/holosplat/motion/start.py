"""From sightings to bodies on first paths: the surface of the best time, carried along the track of the middle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..checks import require
from ..matter import DeltaBeta, Matter
from ..representations import MovingSurfaces, TimeBasis
from .identities import LinkOptions, Seen, Track, drift, identified
from .sightings import Sighting

USUAL = LinkOptions()
"""The usual options of linking detections."""
SURE = 3
"""Whole sightings from which a track's own velocity is believed; with fewer it is that of the flow."""
BENT = 6
"""Whole sightings from which its acceleration is."""


def first_paths(
    found: Sequence[Sequence[Sighting]],
    times: np.ndarray,
    basis: TimeBasis,
    pixel: float,
    material: DeltaBeta,
    options: LinkOptions = USUAL,
) -> MovingSurfaces:
    """Bodies on first paths, from the sightings at each of `times` [T] s, those with the most sightings first.

    A body has the surface of its best time, and is moved without turning; pixel: [m], the unit of lengths. Errors:
    `InputError` if there is no body at all.
    """
    flat = [(t, one) for t, bodies in enumerate(found) for one in bodies]
    seen = [Seen(t, one.centre, one.volume, one.cut) for t, one in flat]
    tracks = identified(seen, times, options)
    require(
        len(tracks) > 0,
        "no body was found that can be followed from one time to the next; check the material, or look at single times "
        "with reconstruct --time-frame.",
    )
    flow = drift(tracks, seen, times)
    paths, faces = [], []
    for track in tracks:
        best = best_sighting(track, seen)
        mesh = flat[best][1].mesh
        middle = _middle(track, best, seen, times, flow, basis)
        paths.append(mesh.vertices[None] - seen[best].centre + middle[:, None])
        faces.append(mesh.faces)
    return MovingSurfaces.of_bodies(paths, faces, basis, pixel, Matter.one(*material))


def best_sighting(track: Track, seen: Sequence[Seen]) -> int:
    """The best detection of a track: of the whole ones that of median volume; else the largest."""
    whole = [k for k in track if not seen[k].cut]
    if not whole:
        return max(track, key=lambda k: seen[k].volume)
    middle = float(np.median([seen[k].volume for k in whole]))
    return min(whole, key=lambda k: (abs(seen[k].volume - middle), k))


def _middle(
    track: Track, best: int, seen: Sequence[Seen], times: np.ndarray, flow: np.ndarray, basis: TimeBasis
) -> np.ndarray:
    """Coefficients [K, 3] [m] of the path of the middle, a polynomial of as many powers as sightings can tell.

    It passes the middle of the best sighting, whose surface it carries, where only that one or the flow is known.
    """
    whole = [k for k in track if not seen[k].cut]
    when = np.array([times[seen[k].time] for k in whole])
    dense = np.linspace(basis.first, basis.last, 4 * basis.count)
    degree = min(basis.degree, 2 if len(whole) >= BENT else 1 if len(whole) >= SURE else 0)
    if degree == 0:
        places = seen[best].centre + (dense - times[seen[best].time])[:, None] * flow * (basis.degree > 0)
    else:
        scale = basis.last - basis.first
        centres = np.array([seen[k].centre for k in whole])
        powers = np.polynomial.polynomial.polyfit((when - basis.first) / scale, centres, degree)
        places = np.polynomial.polynomial.polyval((dense - basis.first) / scale, powers).T
    return basis.fitted(dense, places)
