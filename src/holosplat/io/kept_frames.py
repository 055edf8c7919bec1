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


def with_fields(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    """The file with the flats and darks that are `given` beside it (paths), after its own, and without frames to leave
    out: those that are `given` by number, or flats and darks that are unlike the others of their kind.

    Errors: `InputError` for frames without data.
    """
    file = _without(_with_given(file, given), given.get("leave_out"))
    begin = 0
    for stack in file.stacks:
        if isinstance(stack, h5py.Dataset):
            require_filled(stack, file.label, file.kinds[begin : begin + len(stack)] != INVALID)
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
    says which frames to leave. Errors: `InputError` for two that differ."""
    small = {kind: [thumbnail(file.frame(n)) for n in file.numbers(kind)] for kind in (FLAT, DARK)}
    if not small[FLAT]:
        return file
    dark = np.median(small[DARK], axis=0) if small[DARK] else 0.0
    lit = np.array(small[FLAT]) - dark
    found = {FLAT: odd_flats(lit)}
    if small[DARK]:
        found[DARK] = odd_darks(np.array(small[DARK]), float(np.median(lit)))
    kinds = file.kinds.copy()
    for kind, odd in found.items():
        numbers, word = file.numbers(kind)[odd], "flat" if kind == FLAT else "dark"
        named = ", ".join(file.name(n) for n in numbers)
        require(
            len(odd) != 2 or not len(numbers) or is_told,
            f"{file.path} must have {word}s that are alike, but {named} differ; leave one of them by --leave-out.",
        )
        if len(numbers):
            kept = "stays, as --leave-out does not name it" if is_told else "is left out; --leave-out chooses otherwise"
            warn(f"{file.path}: unlike the other {word}s, {named} {kept}")
        if not is_told:
            kinds[numbers] = INVALID
    return replace(file, kinds=kinds)
