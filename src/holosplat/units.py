"""Constants, and units as files name them. Inside, everything is SI; energies are in keV by name."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from .checks import InputError, finite, positive, require

PLANCK_TIMES_C_KEV_M = 1.2398419843320026e-9
"""h·c in keV·m (CODATA 2018, exact)."""

LENGTH_UNITS = {
    "m": 1.0,
    "dm": 1e-1,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "micrometer": 1e-6,
    "micron": 1e-6,
    "nm": 1e-9,
    "meter": 1.0,
    "metre": 1.0,
    "millimeter": 1e-3,
    "millimetre": 1e-3,
    "microns": 1e-6,
    "micrometre": 1e-6,
    "nanometer": 1e-9,
    "nanometre": 1e-9,
    "angstrom": 1e-10,
    "Å": 1e-10,
}
ENERGY_UNITS = {"keV": 1.0, "kev": 1.0, "eV": 1e-3, "ev": 1e-3, "MeV": 1e3, "J": 1 / 1.602176634e-16}
ANGLE_UNITS = {
    "deg": math.pi / 180,
    "degree": math.pi / 180,
    "degrees": math.pi / 180,
    "°": math.pi / 180,
    "rad": 1.0,
    "radian": 1.0,
    "radians": 1.0,
}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "second": 1.0, "seconds": 1.0}


def unit_factor(field: str, unit: str, table: dict[str, float]) -> float:
    """The factor that brings `unit` to the table's base unit; `InputError` naming `field` if it is unknown."""
    try:
        return table[unit.strip()]
    except KeyError:
        known = ", ".join(table)
        raise InputError(f"{field} has the unknown unit {unit!r}; use one of {known}.") from None


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


def plain(value: float, digits: int = 3) -> str:
    """`value` to so many digits, or to a whole number where that has more; without exponent, 0 without sign."""
    rounded = np.rint(value) if abs(value) >= 10**digits - 0.5 else float(f"{value:.{digits}g}")
    return np.format_float_positional(rounded + 0.0, trim="-")


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
