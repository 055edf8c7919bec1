"""Constants, and units as files name them. Inside, everything is SI; energies are in keV by name."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from .checks import InputError, finite, in_range, positive, require

PLANCK_TIMES_C_KEV_M = 1.2398419843320026e-9
"""h·c in keV·m (CODATA 2018, exact)."""

XRAYS_KEV = (0.1, 400.0)
"""Energies [keV] that are said as such; light and electrons outside are said by their wavelength."""
WAVELENGTH_RANGE_M = (1.24e-12, 1e-3)
"""From electrons of 600 kV to terahertz waves [m]."""
BEAM_RANGE_KEV = (1e-6, 1000.0)
"""Photon energies [keV] among which they are."""

PREFIXES = {"": 0, "kilo": 3, "deci": -1, "centi": -2, "milli": -3, "micro": -6, "nano": -9, "pico": -12}
"""Words before a unit, and their powers of ten."""
LENGTH_UNITS = {
    **{"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "pm": 1e-12},
    **{f"{part}{word}": 10.0**power for word in ("meter", "metre") for part, power in PREFIXES.items()},
    **{"micron": 1e-6, "angstrom": 1e-10, "ångström": 1e-10, "Å": 1e-10},
}
ENERGY_UNITS = {
    **{"keV": 1.0, "kev": 1.0, "eV": 1e-3, "ev": 1e-3, "MeV": 1e3, "J": 1 / 1.602176634e-16},
    **{"electronvolt": 1e-3, "kiloelectronvolt": 1.0, "joule": 1 / 1.602176634e-16},
}
ANGLE_UNITS = {
    **dict.fromkeys(("deg", "degree", "°"), math.pi / 180),
    **dict.fromkeys(("rad", "radian"), 1.0),
    **dict.fromkeys(("mrad", "milliradian"), 1e-3),
    **dict.fromkeys(("mdeg", "millidegree"), math.pi / 180e3),
}
TIME_UNITS = {
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "sec": 1.0},
    **{f"{part}second": 10.0**power for part, power in PREFIXES.items()},
}
WORDS = 3
"""Units of so many letters are words, whose capitals and plural do not matter; MeV and meV are none."""


def unit_factor(field: str, unit: str, table: dict[str, float]) -> float:
    """The factor that brings `unit` to the table's base unit; `InputError` naming `field` if it is unknown."""
    said = re.sub(r"\s*/\s*(px|pixels?)$", "", unit.strip().strip("[]()."))
    words = {name.lower(): factor for name, factor in table.items() if len(name) >= WORDS and name != "MeV"}
    word = re.sub(r"[\s_-]", "", said.lower())
    factor = table.get(said, words.get(word, words.get(word.removesuffix("s"))))
    if factor is None:
        raise InputError(f"{field} has the unknown unit {unit!r}; use one of {', '.join(table)}.")
    return factor


Energy = TypeVar("Energy", float, np.ndarray)
"""One photon energy, or an array of any shape."""


def wavelength(energy_kev: Energy) -> Energy:
    """Wavelength [m] of photons of `energy_kev` [keV]: λ = hc/E."""
    if isinstance(energy_kev, np.ndarray):
        energies = finite("energy_kev", energy_kev)
        require(bool((energies > 0).all()), "energy_kev must hold positive numbers of keV; correct those that are not.")
        return PLANCK_TIMES_C_KEV_M / energies
    return PLANCK_TIMES_C_KEV_M / positive("energy_kev", energy_kev, "keV")


def wavenumber(energy_kev: Energy) -> Energy:
    """Wavenumber k = 2π/λ [rad/m] of photons of `energy_kev` [keV]."""
    return 2 * math.pi / wavelength(energy_kev)


def photon_energy(wavelength: float, medium_index: float = 1.0) -> float:
    """Energy [keV] of photons that have in vacuum the wavelength which light of `wavelength` [m] has in a medium.

    medium_index: its refractive index n. `E = hc n/λ`, so that `units.wavelength` of it is λ/n. Of electrons it is a
    name for their wavelength alone. Errors: `InputError` for numbers out of range.
    """
    index = positive("--medium-index", medium_index)
    return PLANCK_TIMES_C_KEV_M / in_range("--wavelength", wavelength / index, *WAVELENGTH_RANGE_M, unit="metres")


def beam_named(energies_kev: np.ndarray | float) -> tuple[str, str]:
    """What a table says of `energies_kev` [keV]: photon energies of X-rays, else wavelengths in the medium."""
    energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
    if ((energies >= XRAYS_KEV[0]) & (energies <= XRAYS_KEV[1])).all():
        return "photon energy", f"{span(energies)} keV"
    lengths = wavelength(energies)
    unit, factor = ("pm", 1e12) if lengths.max() < 1e-9 else length_unit(float(lengths.max()))
    return "wavelength in medium", f"{span(factor * lengths)} {unit}"


def plain(value: float, digits: int = 3) -> str:
    """`value` to so many digits, or to a whole number where that has more; without exponent, 0 without sign."""
    rounded = np.rint(value) if abs(value) >= 10**digits - 0.5 else float(f"{value:.{digits}g}")
    return np.format_float_positional(rounded + 0.0, trim="-")


def number_of(count: int, noun: str) -> str:
    """A number of things: 1 body, 2 bodies."""
    several = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{count} {noun if count == 1 else several}"


def two_digits(value: float) -> str:
    """`value` to two digits, or to a whole number from a hundred on; never with an exponent."""
    return plain(value, 2)


def in_percent(share: float) -> str:
    """`share` in per cent, to `two_digits`: 100 %, 3.1 %, 0.43 %."""
    return f"{two_digits(100 * float(share))} %"


def span(values: np.ndarray) -> str:
    """The least and the greatest of `values` in words, to four digits; one number where these are the same."""
    low, high = (f"{value:.4g}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def length_unit(extent: float) -> tuple[str, float]:
    """A unit that suits lengths up to `extent` [m], and how many of it one metre holds."""
    for name, factor in (("mm", 1e3), ("µm", 1e6)):
        if extent * factor >= 0.9995:
            return name, factor
    return "nm", 1e9


def format_length(length: float, digits: int = 3) -> str:
    """`length` [m] with a suitable unit: 4.2e-7 → "420 nm"."""
    unit, factor = length_unit(abs(length))
    return f"{plain(length * factor, digits)}\u00a0{unit}"


def bar_length(width: float) -> float:
    """A round length of up to a quarter of `width` [m], for a scale bar."""
    target = 0.28 * width
    power = 10.0 ** math.floor(math.log10(target))
    return max(step * power for step in (1, 2, 5) if step * power <= target)


def size_in_words(bytes_: float) -> str:
    """`bytes_` in MB, or in GB to two digits."""
    return f"{two_digits(bytes_ / 1e9)} GB" if bytes_ >= 0.95e9 else f"{max(1.0, bytes_ / 1e6):.0f} MB"


def between(words: Callable[[float], str], least: float, most: float) -> str:
    """A range of times or sizes in `words`; the first alone where there is no other."""
    first, last = words(least), words(max(least, most))
    return first if first == last else f"{first.removesuffix(last[last.index(' ') :])} to {last}"


def time_in_words(seconds: float) -> str:
    """In one unit, to about a digit."""
    if seconds < 90:
        return f"{max(1, round(seconds, -1)):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
