"""Odd frames of a file: flats and darks unlike the others, misplaced flats, projections without light or matter."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..checks import note, require, warn
from ..inference import Compared
from ..preprocess.pixels import (
    dark_or_empty,
    faintly_odd,
    level_and_pattern,
    odd_brightness,
    odd_darks,
    odd_flats,
    thumbnail,
)
from .raw_file import DARK, FLAT, INVALID, ScanFile

NAMED = 5
"""Frames that a message names at most."""
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


@dataclass
class Beside:
    """Projections beside each other and beside their flats, one after another.

    label: of their file; still: whether all show the same matter; light: [H, W] the mean flat less the dark, None where
    frames were divided before.
    """

    label: str
    still: bool
    light: np.ndarray | None
    _seen: dict[int, tuple[float, float]] = field(default_factory=dict)
    _log: np.ndarray | float = 0.0

    def add(self, number: int, frame: np.ndarray) -> None:
        """The relative frame [H, W] `number` of the file."""
        small = thumbnail(frame)
        self._seen[number] = level_and_pattern(small)
        self._log = self._log + np.log(np.maximum(small, np.finfo(float).tiny))

    def tell(self) -> None:
        """Warns of frames without light, of those without matter where the others have some, and of flats that lie
        otherwise. Matter that is thick along a beam hides its light as a shutter does, so that no frame is refused."""
        dark, empty = dark_or_empty(*np.array([*self._seen.values()]).T)
        names = [f"frame {n}" for n in self._seen]
        if dark.any():
            warn(
                f"{self.label}: beside the other projections there is no light in {_listed(names, dark)}; if they are "
                "darks, or the shutter was closed, leave such frames out by --leave-out or --views"
            )
        if self.still and empty.any():
            warn(
                f"{self.label}: there is matter in the other projections, but none in {_listed(names, empty)}; if the "
                "sample was out, leave such frames out by --leave-out or --views"
            )
        if self.light is None:
            return
        otherwise = lie_otherwise(thumbnail(self.light), np.asarray(self._log) / len(self._seen))
        if otherwise is not None:
            warn(
                f"{self.label}: the projections show the pattern of the flats better if these are {otherwise.name} "
                f"({otherwise.gain:.0%} ± {otherwise.error:.0%} less is left of it); write the flats as projections lie"
            )


def _listed(names: Sequence[str], which: np.ndarray) -> str:
    """The names of those `which` [n] bool, `NAMED` of them at most."""
    found = [name for name, there in zip(names, which) if there]
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return ", ".join(found[:NAMED]) + more


def without_odd(file: ScanFile, is_told: bool) -> ScanFile:
    """The file without odd flats and darks, which it names (but with them if --leave-out is told). Errors: `InputError`
    where half of them differ or more."""
    small = {kind: [thumbnail(file.frame(n)) for n in file.numbers(kind)] for kind in (FLAT, DARK)}
    if not any(
        np.isfinite(flat).any() for flat in small[FLAT]
    ):  # none, or all of them saturated, which whoever divides by them says
        return file
    darks, flats, found = np.array(small[DARK]), np.array(small[FLAT]), dict[int, np.ndarray]()
    if len(darks):
        found[DARK] = odd_darks(darks, float(np.nanmedian(flats)))
        good = darks[~found[DARK]]
        flats = flats - np.median(good if len(good) else darks, axis=0)
    else:
        warn(f"{file.path} has flats, but no darks: the counts without light are taken as 0; add --darks")
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
    _tell_flats(file, file.numbers(FLAT)[~found[FLAT]], flats[~found[FLAT]])
    return replace(file, kinds=kinds)


def _tell_flats(file: ScanFile, numbers: np.ndarray, flats: np.ndarray) -> None:
    """Says which of the flats `numbers` [n] differ from the others, by thumbnails [n, h, w] of them less the dark."""
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


def lie_otherwise(flat: np.ndarray, relative: np.ndarray) -> Compared | None:
    """How the mean flat [h, w] lies if projections show its pattern better so than as it stands, and than no pattern,
    and by how much. None where they do not.

    relative: [h, w] mean logarithm of the projections over this flat. Its blocks count alike, for in those without
    matter a flat that is right leaves noise alone. Flats that lie otherwise leave their own asymmetry, too: what they
    leave must be nearer to that than to nothing, so that noise, which has no sides, does not decide.
    """
    pattern, tiny = np.log(np.maximum(flat, np.finfo(float).tiny)), np.finfo(float).tiny
    ways = {**UPRIGHT, **(SQUARE if flat.shape[0] == flat.shape[1] else {})}
    stands, none, found = _in_blocks(relative), _in_blocks(relative + pattern), list[Compared]()
    for name, turned in ways.items():
        other = pattern - turned(pattern)
        left, asymmetry = _in_blocks(relative + other), _in_blocks(other)
        least = 1e-12 * float(max(stands.max(), none.max(), left.max())) + tiny
        left, rivals = left + least, (stands + least, none + least)
        gains = [0.5 * np.log(rival / left) for rival in rivals]
        gains.append(gains[0] - 0.25 * np.log1p(asymmetry / left))
        each = [Compared(name, float(g.mean()), float(g.std(ddof=1) / np.sqrt(g.size))) for g in gains]
        found.append(min(each, key=lambda one: one.gain))
    best = max(found, key=lambda one: one.gain)
    return best if best.wins else None


def _in_blocks(image: np.ndarray) -> np.ndarray:
    """The variances [b] of an image [h, w] within blocks of `EDGE` pixels, two along each side at least."""
    edges = [min(EDGE, max(1, n // 2)) for n in image.shape]
    (rows, columns), (high, wide) = (n // e for n, e in zip(image.shape, edges)), edges
    whole = image[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
    return whole.var(axis=(1, 3)).ravel()
