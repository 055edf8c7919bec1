"""Bad input, said clearly: one exception type and the few checks every module shares.

A message is one sentence (or two) that names the field, the allowed values, the value given, and the remedy. The
command line prints it without a traceback and exits with a non-zero code.
"""

from __future__ import annotations

import logging
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

OUT_OF_MEMORY = re.compile(
    "can(no|')t allocate memory|memory allocation failed|not enough memory|out of memory|std::bad_alloc", re.IGNORECASE
)
"""What libraries say of memory, in errors of other kinds."""
LONGEST = 200
"""Characters of another message within ours, at most."""


class InputError(ValueError):
    """The input cannot be used; the message names the field, what it must be, what it is, and what to do.

    Examples:

        >>> import holosplat as hs
        >>> try:
        ...     hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=-1e-6)
        ... except hs.InputError as error:
        ...     print(error)
        pixel size must be a positive number of metres, but it is -1e-06; correct it.
    """


class UnsaidError(InputError):
    """Neither a file nor an option says what is needed; the message names the options.

    stand_ins: for each of these, by the name of its option, a value with which the rest of the file can be read.
    """

    def __init__(self, message: str, stand_ins: Mapping[str, Any]) -> None:
        super().__init__(message)
        self.stand_ins = dict(stand_ins)


class MissingError(InputError, RuntimeError):
    """A required package is not installed; the message names it, and the ways out."""


class NoMatterError(InputError):
    """Frames show no matter where a volume or a start needs some."""

    def __init__(self) -> None:
        super().__init__("the start found no matter in the holograms; check material, energy and distance.")


def is_of_memory(error: BaseException) -> bool:
    """Whether an error, of whichever kind, says that memory ran out."""
    return isinstance(error, MemoryError) or bool(OUT_OF_MEMORY.search(str(error)))


def reason_of(error: Exception) -> str:
    """Why something failed, in a line: an `InputError` says it; of others the kind and the last line."""
    if isinstance(error, InputError):
        return str(error)
    return ": ".join([type(error).__name__, *str(error).strip().splitlines()[-1:]])


def note(text: str) -> None:
    """Say what was found in the input: on standard error of a command, in Python by the logger `holosplat`."""
    logging.getLogger("holosplat").info(text)


def warn(text: str) -> None:
    """Say what may be wrong in the input, where `note` says what is right."""
    logging.getLogger("holosplat").warning(text)


def require(condition: bool, message: str) -> None:
    """Raise `InputError(message)` unless `condition` holds."""
    if not condition:
        raise InputError(message)


def positive(field: str, value: Any, unit: str = "") -> float:
    """`value` as a float, if it is a finite number above zero; `InputError` naming `field` otherwise."""
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        shown = f"{number:g}" if isinstance(value, (int, float)) else repr(value)[:LONGEST]
        raise InputError(f"{field} must be a positive number{_of(unit)}, but it is {shown}; correct it.")
    return number


def in_range(field: str, value: float, low: float, high: float, unit: str = "") -> float:
    """`value` as a float inside [low, high]; `InputError` otherwise (catches units mixed up)."""
    number = positive(field, value, unit)
    if not low <= number <= high:
        limits = f"{low:g} and {high:g} {unit}".rstrip()
        raise InputError(f"{field} must lie between {limits}, but it is {number:g}; check its unit.")
    return number


def at_least(options: object, low: float, *names: str) -> None:
    """`InputError` naming the first of the fields `names` of `options` that is below `low`."""
    for name in names:
        value = getattr(options, name)
        wanted = "must not be negative" if low == 0 else f"must be at least {low:g}"
        require(value >= low, f"{name} {wanted}, but it is {value}.")


def whole_seed(field: str, seed: int) -> int:
    """`seed`, if it is a number of 63 bits, which every generator takes; `InputError` naming `field` otherwise."""
    require(seed >= 0, f"{field} must be 0 or more, but it is {seed}.")
    require(seed < 1 << 63, f"{field} must be below 2⁶³, but it is {seed}.")
    return seed


def finite(field: str, array: np.ndarray) -> np.ndarray:
    """`array` unchanged, if every entry is finite; `InputError` naming `field` and the count otherwise."""
    bad = int(array.size - np.count_nonzero(np.isfinite(array)))
    if bad:
        raise InputError(
            f"{field} must hold finite numbers, but {bad} of {array.size} values are NaN or infinite; "
            "repair or mask them first."
        )
    return array


def shaped(field: str, array: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """`array` unchanged, if its shape matches `shape` (None matches any length); `InputError` otherwise."""
    if array.ndim != len(shape) or any(want is not None and want != got for want, got in zip(shape, array.shape)):
        wanted, found = (", ".join("any" if n is None else str(n) for n in one) for one in (shape, array.shape))
        raise InputError(f"{field} must have the shape ({wanted}), but it has the shape ({found}).")
    return array


def require_shapes(label: str, given: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """`InputError` unless `given` holds the arrays that are `wanted`, of the same shapes; wanted: arrays, or shapes;
    label: {} is one's name."""
    for name in {**wanted, **given}:
        want, got = (
            tuple(getattr(table[name], "shape", table[name])) if name in table else None for table in (wanted, given)
        )
        require(want == got, f"{label.format(name)} must have the shape {want}, but it has {got}.")


def require_regular(path: str | Path, what: str) -> None:
    """`InputError` unless `path`, which must be `what`, is a regular file: a named pipe or a device may never end."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"{path} must be {what}, but there is no such file; check the path.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} must be {what}, but it cannot be opened: {error}.") from None
    require(not stat.S_ISDIR(mode), f"{path} must be {what}, but it is a folder; name the file in it.")
    require(stat.S_ISREG(mode), f"{path} must be {what}, but it is a pipe or a device; copy what it gives to a file.")


@contextmanager
def as_written(path: str | Path, what: str = "") -> Iterator[None]:
    """`InputError` in place of what goes wrong in the block because `path` is not as we wrote it: something in it is
    missing, or of another kind; what: it must be, for the message."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path} must be {what or 'as it was written'}, but it is not: {error}") from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError, RuntimeError) as error:
        if is_of_memory(error):
            raise
        said = " ".join(str(error).split())[:LONGEST] or type(error).__name__
        raise InputError(
            f"{path} must be {what or 'as it was written'}, but it lacks or garbles {said}; bring back the whole file, "
            "or start anew."
        ) from error


def _of(unit: str) -> str:
    return f" of {unit}" if unit else ""
