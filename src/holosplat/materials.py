"""Matter to refractive index: δ and β of formulas and mixtures, n = 1 - δ + iβ (docs/conventions.md).

Atomic scattering factors come from Chantler (1995, J. Phys. Chem. Ref. Data 24, 71; 2000, ibid. 29, 597) through
`xraydb`: δ = r_e λ² Σ n_j f1_j / 2π, β = r_e λ² Σ n_j f2_j / 2π. β is photoabsorption only: photons scattered out of
the beam (a third of water's attenuation at 20 keV) are not in it. Densities are in g/cm³, the unit chemists and tables
use; energies in keV.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import xraydb

from .checks import InputError, in_range, require
from .matter import DeltaBeta as DeltaBeta
from .scan import far_from_edges
from .tables import number_in, read_table, shown
from .units import XRAYS_KEV, beam_named
from .volume import Wall

NAMES = "a name that `holosplat materials` lists, such as water, plasma, soft tissue or PMMA"
"""What messages say of named materials."""
WITH = "H2O|D2O|T2O|NH3|HCl|H2O2|CH3OH|CH4O|C2H5OH|C2H6O"
"""What crystals hold beside a salt: a point before a number of these joins them."""
JOINT = re.compile(
    rf"\s*[·•∙⋅*×]\s*|\s*\.\s*(?=[A-Z(\[])|(?:\s*(?<![.·•∙⋅*×\s]\d)\.\s*|\s+)(?=\d*\.?\d*\s*(?:{WITH}|\((?:{WITH})\))(?:$|[\s.·•∙⋅*×]))(?<![.·•∙⋅*×\s]\d\s)"
)
"""What joins the parts of a formula."""
NUMBERED, ALONE = re.compile(r"(\d*\.?\d*)\s*(\S+)$"), re.compile(r"()([^\s\d]\S*)$")
"""A part of a formula with its number, and a formula of one part, which has none."""
ISOTOPE = re.compile(r"\[(\d+)([A-Z][a-z]?)\]")
HYDROGEN = {"D": "[2H]", "T": "[3H]"}
MASSES = {
    **{"H2": 2.01410, "H3": 3.01605, "He3": 3.01603, "Li6": 6.01512, "Li7": 7.01600},
    **{"B10": 10.01294, "B11": 11.00931},
}
"""Masses [u] of the isotopes that are farthest from their number of nucleons in proportion (Wang et al. 2021)."""
WRONG = re.compile(r"[.·•∙⋅*×\s]\d*\.?\d*\s*H20$|\.(?!\s*[\dA-Z(\[])")
"""Water with the digit 0, and points that nothing follows."""
STAND_IN = "Lr"
"""An element beyond uranium, which stands for an isotope while its atoms are counted."""
MAX_DENSITY_G_CM3 = 30.0
"""Above osmium (22.6 g/cm³), the densest element: a higher density has a wrong unit."""


def _density(name: str, value: Any) -> float:
    field = f"density of {name}"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{field} must be a number of g/cm³, but it is {value!r}; correct it.")
    return in_range(field, value, 1e-6, MAX_DENSITY_G_CM3, unit="g/cm³")


@lru_cache(maxsize=256)
def _atoms(formula: str) -> tuple[str, float]:
    """A formula as `xraydb` knows it, and how many times heavier its isotopes make it.

    Parts of a hydrate stand behind a point, `·`, `*` or a space, with their number before them (CaSO4.2H2O); a point
    before a number is one of decimals elsewhere (O6.9). Isotopes are D, T, and others as [13C]. Errors: `InputError`.
    """
    counts: dict[str, float] = {}
    isotopes, formula = 0.0, unicodedata.normalize("NFKC", formula)  # H₂O as H2O, ½ as 1⁄2
    formula = re.sub(r"([1-9])⁄([1-9])", lambda found: f"{int(found[1]) / int(found[2]):.9g}", formula)
    try:
        parts = re.split(JOINT, formula.strip())
        for part in parts:
            number, group = (NUMBERED if len(parts) > 1 else ALONE).match(part).groups()  # type: ignore[union-attr]
            group, times = re.sub(r"([DT])(?![a-z])", lambda found: HYDROGEN[found[1]], group), float(number or 1)
            plain = re.sub(ISOTOPE, r"\2", group)
            for symbol, count in xraydb.chemparse(plain).items():
                counts[symbol] = counts.get(symbol, 0.0) + times * count
            for text, nucleons, symbol in {(found[0], found[1], found[2]) for found in re.finditer(ISOTOPE, group)}:
                alone = re.sub(ISOTOPE, r"\2", group.replace(text, STAND_IN))
                added = MASSES.get(symbol + nucleons, float(nucleons)) - xraydb.atomic_mass(symbol)
                isotopes += times * xraydb.chemparse(alone)[STAND_IN] * added
        heaviest = max(xraydb.atomic_number(symbol) for symbol in counts)
        known = sum(counts.values()) > 0 and heaviest <= 92 and not WRONG.search(formula) and STAND_IN not in formula
    except (AttributeError, KeyError, TypeError, ValueError):  # xraydb raises many kinds
        known = False
    if not known:
        raise InputError(
            f"material {formula!r} must be a chemical formula of elements up to uranium, such as 'H2O', 'SiO2' or "
            f"'CaSO4.2H2O' (mind the capitals; isotopes as D or [13C]), or {NAMES}."
        )
    mass = sum(count * xraydb.atomic_mass(symbol) for symbol, count in counts.items())
    return "".join(f"{symbol}{count:.9f}" for symbol, count in counts.items()), 1 + isotopes / mass


@lru_cache(maxsize=1024)
def _per_density(formula: str, energy_kev: float) -> DeltaBeta:
    """δ and β of `formula` at 1 g/cm³ (both are proportional to the density)."""
    atoms, heavier = _atoms(formula)
    delta, beta, _ = xraydb.xray_delta_beta(atoms, 1.0, 1e3 * energy_kev)
    return DeltaBeta(float(delta) / heavier, float(beta) / heavier)


@dataclass(frozen=True)
class Compound:
    """One chemical formula ("H2O", "CaMg(CO3)2") at a density [g/cm³]; `InputError` if either is wrong."""

    formula: str
    density_g_cm3: float

    def __post_init__(self) -> None:
        _atoms(self.formula)
        object.__setattr__(self, "density_g_cm3", _density(self.formula, self.density_g_cm3))

    def delta_beta(self, energy_kev: float) -> DeltaBeta:
        """δ and β at `energy_kev` [keV, 0.1 to 400]; `InputError` outside."""
        low, high = XRAYS_KEV  # where Chantler's tables hold both f1 and f2
        if not low <= energy_kev <= high:
            raise InputError(
                f"the energy must lie between {low:g} and {high:g} keV where a material is named, whose δ and β are "
                f"tabulated for X-rays, but it is {energy_kev:g} keV ({beam_named(energy_kev)[1]}); of light and "
                "electrons say a refractive index or δ/β instead of the material."
            )
        per_density = _per_density(self.formula, energy_kev)
        return DeltaBeta(*(self.density_g_cm3 * value for value in per_density))


@dataclass(frozen=True)
class Mixture:
    """Several substances by mass fraction, at the mixture's own density.

    components: `((substance, mass fraction), …)`, a substance being a formula, a `Compound` or a `Mixture`
    (whose own density does not count here); the fractions must be positive and add up to 1.
    density_g_cm3: of the whole [g/cm³].
    """

    components: tuple[tuple[str | Compound | Mixture, float], ...]
    density_g_cm3: float

    def __post_init__(self) -> None:
        try:
            parts = tuple((part, float(fraction)) for part, fraction in self.components)
        except (TypeError, ValueError):
            raise InputError(
                f"mixture components must be pairs (substance, mass fraction), not {self.components!r}."
            ) from None
        for part, fraction in parts:
            require(0 < fraction <= 1, f"mass fraction of {part} must lie in (0, 1], but it is {fraction:g}.")
        total = sum(fraction for _, fraction in parts)
        require(
            abs(total - 1) < 1e-6,
            f"mass fractions of a mixture must add up to 1, but they add up to {total:.6g}.",
        )
        parts = tuple((Compound(part, 1.0) if isinstance(part, str) else part, f) for part, f in parts)
        object.__setattr__(self, "components", parts)
        object.__setattr__(self, "density_g_cm3", _density("the mixture", self.density_g_cm3))

    def delta_beta(self, energy_kev: float) -> DeltaBeta:
        """δ and β at `energy_kev` [keV, 0.1 to 400]: mass-weighted sums of δ/ρ and β/ρ times the density."""
        delta = beta = 0.0
        for part, fraction in self.components:
            of_part = part.delta_beta(energy_kev)  # type: ignore[union-attr]  # formulas became Compounds above
            delta += fraction * of_part.delta / part.density_g_cm3  # type: ignore[union-attr]
            beta += fraction * of_part.beta / part.density_g_cm3  # type: ignore[union-attr]
        return DeltaBeta(self.density_g_cm3 * delta, self.density_g_cm3 * beta)


@dataclass(frozen=True)
class Transparent:
    """Matter of known refractive index and no absorption, for light: its δ, `1 - n/n_medium` against its medium."""

    delta: float

    def delta_beta(self, energy_kev: float) -> DeltaBeta:
        """The same at every energy: no dispersion is known."""
        return DeltaBeta(self.delta, 0.0)


Material = Compound | Mixture


def dispersion(
    energy_kev: np.ndarray, reference_kev: float, material: Material | None = None, medium: Material | None = None
) -> np.ndarray:
    """Factors [N, 2] of δ and β at photon energies [N] over those at a reference energy [keV].

    The one rule for matter in frames of several energies. For a `material` (against a `medium`, if there is one) they
    follow from its own δ and β; for matter without a formula, from `scan.far_from_edges`. A factor of what is zero at
    the reference energy is 1.
    """
    if material is None:
        return far_from_edges(energy_kev, reference_kev)

    def contrast(energy: float) -> DeltaBeta:
        inside = material.delta_beta(energy)
        return inside if medium is None else inside.against(medium.delta_beta(energy))

    reference = np.array(contrast(reference_kev))
    found = np.array([contrast(float(energy)) for energy in np.asarray(energy_kev, dtype=np.float64)]).reshape(-1, 2)
    return np.where(reference == 0, 1.0, found / np.where(reference == 0, 1.0, reference))


def solution(solute: Compound, concentration_g_ml: float, solvent: Compound) -> Mixture:
    """`concentration_g_ml` [g per mL of solution] of `solute` in `solvent`, their volumes adding up.

    `InputError` when that concentration exceeds the solute's own density.
    """
    limit = solute.density_g_cm3
    in_range("concentration", concentration_g_ml, 0.0, 0.999999 * limit, unit="g/mL")
    density = concentration_g_ml + (1 - concentration_g_ml / limit) * solvent.density_g_cm3
    fraction = concentration_g_ml / density
    return Mixture(((solute, fraction), (solvent, 1 - fraction)), density)


WATER = Compound("H2O", 0.9982)
"""Water at 20 °C: 0.9982 g/cm³ (Tanaka et al. 2001, Metrologia 38, 301)."""

HAEMOGLOBIN = Compound("C2952H4664N812O832S8Fe4", 1.335)
"""Human haemoglobin tetramer, dry, at one over its partial specific volume in water, 0.749 mL/g
(Svedberg & Pedersen 1940, The Ultracentrifuge): δ/β = 2.8e3 at 20 keV."""

ALBUMIN = Compound("C2936H4624N786O889S41", 1.364)
"""Human serum albumin, dry, at one over its partial specific volume 0.733 mL/g (Hunter 1966, J. Phys. Chem.
70, 3285); stands for all plasma protein."""

PLASMA = Mixture(((WATER, 0.922), (ALBUMIN, 0.070), ("NaCl", 0.006), ("NaHCO3", 0.002)), 1.025)
"""Blood plasma by mass: 7 % protein, and the reference values of chloride (103 mmol/L) and bicarbonate
(24 mmol/L) as sodium salts (Guyton & Hall, Textbook of Medical Physiology); 1.025 g/cm³ at 25 °C, between the
measured 1.0310 at 4 °C and 1.0205 at 37 °C (Trudnowski & Rico 1974, Clin. Chem. 20, 615)."""

RED_CELL = solution(HAEMOGLOBIN, 0.33, WATER)
"""A red cell as a haemoglobin solution of 33 g/dL, the normal mean cell concentration (32 to 36 g/dL).

Against `PLASMA` at 20 keV: Δδ = 2.8e-8 and Δβ = -1.5e-11, negative because plasma's salt absorbs more than
water while haemoglobin absorbs as little. The cell's own ions are left out; its potassium alone (95 mmol per
litre of cells) would add 1.9e-11 to β, so of Δβ only the smallness is certain, not the sign.
"""

SUBSTANCES = Path(__file__).with_name("substances.toml")
"""Tissues, plastics, glasses, liquids and metals, each with its source."""


@dataclass(frozen=True)
class Named:
    """A material with a name. aliases: other names of it; source: where its composition and density are from."""

    name: str
    material: Material
    source: str
    aliases: tuple[str, ...] = ()


@lru_cache(maxsize=1)
def named_materials() -> tuple[Named, ...]:
    """Every material that `parse_material` knows by name: those of this module, then those of `SUBSTANCES`."""
    cells = (
        Named("water", WATER, "Tanaka et al. 2001, at 20 °C"),
        Named("haemoglobin", HAEMOGLOBIN, "dry; Svedberg & Pedersen 1940", ("hemoglobin",)),
        Named("albumin", ALBUMIN, "dry; Hunter 1966"),
        Named("plasma", PLASMA, "blood plasma at 25 °C; Guyton & Hall, Trudnowski & Rico 1974"),
        Named("red cell", RED_CELL, "a solution of 33 g/dL of haemoglobin", ("rbc",)),
    )
    of_file = [
        Named(name, _substance(entry), entry["source"], tuple(entry.get("aliases", ())))
        for name, entry in read_table(SUBSTANCES).items()
    ]
    return (*cells, *of_file)


@lru_cache(maxsize=1)
def _by_name() -> dict[str, Material]:
    """Names and aliases in lower case → material."""
    return {text.lower(): named.material for named in named_materials() for text in (named.name, *named.aliases)}


def _substance(entry: Mapping[str, Any]) -> Material:
    """The material of an entry of `SUBSTANCES`, whose parts may be entries themselves."""
    if "formula" in entry:
        return Compound(entry["formula"], entry["density"])
    table = read_table(SUBSTANCES)
    parts = [(_substance(table[part]) if part in table else part, share) for part, share in entry["fractions"].items()]
    return Mixture(tuple(parts), entry["density"])


def parse_material(text: str, density_g_cm3: float | None = None) -> Material:
    """The material that `text` names ("plasma", any case, `named_materials`) or a formula ("SiO2"), with its density.

    density_g_cm3: [g/cm³]; a named material keeps its own unless one is given, a formula needs one (`InputError`).
    """
    if not isinstance(text, str) or not text.strip():
        raise InputError(f"material must be a chemical formula or {NAMES}, but it is {text!r}.")
    name = text.strip()
    named = _by_name().get(name.lower().replace("_", " "))
    if named is not None:
        return named if density_g_cm3 is None else replace(named, density_g_cm3=density_g_cm3)
    _atoms(name)
    require(
        density_g_cm3 is not None,
        f"material {name!r} is a formula and needs its density in g/cm³; give it, or use {NAMES}.",
    )
    return Compound(name, density_g_cm3)  # type: ignore[arg-type]


def is_named(text: str) -> bool:
    """Whether `text` is the name of a material (`named_materials`), which has its density, and not a formula."""
    return text.strip().lower().replace("_", " ") in _by_name()


def read_material_table(path: str | Path) -> dict[str, Material]:
    """Materials per mesh file, from a JSON or TOML file: {file-name pattern: material}, in the file's order.

    A pattern is a shell glob ("rbc*.vtk"); a material is a name that `parse_material` knows, or a table with `formula`
    (or such a name there) and, for a formula, `density` [g/cm³]. `InputError` names the pattern at fault.
    """
    table = _read_table(Path(path))
    return {pattern: _table_entry(f"{path}: material of {pattern!r}", entry) for pattern, entry in table.items()}


def material_of(
    name: str, table: Mapping[str, Material], default: Material | Transparent | None = None
) -> Material | Transparent:
    """The material of the first pattern in `table` that matches `name`, else `default`.

    name: a mesh's file name, with or without its folder or suffix. `InputError` when there is neither.
    """
    candidates = {name, Path(name).name, Path(name).stem}
    for pattern, material in table.items():
        if any(fnmatchcase(candidate, pattern) for candidate in candidates):
            return material
    if default is None:
        raise InputError(f"mesh {name!r} matches no pattern of the material table ({', '.join(table)}); add one.")
    return default


def _read_table(path: Path) -> dict[str, Any]:
    table = read_table(path)
    require(bool(table), f'{path} must map mesh file names to materials, like {{"cell*.vtk": "red cell"}}.')
    return table


def _table_entry(field: str, entry: Any) -> Material:
    if isinstance(entry, str):
        entry = {"formula": entry}
    if not isinstance(entry, dict) or "formula" not in entry or set(entry) - {"formula", "density"}:
        raise InputError(f"{field} must be a name of a material or {{formula, density}}, but it is {entry!r}.")
    try:
        return parse_material(entry["formula"], entry.get("density"))
    except InputError as error:
        raise InputError(f"{field}: {error}") from None


SECTIONS = {"tube": 2, "cuvette": 2, "slab": 1}
"""Kinds of walls, and how many sections each is said by."""


def wall_of(text: str, energy_kev: float) -> Wall:
    """The wall about the rotation axis that `text` says (`Told.wall`), at an energy [keV].

    Behind FILLING may stand :X:Z:TURN, the place of its middle [m] and its turn [degrees]. A material is a name, or
    DELTA,BETA, or vacuum. Errors: `InputError` for anything else.
    """
    kind, *words = text.split(":")
    count = SECTIONS.get(kind, 0)
    sections = [[number_in(part) for part in word.split("x")] for word in words[:count]]
    place = [number_in(word) for word in words[count + 2 :]]
    good = count and len(words) - count in (2, 5) and all(len(each) <= 2 - (kind == "tube") for each in sections)
    require(
        bool(good) and all(map(math.isfinite, [*chain(*sections), *place])),
        "--wall must be tube:INNER:OUTER:MATERIAL:FILLING, cuvette:INNER:OUTER:MATERIAL:FILLING or "
        "slab:INNER:MATERIAL:FILLING, with FILLING as the --medium (or vacuum) and :X:Z:TURN behind that or not, but "
        f"it is {shown(text)}; write, for instance, tube:4e-5:5e-5:glass:water.",
    )

    def matter_of(word: str) -> tuple[float, float]:
        numbers = [number_in(part) for part in word.split(",")]
        if len(numbers) == 2 and all(map(math.isfinite, numbers)):
            return numbers[0], numbers[1]
        return (0.0, 0.0) if word == "vacuum" else parse_material(word).delta_beta(energy_kev)

    matter, filling = map(matter_of, words[count : count + 2])
    x, z, turn = place or (0.0, 0.0, 0.0)
    inner, outer = [(each[0], each[-1]) for each in sections] + [None] * (2 - count)
    return Wall(inner, outer, matter, filling, kind == "tube", (x, z), math.radians(turn))  # type: ignore[arg-type]


def require_in_wall(text: str, medium: Material | None) -> None:
    """`InputError` where the wall that `text` says (`wall_of`) is filled with another material than the `medium` (None:
    vacuum), to which δ and β of matter are differences. A filling said as DELTA,BETA is taken as that of the medium."""
    kind, *words = text.split(":")
    filling = words[SECTIONS.get(kind, 0) + 1]
    good = "," in filling or (None if filling == "vacuum" else parse_material(filling)) == medium
    require(
        good, f"the FILLING of --wall must be the --medium that matter lies in, but it is {filling}; say both alike."
    )
