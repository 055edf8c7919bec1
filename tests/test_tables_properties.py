"""Tables of settings of any values: they come back through JSON, merge, and change by path."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.strategies import NAMES
from holosplat.methods import METHODS
from holosplat.methods.presets import method_of, preset, preset_names
from holosplat.tables import changed, from_table, merged, overridden, to_table

FLOATS = st.floats(allow_nan=False, allow_infinity=False)


@dataclass(frozen=True)
class Rates:
    """Numbers, and one that may be left out."""

    first: float = 1.0
    second: float | None = None
    several: tuple[float, ...] = ()


@dataclass(frozen=True)
class Plain:
    """One member of a union."""

    kind: ClassVar[str] = "plain"
    steps: int = 3
    file: Path = Path("scan.nxs")


@dataclass(frozen=True)
class Fine:
    """Another one."""

    kind: ClassVar[str] = "fine"
    pair: tuple[int, str] = (1, "one")
    rates: Rates = Rates()


@dataclass(frozen=True)
class Everything:
    """Each kind of field that tables know."""

    name: str = "none"
    on: bool = False
    choice: Literal["left", "right"] = "left"
    rates: Rates = Rates()
    method: Plain | Fine = Plain()
    extra: Rates | None = None


RATES = st.builds(Rates, FLOATS, st.none() | FLOATS, st.lists(FLOATS, max_size=3).map(tuple))
MEMBERS = st.builds(Plain, st.integers(), NAMES.map(Path)) | st.builds(Fine, st.tuples(st.integers(), NAMES), RATES)
ALL = st.builds(Everything, NAMES, st.booleans(), st.sampled_from(["left", "right"]), RATES, MEMBERS, st.none() | RATES)


@given(ALL)
def test_settings_come_back_through_json(settings):
    assert from_table(Everything, json.loads(json.dumps(to_table(settings)))) == settings


@given(ALL, ALL)
def test_merging_a_whole_table_gives_that_table(one, other):
    """And merging nothing, or itself, changes nothing."""
    first, second = to_table(one), to_table(other)
    assert merged(first, {}) == merged({}, first) == merged(first, first) == first
    assert from_table(Everything, merged(first, second)) == other
    assert changed(one, second) == other


@given(ALL, NAMES, st.booleans(), FLOATS)
def test_a_change_leaves_the_rest_alone(settings, name, on, first):
    found = changed(settings, {"name": name, "on": on, "rates": {"first": first}})
    rates = dataclasses.replace(settings.rates, first=first)
    assert found == dataclasses.replace(settings, name=name, on=on, rates=rates)


@given(ALL, FLOATS, st.integers(-(2**63), 2**63 - 1))
def test_a_field_is_set_by_its_path(settings, first, steps):
    found = overridden(settings, [f"rates.first={first!r}", "method.kind=plain", f"method.steps={steps}"])
    assert (found.rates.first, found.method.steps) == (first, steps)
    assert found == dataclasses.replace(settings, rates=found.rates, method=found.method)
    assert found.rates == dataclasses.replace(settings.rates, first=first)


@pytest.mark.parametrize("name", [*preset_names(), *METHODS])
def test_the_options_of_every_method_come_back_through_json(name):
    options = METHODS[name] if name in METHODS else preset(name)
    table = json.loads(json.dumps(to_table(options)))
    assert from_table(type(options), table) == options
    assert method_of(table) == options
