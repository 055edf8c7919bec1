"""Dataclasses of options whose numbers are checked when they are made, by ranges that stand beside the fields.

A number is finite, not negative and not beyond any experiment, unless its field says otherwise by one of the types
below, such as `Signed` or `Share`, or has the value as its default. A text is not empty, and one of those of a
`Literal`.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, wraps
from numbers import Integral, Real
from types import NoneType
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from .checks import InputError, require


@dataclass(frozen=True)
class Within:
    """The values that a number may have: from `low` to `high`, in `unit`; above: not `low` itself."""

    low: float
    high: float
    above: bool = False
    unit: str = ""

    def fault(self, value: float) -> str:
        """What `value` must be instead of what it is; empty where it is one of them."""
        if isinstance(value, bool):
            return "must be a number"
        if not (isinstance(value, Integral) or math.isfinite(value)):  # what is whole may be too large for a float
            return "must be a finite number"
        if value > self.high:
            return f"must be at most {_shown(self.high)} {self.unit}".rstrip()
        if value < self.low or (self.above and value == self.low):
            if self.above:
                return "must be a positive number" if self.low == 0 else f"must be above {_shown(self.low)}"
            return "must not be negative" if self.low == 0 else f"must be at least {_shown(self.low)}"
        return ""


LARGEST = 1e9
"""What no other setting exceeds."""
MOST = 10**9
"""What no count exceeds: the steps, views, cells or voxels of a year's computing."""

Signed = Annotated[float, Within(-1e6, 1e6)]
"""Angles [degrees], shifts [pixels], ratios and places [m, or a file's unit], which have a sign."""
Stretch = Annotated[float, Within(-10, 10)]
"""Logarithms of a stretch."""
Angle = Annotated[float, Within(0, 180, unit="degrees")]
"""Sizes of an angle [degrees]."""
Positive = Annotated[float, Within(0, LARGEST, above=True)]
Natural = Annotated[int, Within(1, MOST)]
"""A count of at least one."""
Several = Annotated[int, Within(2, MOST)]
"""A count of at least two."""
Many = Annotated[int, Within(1, 10**5)]
"""A count of views, moments, pulses or bodies simulated one by one: of more, nothing could be said for minutes."""
ManyOrNone = Annotated[int, Within(0, 10**5)]
Jobs = Annotated[int, Within(1, 1000)]
"""Processes of a machine."""
Degree = Annotated[int, Within(1, 5)]
"""Degrees of polynomials of time."""
Share = Annotated[float, Within(0, 1)]
SomeShare = Annotated[float, Within(0, 1, above=True)]
Weight = Annotated[float, Within(0, 1e6)]
"""Weights of terms, and thresholds in units of a noise or a level."""
Rate = Annotated[float, Within(0, 1e6)]
"""Steps of an optimiser, in units of its parameters: more than a million of these are no steps."""
Pixels = Annotated[float, Within(0, 1e4, unit="pixels")]
"""Lengths on a detector [pixels], which has no more."""
Metres = Annotated[float, Within(0, 1e4, unit="metres")]
"""Lengths of a beamline [m]."""
Index = Annotated[float, Within(0.1, 10)]
"""Refractive indices."""
Small = Annotated[float, Within(0, 1, above=True, unit="metres")]
"""Sizes of a specimen, a pixel or a voxel [m]."""
Seconds = Annotated[float, Within(0, 1e6, unit="seconds")]
Frequency = Annotated[float, Within(0, 1e12, above=True, unit="Hz")]
"""Frames a second [Hz]."""
Photons = Annotated[float, Within(0, 1e15, above=True)]
"""Photons of a pixel."""
Grams = Annotated[float, Within(0, 100, above=True, unit="g/cm³")]
"""Densities [g/cm³]; osmium has 22.6."""
Seed = Annotated[int, Within(0, (1 << 63) - 1)]
"""Seeds of 63 bits, which every generator takes."""

COUNTED = ("step", "steps", "seconds", "done", "count", "leg", "stage", "round", "oversample", "time_s")
"""What runs count, and never goes below zero."""
COUNTED_OR_FLAG = "round"
"""That of those which also says whether a wall is round (`volume.Wall`)."""
RISING, ANY = Within(0, 1 << 63), Within(-(1 << 64), 1 << 64)
FLOAT, COUNT = Within(0, LARGEST), Within(0, MOST)
_ranged: set[type] = set()
_later: list[bool] = []
"""Not empty: whoever makes options checks them himself."""
Kind = TypeVar("Kind")
Given = ParamSpec("Given")
Returned = TypeVar("Returned")


def ranged(kind: type[Kind]) -> type[Kind]:
    """Let the dataclass that is made of `kind` check its numbers and texts when it is made (`InputError`), beside what
    its own `__post_init__` asks for, which knows better what to say. It stands below `@dataclass`, where that has other
    options than those of `checked_dataclass`."""
    own: Callable[[Any], None] | None = getattr(kind, "__post_init__", None)

    def checked(self: Any) -> None:
        if _later:
            return
        try:
            if own is not None:
                own(self)
        except InputError:
            raise
        except Exception:  # of numbers that it did not think of
            require_sound(self)
            raise
        require_sound(self)

    _ranged.add(kind)
    setattr(kind, "__post_init__", checked)  # noqa: B010  # only a class of its own is known to have it
    return kind


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def checked_dataclass(kind: type[Kind]) -> type[Kind]:
    """Make of `kind` a frozen dataclass that is `ranged`."""
    return dataclass(frozen=True)(ranged(kind))


def with_checked_numbers(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """`function`, which refuses arguments that are out of their ranges as `ranged` dataclasses do."""

    @wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        signature = inspect.signature(function)
        hints = hints_of(function)
        _later.clear()
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            _require_sound(flag(name), value, signature.parameters[name].default, hints.get(name))
            _require_sound_within(value)
        return function(*args, **kwargs)

    return checked


@contextmanager
def checked_later() -> Iterator[None]:
    """What is made in the block is not checked before a function `with_checked_numbers` takes it: parsers of command
    lines say errors in a form of their own."""
    _later.append(True)
    try:
        yield
    finally:
        _later.clear()


def _require_sound_within(made: Any) -> None:
    """The same of `require_sound` for a dataclass of flags, and all dataclasses in it; of anything else, nothing."""
    if not is_dataclass(made) or isinstance(made, type):
        return
    if not _ranged.isdisjoint(type(made).__mro__):
        require_sound(made, flag)
        made.__post_init__()  # pyright: ignore[reportAttributeAccessIssue]  # which `ranged` has set
    for one in fields(made):
        _require_sound_within(getattr(made, one.name, None))


def flag(name: str) -> str:
    """How the command line calls the argument `name`."""
    return f"--{name.replace('_', '-')}"


def require_sound(made: Any, called: Callable[[str], str] = str) -> None:
    """`InputError` that names the first field of the dataclass `made` that is out of its range; called: how."""
    for name, default, hint in _fields(type(made)):
        _require_sound(called(name), getattr(made, name), default, hint)


def require_plausible(values: Any, name: str = "", *, others: bool = True) -> None:
    """`InputError` for numbers in nested tables and lists, as a file of ours holds them, that are not finite or beyond
    any setting; and for steps, seconds and counts below zero. others: whether to look at other numbers than these."""
    if isinstance(values, Mapping):
        for key, value in values.items():
            require_plausible(value, str(key), others=others)
    elif isinstance(values, list | tuple):
        for value in values:
            require_plausible(value, name, others=others)
    elif isinstance(values, bool) and (name not in COUNTED or name == COUNTED_OR_FLAG):
        return
    elif isinstance(values, Real) and (name in COUNTED or others):
        fault = (RISING if name in COUNTED else ANY).fault(values)  # pyright: ignore[reportArgumentType]
        require(not fault, f"{name} {fault}, but it is {_shown(values)}; it is not what was written.")  # pyright: ignore[reportArgumentType]


def range_of(hint: Any, value: float) -> Within:
    """The range of a field of the type `hint`, of which `value` is a number."""
    return next(_declared(hint), COUNT if isinstance(value, Integral) and not _takes_floats(hint) else FLOAT)


def _require_sound(name: str, value: Any, default: Any, hint: Any) -> None:
    if value is default or (isinstance(value, type(default)) and isinstance(value, Real | str) and value == default):
        return
    require(value != "" if isinstance(value, str) else True, f"{name} must not be empty; leave it out instead.")
    if (names := _names(hint)) and value not in names:
        known = ", ".join(str(one) for one in names if one is not None)
        raise InputError(f"{name} must be one of {known}, but it is {value!r}; correct it.")
    for number in _numbers(value):
        wanted = range_of(hint, number)
        if fault := wanted.fault(number):
            remedy = f"give it in {wanted.unit}" if wanted.unit else "correct it"
            raise InputError(f"{name} {fault}, but it is {_shown(number)}; {remedy}.")


def _numbers(value: Any) -> Iterator[Any]:
    """The numbers of a field: itself, or those of a tuple."""
    if isinstance(value, Real) and not isinstance(value, bool):
        yield value
    elif isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        for entry in value:
            yield from _numbers(entry)


def _declared(hint: Any) -> Iterator[Within]:
    """The ranges within a type, from the outside in."""
    if get_origin(hint) is Annotated:
        yield from (one for one in hint.__metadata__ if isinstance(one, Within))
    for inner in get_args(hint):
        yield from _declared(inner)


def _names(hint: Any) -> tuple[Any, ...]:
    """The values of a `Literal`, which may be None beside it; nothing of another type."""
    inner = [one for one in get_args(hint) if one is not NoneType]
    if get_origin(hint) is Literal:
        return get_args(hint)
    alone = len(inner) == 1 and len(get_args(hint)) == 2 and get_origin(inner[0]) is Literal
    return (*get_args(inner[0]), None) if alone else ()


def _takes_floats(hint: Any) -> bool:
    return hint is float or any(map(_takes_floats, get_args(hint)))


@cache
def _fields(kind: type) -> tuple[tuple[str, Any, Any], ...]:
    """Name, default and type of each field of a dataclass that may hold numbers or texts."""
    hints = hints_of(kind)
    return tuple((one.name, one.default, hints.get(one.name)) for one in fields(kind) if one.init)  # pyright: ignore[reportArgumentType]


def hints_of(thing: Any) -> dict[str, Any]:
    """The types of fields or arguments, as far as they can be told: some names are there for the type checker only."""
    try:
        return get_type_hints(thing, include_extras=True)
    except NameError:
        found = {}
        for base in reversed(getattr(thing, "__mro__", (thing,))):
            space = vars(sys.modules[base.__module__])
            for name, text in getattr(base, "__annotations__", {}).items():
                try:
                    found[name] = eval(text, space) if isinstance(text, str) else text  # our own source
                except NameError:
                    continue
        return found


def _shown(number: float) -> str:
    try:
        return str(number) if isinstance(number, Integral) and abs(number) < 1e7 else f"{float(number):g}"
    except OverflowError:
        return f"a number of {len(str(abs(number)))} digits"
