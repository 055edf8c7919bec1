"""Numbers in words: two digits, and never an exponent."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.units import (
    ANGLE_UNITS,
    ENERGY_UNITS,
    LENGTH_UNITS,
    TIME_UNITS,
    in_percent,
    number_of,
    plain,
    two_digits,
    unit_factor,
)

SOURCE = Path(__file__).resolve().parents[1] / "src"


@pytest.mark.parametrize(
    ("share", "said"),
    [
        *((0.0, "0 %"), (0.0043, "0.43 %"), (0.0305, "3 %"), (0.0314, "3.1 %"), (0.5, "50 %"), (0.9949, "99 %")),
        *((0.996, "100 %"), (1.0, "100 %"), (1.374, "137 %"), (24.0, "2400 %"), (-0.0123, "-1.2 %")),
        *((2.5e-8, "0.0000025 %"), (np.float32(0.73), "73 %"), (float("inf"), "inf %"), (float("nan"), "nan %")),
    ],
)
def test_shares_are_said_in_per_cent(share, said):
    assert in_percent(share) == said


def test_two_digits_are_whole_numbers_from_a_hundred_on():
    assert [two_digits(value) for value in (0.14, 1.44, 99.4, 99.6, 139.2)] == ["0.14", "1.4", "99", "100", "139"]


def test_no_share_is_written_with_an_exponent():
    """`:.2g` writes 100 as 1e+02: shares go through `in_percent`."""
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")}
    assert [path.name for path, text in texts.items() if re.search(r":\.\dg\} ?%", text)] == []


@pytest.mark.parametrize(
    ("unit", "table", "factor"),
    [
        *(("meters", LENGTH_UNITS, 1.0), ("Metre", LENGTH_UNITS, 1.0), ("Millimeters", LENGTH_UNITS, 1e-3)),
        *(("Microns", LENGTH_UNITS, 1e-6), ("[mm]", LENGTH_UNITS, 1e-3), ("Angstroms", LENGTH_UNITS, 1e-10)),
        *(("Deg", ANGLE_UNITS, np.pi / 180), ("DEGREES", ANGLE_UNITS, np.pi / 180), ("Radians", ANGLE_UNITS, 1.0)),
        *(("KeV", ENERGY_UNITS, 1.0), ("Electronvolts", ENERGY_UNITS, 1e-3), ("milliseconds", TIME_UNITS, 1e-3)),
    ],
)
def test_units_may_be_words(unit, table, factor):
    assert unit_factor("length", unit, table) == pytest.approx(factor)


@pytest.mark.parametrize(("unit", "table"), [("meV", ENERGY_UNITS), ("MM", LENGTH_UNITS), ("furlong", LENGTH_UNITS)])
def test_capitals_of_short_units_matter(unit, table):
    with pytest.raises(InputError, match="unknown unit"):
        unit_factor("length", unit, table)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (3430.0, "3430"),
        (999.6, "1000"),
        (1234567.0, "1234567"),
        (-0.0, "0"),
        (0.12345, "0.123"),
        (-2.5e-5, "-0.000025"),
    ],
)
def test_numbers_have_three_digits_and_no_exponent(value, said):
    assert plain(value) == said


@pytest.mark.parametrize(
    ("count", "noun", "said"), [(1, "body", "1 body"), (2, "body", "2 bodies"), (0, "time", "0 times")]
)
def test_a_number_of_things_has_their_plural(count, noun, said):
    assert number_of(count, noun) == said
