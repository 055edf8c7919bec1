"""Frames of the wrong kind in a file, which are left out, named or refused: flats and darks unlike the others, flats
that lie otherwise than the projections do, projections without light or without matter."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..checks import note, require, warn
from ..inference import Compared
from ..preprocess.odd_frames import dark_or_empty, faintly_odd, odd_brightness, odd_darks, odd_flats, thumbnail
from .raw_file import DARK, FLAT, INVALID, PROJECTION, ScanFile

NAMED = 5
"""Frames that a message names at most."""
LOOKED_AT = 8
"""Projections that are compared with the flats, at most."""

EDGE = 8
"""Edge of the blocks of a thumbnail whose scatter gives standard errors, at most."""
UPRIGHT: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "upside down": lambda image: image[::-1],
    "mirrored left to right": lambda image: image[:, ::-1],
    "turned by half a turn": lambda image: image[::-1, ::-1],
}
SQUARE: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "transposed": lambda image: image.T,
    "transposed about the other diagonal": lambda image: image[::-1, ::-1].T,
    "turned by a quarter turn clockwise": lambda image: image[::-1].T,
    "turned by a quarter turn anticlockwise": lambda image: image[:, ::-1].T,
}
"""How flats may lie in place of how they stand."""


def tell_odd(label: str, seen: Mapping[int, tuple[float, float]], is_still: bool) -> None:
    """Warns of projections that show no matter where the others do.

    seen: by number, level and pattern of the relative frame (`level_and_pattern`); is_still: whether all show the same
    matter. Errors: `InputError` for frames without light.
    """
    dark, empty = dark_or_empty(*np.array([*seen.values()]).reshape(-1, 2).T)
    names = [f"frame {n}" for n in seen]
    require(
        not dark.any(),
        f"{label}: projections must have light, but beside the others there is none in {_listed(names, dark)}, as in "
        "darks or with a closed shutter; leave such frames out by --leave-out or --views.",
    )
    if is_still and empty.any():
        warn(
            f"{label}: there is matter in the other projections, but none in {_listed(names, empty)}; if the sample "
            "was out, leave such frames out by --leave-out or --views"
        )


def _listed(names: Sequence[str], which: np.ndarray) -> str:
    """The names of those `which` [n] bool, `NAMED` of them at most."""
    found = [name for name, there in zip(names, which) if there]
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return ", ".join(found[:NAMED]) + more


def without_odd(file: ScanFile, is_told: bool) -> ScanFile:
    """The file without flats and darks that are unlike the others, which it names; is_told: with them, as --leave-out
    says which frames to leave. Errors: `InputError` where half of them differ or more."""
    small = {kind: [thumbnail(file.frame(n)) for n in file.numbers(kind)] for kind in (FLAT, DARK)}
    if not any(
        np.isfinite(flat).any() for flat in small[FLAT]
    ):  # none, or all of them saturated, which whoever divides by them says
        return file
    darks, flats, found = np.array(small[DARK]), np.array(small[FLAT]), dict[int, np.ndarray]()
    dark = np.zeros(flats.shape[1:])
    if len(darks):
        found[DARK] = odd_darks(darks, float(np.nanmedian(flats)))
        good = darks[~found[DARK]]
        dark = np.median(good if len(good) else darks, axis=0)
        flats = flats - dark
    found[FLAT] = odd_flats(flats)
    kinds = file.kinds.copy()
    for kind, odd in found.items():
        numbers, (word, other) = file.numbers(kind), ("flat", "dark") if kind == FLAT else ("dark", "flat")
        named = _listed([file.name(n) for n in numbers], odd)
        require(
            2 * int(odd.sum()) < len(odd) or not odd.any() or is_told,
            f"{file.path} must have {word}s that are alike and no {other}s, but {named} differ; check image_key, and "
            "leave those that are wrong by --leave-out.",
        )
        if odd.any():
            kept = "stays, as --leave-out does not name it" if is_told else "is left out; --leave-out chooses otherwise"
            warn(f"{file.path}: unlike the other {word}s, {named} {kept}")
        if not is_told:
            kinds[numbers[odd]] = INVALID
    _tell_flats(file, file.numbers(FLAT)[~found[FLAT]], flats[~found[FLAT]], dark)
    return replace(file, kinds=kinds)


def _tell_flats(file: ScanFile, numbers: np.ndarray, flats: np.ndarray, dark: np.ndarray) -> None:
    """Says which of the flats `numbers` [n] differ from the others, and how they lie beside the projections, by
    thumbnails [n, h, w] of them and [h, w] of the dark."""
    light, pattern = odd_brightness(flats), faintly_odd(flats)
    unequal = [f"{file.name(n)} has {level:.3g} times" for n, level in zip(numbers, light) if level != 1]
    if unequal:
        note(
            f"{file.path}: flats differ in brightness: {', '.join(unequal[:NAMED])} the usual light, and "
            f"{'they stay' if len(unequal) > 1 else 'stays'}; if the time of exposure was another, leave such flats "
            "out by --leave-out"
        )
    if pattern.any():
        named = _listed([f"{file.name(n)} by {off:.2g}" for n, off in zip(numbers, pattern)], pattern > 0)
        warn(
            f"{file.path}: flats differ in pattern, {named} of the light (rms); if the sample was in it, leave it out "
            "by --leave-out"
        )
    projections = file.numbers(PROJECTION)
    seen = projections[np.unique(np.linspace(0, len(projections) - 1, LOOKED_AT).round().astype(int))]
    frames = np.array([thumbnail(file.frame(n)) for n in seen]) - dark
    otherwise = lie_otherwise(flats.mean(axis=0), frames) if len(flats) and len(frames) else None
    if otherwise is not None:
        warn(
            f"{file.path}: the projections show the pattern of the flats better if these are {otherwise.name} "
            f"({otherwise.gain:.0%} ± {otherwise.error:.0%} less is left of it); write the flats as projections lie"
        )


def lie_otherwise(flat: np.ndarray, projections: np.ndarray) -> Compared | None:
    """How the mean flat [h, w] lies if the `projections` [n, h, w], both less the dark, show its pattern better so than
    as it stands, and than no pattern; by how much. None where they do not.

    A flat leaves `log projection - log flat` of the mean projection; blocks of it count alike, for in those without
    matter a flat that is right leaves noise alone.
    """
    least = np.finfo(float).tiny
    seen, pattern = np.log(np.maximum(projections, least)).mean(axis=0), np.log(np.maximum(flat, least))
    ways = {**UPRIGHT, **(SQUARE if flat.shape[0] == flat.shape[1] else {})}
    rivals = [_in_blocks(seen - pattern), _in_blocks(seen)]
    found = {name: _in_blocks(seen - turned(pattern)) for name, turned in ways.items()}
    floor = 1e-12 * max(float(power.max()) for power in (*rivals, *found.values())) + least
    compared = []
    for name, power in found.items():
        gains = [0.5 * np.log((rival + floor) / (power + floor)) for rival in rivals]
        beside = [Compared(name, float(g.mean()), float(g.std(ddof=1) / np.sqrt(g.size))) for g in gains]
        compared.append(min(beside, key=lambda each: each.gain))
    best = max(compared, key=lambda each: each.gain)
    return best if best.wins else None


def _in_blocks(image: np.ndarray) -> np.ndarray:
    """The variances [b] of an image [h, w] within blocks of `EDGE` pixels, two along each side at least."""
    edges = [min(EDGE, max(1, n // 2)) for n in image.shape]
    (rows, columns), (high, wide) = (n // e for n, e in zip(image.shape, edges)), edges
    whole = image[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
    return whole.var(axis=(1, 3)).ravel()
