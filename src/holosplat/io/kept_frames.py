"""Which frames of a raw file count: its flats and darks, those beside it, and none that are left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from ..checks import require, warn
from ..preprocess.odd_frames import odd_darks, odd_flats, thumbnail
from .hdf5_virtual import require_filled
from .light_frames import light_frames
from .raw_file import DARK, FLAT, INVALID, PROJECTION, ScanFile, together
from .reading import marked

NAMED = 5
"""Frames that a message names at most."""


def with_fields(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    """The file with the flats and darks that are `given` beside it (paths), after its own, and without frames to leave
    out: those that are `given` by number, or flats and darks that are unlike the others of their kind.

    Errors: `InputError` for frames without data.
    """
    file = _without(_with_given(file, given), given.get("leave_out"))
    begin = 0
    for stack in file.stacks:
        if isinstance(stack, h5py.Dataset):
            gaps = require_filled(stack, file.label, file.kinds[begin : begin + len(stack)] != INVALID)
            if gaps is not None:
                file = replace(file, marked=gaps if file.marked is None else gaps | (file.marked != 0))
        begin += stack.shape[0]
    return _without_odd(file, is_told=given.get("leave_out") is not None)


def _with_given(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    extra = [(kind, given.get(name)) for kind, name in ((FLAT, "flats"), (DARK, "darks"))]
    if file.has_given_fields or all(path is None for _, path in extra):
        return file
    names = {FLAT: "flat|white", DARK: "dark"}
    parts = [(kind, light_frames(path, names[kind], kind)) for kind, path in extra if path is not None]
    stacks, kinds = together(str(file.path), [(PROJECTION, file.stacks[0]), *parts])
    more = kinds[file.stacks[0].shape[0] :]
    return replace(file, stacks=(*file.stacks, *stacks[1:]), kinds=np.concatenate([file.kinds, more]))


def _without(file: ScanFile, numbers: str | None) -> ScanFile:
    """The file without the frames that --leave-out names."""
    if numbers is None:
        return file
    left = marked("--leave-out", numbers, len(file.kinds))
    kept = ~left[file.numbers(PROJECTION)]
    require(bool(kept.any()), "--leave-out must leave some projections, but it names them all.")
    divided = None if file.divided is None else file.divided[np.flatnonzero(kept)]
    kinds, exposures = np.where(left, INVALID, file.kinds), file.exposures[np.flatnonzero(kept)]
    return replace(file, kinds=kinds, exposures=exposures, is_test=file.is_test[kept], divided=divided)


def _without_odd(file: ScanFile, is_told: bool) -> ScanFile:
    """The file without flats and darks that are unlike the others, which it names; is_told: with them, as --leave-out
    says which frames to leave. Errors: `InputError` where half of them differ or more."""
    small = {kind: [thumbnail(file.frame(n)) for n in file.numbers(kind)] for kind in (FLAT, DARK)}
    if not small[FLAT]:
        return file
    darks, flats, found = np.array(small[DARK]), np.array(small[FLAT]), dict[int, np.ndarray]()
    if len(darks):
        found[DARK] = odd_darks(darks, float(np.nanmedian(flats)))
        good = darks[~found[DARK]]
        flats = flats - np.median(good if len(good) else darks, axis=0)
    found[FLAT] = odd_flats(flats)
    kinds = file.kinds.copy()
    for kind, odd in found.items():
        numbers, (word, other) = file.numbers(kind)[odd], ("flat", "dark") if kind == FLAT else ("dark", "flat")
        first = ", ".join(file.name(n) for n in numbers[:NAMED])
        named = f"{first} and {len(numbers) - NAMED} more" if len(numbers) > NAMED else first
        require(
            2 * len(numbers) < len(odd) or not len(numbers) or is_told,
            f"{file.path} must have {word}s that are alike and no {other}s, but {named} differ; check image_key, and "
            "leave those that are wrong by --leave-out.",
        )
        if len(numbers):
            kept = "stays, as --leave-out does not name it" if is_told else "is left out; --leave-out chooses otherwise"
            warn(f"{file.path}: unlike the other {word}s, {named} {kept}")
        if not is_told:
            kinds[numbers] = INVALID
    return replace(file, kinds=kinds)
