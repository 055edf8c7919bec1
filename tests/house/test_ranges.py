"""Every number that a user can give is refused, in one sentence, where no experiment has it."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import re
import typing
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import holosplat
import holosplat_bench.suite
from holosplat.checks import InputError
from holosplat.cli.entry import COMMANDS, command
from holosplat.materials import DeltaBeta
from holosplat.ranges import _fields, hints_of, range_of, with_checked_numbers
from holosplat.specimens.drawn import KINDS

ROOTS = [Path(package.__file__ or "").parent for package in (holosplat, holosplat_bench.suite)]
INTERNAL = {"Group", "Choice", "_Best", "_Unread", "Mark", "Block", "Blocks", "Decision", "Fields"}
"""What the code makes itself, of values that are checked."""
NEEDED: dict[str, dict[str, Any]] = {
    "Assimilation": {"peak": (0.01, 0.1)},
    "BallStar": {"diameters": (1e-5, 2e-5)},
    "Beam": {"energy_kev": 20.0, "distance": 0.1},
    "BeamView": {"angle_deg": 10.0},
    "BeamlineOptions": {"detector": (5, 13)},
    "Between": {"train": 3, "test": 2},
    "BodyWithAbsorber": {"size": (1e-5, 1e-5, 1e-5), "bead": 1e-6},
    "Capsules": {"count": 2, "diameters": (1e-5, 2e-5), "shell": 1e-6, "box": (1e-4, 1e-4, 1e-4)},
    "ChannelFrame": {"across": (1e-4, 1e-4)},
    "Configuration": {"name": "8k"},
    "CoatedDroplets": {"count": 2, "diameters": (1e-5, 2e-5), "coating": 1e-6, "box": (1e-4, 1e-4, 1e-4)},
    "CrowdedCells": {"haematocrit": 0.2, "diameter": 8e-6, "box": (1e-4, 1e-4, 1e-4)},
    "Detector": {"rows": 5, "columns": 13, "pixel_size": 1e-6},
    "ExtraTerm": {"name": "light_prior"},
    "FixedPatternOptions": {"order": 4},
    "FoamDrop": {"drop": 1e-4, "count": 5, "median": 1e-5},
    "GivenOptics": {"energy_kev": 20.0, "distance": 0.1, "pixel_size": 1e-6},
    "Interleaved": {"count": 8},
    "KnownRatio": {"ratio": 1000.0},
    "Listed": {"train": ((0.0, 0.0),), "test": ((10.0, 5.0),)},
    "RedCells": {"count": 3, "diameter": 8e-6, "box": (1e-4, 1e-4, 1e-4)},
    "RoundCell": {"diameter": 1e-5},
    "StackMeaning": {"voxel_size": 1e-6, "of": DeltaBeta(1e-7, 1e-10)},
    "SheppLogan": {"height": 1e-4},
    "SoftCells": {"count": 2, "diameters": (1e-5, 2e-5), "box": (1e-4, 1e-4, 1e-4), "edge": 1e-6},
    "Substance": {"formula": "plasma"},
    "Timing": {"frame_rate": 10.0},
    "Tissue": {"box": (1e-4, 1e-4, 1e-4)},
    "Tube": {"inner": 1e-3, "outer": 2e-3, "attenuation": 100.0},
}
NEEDED |= {kind.__name__: {"size": 4e-5} for kind in KINDS.values()}
"""What options without a default are made of here."""

MARKS = r"^((?:@.*\n)*@(?:checked_)?dataclass.*\n(?:@.*\n)*)"
CLASS = re.compile(MARKS + r"class (\w+).*\n((?:(?:    .*)?\n)*)", re.MULTILINE)
RANGED = re.compile("@ranged|@checked_dataclass")
FIELD = re.compile(r"^    \w+: (.*?)(?: = (.*))?$", re.MULTILINE)
PLAIN = re.compile(r"(?<!\w)(?:float|int)(?!\w)")


@cache
def classes() -> dict[str, tuple[str, bool, bool]]:
    """Of each dataclass with numbers: its module, whether all its fields have defaults, and whether it is ranged."""
    found = {}
    for path in (path for root in ROOTS for path in root.rglob("*.py")):
        module = ".".join(path.relative_to(ROOTS[0].parent).with_suffix("").parts).removesuffix(".__init__")
        for marks, name, body in CLASS.findall(path.read_text(encoding="utf-8")):
            fields = [field for field in FIELD.findall(body) if "ClassVar" not in field[0]]
            is_ranged = RANGED.search(marks) is not None
            if is_ranged or any(PLAIN.search(hint) for hint, _ in fields):
                found[f"{module}.{name}"] = (module, all(default for _, default in fields), is_ranged)
    return found


def all_ranged() -> list[str]:
    return [
        name
        for name, (_, _, is_ranged) in classes().items()
        if is_ranged and not name.endswith((".Declaration", ".FileOfCase"))
    ]


def made(name: str) -> Any:
    short = name.rsplit(".", 1)[1]
    return getattr(importlib.import_module(classes()[name][0]), short)(**NEEDED.get(short, {}))


def filled(hint: Any, number: float) -> Any:
    """What a field of the type `hint` holds where each of its numbers is `number`."""
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind is tuple:
        return tuple(filled(one, number) for one in inner if one is not Ellipsis)
    return filled(next(one for one in inner if takes_numbers(one)), number) if inner else number


def refusal(base: Any, field: str, value: Any) -> str:
    """What is said of `base` with another value of a field; empty where it is taken."""
    try:
        dataclasses.replace(base, **{field: value})
    except InputError as error:
        return str(error)
    return ""


def takes_numbers(hint: Any) -> bool:
    if typing.get_origin(hint) in (Callable, Mapping, dict, typing.ClassVar):
        return False
    return hint in (int, float) or any(map(takes_numbers, typing.get_args(hint)))


def test_options_have_ranges():
    """A class whose fields all have defaults is one of options."""
    bare = [n for n, (_, whole, is_ranged) in classes().items() if whole and not is_ranged]
    assert [name for name in bare if name.rsplit(".", 1)[1] not in INTERNAL] == []


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30, -1e30, -1, 0])
def test_every_number_of_options_is_refused_or_within_its_range(value):
    """Refused in a sentence. Nothing takes what no experiment has, and -1 is taken only where the field says so."""
    tried = 0
    for name in all_ranged():
        base = made(name)
        for field, _, hint in _fields(type(base)):
            if not takes_numbers(hint):
                continue
            tried += 1
            said = refusal(base, field, filled(hint, value))
            if said:
                assert said.endswith("."), (name, field)
            else:
                assert value in (0, -1), (name, field)
                assert range_of(hint, value).low <= value, (name, field)
    assert tried > 350


def test_every_number_of_a_command_is_refused_or_within_its_range():
    """Options of commands are dataclasses above; these are the arguments beside them."""
    tried = 0
    for name in COMMANDS:
        hints = hints_of(command(name))
        for field, parameter in inspect.signature(command(name)).parameters.items():
            if takes_numbers(hint := hints.get(field)):
                for value in (math.nan, math.inf, 1e30, -1e30):
                    with pytest.raises(InputError, match=f"--{field.replace('_', '-')} must"):
                        with_checked_numbers(_stub(field, hint, parameter.default))(value)
                    tried += 1
            elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
                holds = any(takes_numbers(inner) for inner in hints_of(hint).values())
                assert not holds or f"{hint.__module__}.{hint.__name__}" in all_ranged(), (name, field)
    assert tried >= 30


def _stub(field: str, hint: Any, default: Any) -> Any:
    """A function of the one argument `field` that does nothing."""

    def stub(value: Any = default) -> None:
        pass

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    stub.__signature__ = inspect.Signature([inspect.Parameter(field, kind, default=default)])  # pyright: ignore
    stub.__annotations__ = {field: hint}
    return stub


def defaults_of(module: Any) -> list[Any]:
    """Defaults of all arguments and fields in a module that an object of ours is."""
    found = list[Any]()
    for one in vars(module).values():
        for each in [one, *vars(one).values()] if inspect.isclass(one) else [one]:
            function = getattr(each, "__func__", each)
            if inspect.isfunction(function):
                found += [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
        if dataclasses.is_dataclass(one):
            found += [field.default for field in dataclasses.fields(one)]
    return [one for one in found if type(one).__module__.startswith("holosplat")]


def test_defaults_that_are_objects_are_immutable():
    """They are made once, and shared by all calls and objects."""
    modules = {importlib.import_module(module) for module, _, _ in classes().values()}
    kinds = {type(one) for module in modules for one in defaults_of(module) if not isinstance(one, tuple)}
    assert len(kinds) > 50
    assert {one.__name__ for one in kinds if not one.__dataclass_params__.frozen} == set()
