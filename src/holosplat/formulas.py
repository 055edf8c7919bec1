"""Chemical formulas: their atoms, and δ and β by the atomic scattering factors of Chantler (1995, 2000).

The tables are those of `xraydb`, read as it reads them; its own module is not imported, for that loads SQLAlchemy: a
tenth of what a command takes to start. `tests/test_materials.py` holds that both give the same.
"""

from __future__ import annotations

import json
import math
import re
import sqlite3
from contextlib import closing
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import constants

from .checks import MissingError

TOKEN = re.compile(r"(\()|(?:(\))|([A-Z][a-z]*))([0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?)?")
"""Of a formula: what opens a group, closes one, or is an element; and how many there are of the last two."""
HEAVIEST = 92
"""Atomic number of uranium, the last element of Chantler's tables."""
AROUND = 3
"""Entries of a table below and above an energy between which a cubic spline gives f₁."""
LEAST = 1e-99
"""Size of an entry that has a logarithm."""


class Element(NamedTuple):
    """Atomic number, molar mass [g/mol], and Chantler's f₁ - Z and f₂ [electrons an atom] at energies [eV]."""

    number: int
    mass: float
    energies: np.ndarray
    f1: np.ndarray
    f2: np.ndarray


def atoms(formula: str) -> dict[str, float]:
    """How many atoms of each element "H2O" or "CaMg(CO3)2" has; empty where it is no formula, of elements to uranium.

    Numbers may be decimal ("La1.9Sr0.1CuO4", "Fe.7"); D is hydrogen.
    """
    text = re.sub(r"(?<![0-9])\.", "0.", formula).replace(" ", "")
    groups: list[dict[str, float]] = [{}]  # those that are open, the outermost first
    place = 0
    while place < len(text):
        token = TOKEN.match(text, place)
        if token is None or (token[2] and len(groups) == 1):
            return {}
        place = token.end()
        if token[1]:
            groups.append({})
            continue
        counted = groups.pop() if token[2] else {"H" if token[3] == "D" else token[3]: 1.0}
        for symbol, count in counted.items():
            groups[-1][symbol] = groups[-1].get(symbol, 0.0) + count * float(token[4] or 1)
    known = len(groups) == 1 and all(element(symbol) is not None for symbol in groups[0])
    return groups[0] if known and 0 < sum(groups[0].values()) < math.inf else {}


def delta_beta_per_density(formula: str, energy_kev: float) -> tuple[float, float]:
    """δ and β of a `formula` that has `atoms`, at 1 g/cm³ and `energy_kev` [keV], where Chantler's tables have both.

    δ = r_e λ² Σ n f₁ / 2π and β = r_e λ² Σ n f₂ / 2π, with n atoms a volume.
    """
    energy, delta, beta, mass = 1e3 * energy_kev, 0.0, 0.0, 0.0
    for symbol, count in atoms(formula).items():
        found = element(symbol)
        assert found is not None
        f1, f2 = _factors(found, energy)
        delta += count * constants.Avogadro * f1
        beta += count * constants.Avogadro * f2
        mass += count * found.mass
    wavelength_cm = 1e2 * constants.Planck * constants.c / constants.e / energy
    radius_cm = 1e2 * constants.physical_constants["classical electron radius"][0]
    scale = wavelength_cm**2 * radius_cm / (2 * math.pi * mass)
    return delta * scale, beta * scale


@cache
def element(symbol: str) -> Element | None:
    """The element, as the tables have it; None where there is none of that symbol, or one beyond uranium."""
    where = find_spec("xraydb")
    path = Path(where.origin or "").with_name("xraydb.sqlite") if where else None
    if path is None or not path.is_file():
        raise MissingError("The tables of xraydb are not installed; install holosplat again (pip install holosplat).")
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as tables:
        found = tables.execute("SELECT atomic_number, molar_mass FROM elements WHERE element = ?", (symbol,)).fetchone()
        if found is None or found[0] > HEAVIEST:
            return None
        row = tables.execute("SELECT energy, f1, f2 FROM Chantler WHERE element = ?", (symbol,)).fetchone()
    return Element(int(found[0]), float(found[1]), *(np.array(json.loads(text)) for text in row))


def _factors(found: Element, energy: float) -> tuple[float, float]:
    """f₁ and f₂ [electrons an atom] at `energy` [eV]: by a spline, and linear in logarithms of both."""
    from scipy.interpolate import UnivariateSpline

    at = int(np.searchsorted(found.energies, energy, side="right")) - 1
    near = slice(max(0, at - AROUND), at + AROUND + 1)
    energies, f1, f2 = (np.where(np.abs(a[near]) < LEAST, LEAST, a[near]) for a in found[2:])
    bound = np.asarray(UnivariateSpline(energies, f1, s=0)(energy))
    return found.number + float(bound), float(np.exp(np.interp(np.log(energy), np.log(energies), np.log(f2))))
