"""Refractive indices against closed forms and published values, and what is said about bad input."""

from __future__ import annotations

import math

import pytest
import xraydb

from holosplat.checks import InputError
from holosplat.materials import (
    HAEMOGLOBIN,
    PLASMA,
    RED_CELL,
    WATER,
    Compound,
    DeltaBeta,
    Mixture,
    material_of,
    named_materials,
    parse_material,
    read_material_table,
    solution,
)
from holosplat.units import wavelength

ELECTRON_RADIUS = 2.8179403205e-15
AVOGADRO = 6.02214076e23


def near(value, rel=1e-6, abs=0.0):
    """pytest.approx without its absolute tolerance of 1e-12, which is more than most numbers here."""
    return pytest.approx(tuple(value) if isinstance(value, tuple) else value, rel=rel, abs=abs)


def free_electron_delta(electrons_per_gram: float, density_g_cm3: float, energy_kev: float) -> float:
    """δ = r_e λ² ρ_e / 2π far above all absorption edges (Als-Nielsen & McMorrow 2011, eq. 3.2)."""
    electrons_per_m3 = electrons_per_gram * density_g_cm3 * 1e6
    return ELECTRON_RADIUS * wavelength(energy_kev) ** 2 * electrons_per_m3 / (2 * math.pi)


@pytest.mark.parametrize("energy", [15.0, 20.0, 40.0])
def test_delta_of_light_matter_is_that_of_free_electrons(energy):
    water = free_electron_delta(10 / 18.01528 * AVOGADRO, 0.9982, energy)
    assert WATER.delta_beta(energy).delta == near(water, rel=3e-3)
    polystyrene = free_electron_delta(56 / 104.15 * AVOGADRO, 1.05, energy)
    assert Compound("C8H8", 1.05).delta_beta(energy).delta == near(polystyrene, rel=3e-3)


def test_published_values():
    assert Compound("H2O", 1.0).delta_beta(20).delta == near(5.76e-7, rel=2e-3)
    # Water at 20 keV: photoelectric 0.544 cm²/g (Berger et al., XCOM, NIST); β = μλ/4π.
    beta = 54.4 * wavelength(20) / (4 * math.pi)
    assert Compound("H2O", 1.0).delta_beta(20).beta == near(beta, rel=0.06)
    # Silicon for Cu Kα: δ = 7.6e-6, μ = 141/cm (Als-Nielsen & McMorrow 2011; International Tables C).
    silicon = Compound("Si", 2.33).delta_beta(8.048)
    assert silicon.delta == near(7.6e-6, rel=0.01)
    assert silicon.beta == near(1.41e4 * wavelength(8.048) / (4 * math.pi), rel=0.05)


def test_haemoglobin_and_red_cells_at_20_kev():
    assert HAEMOGLOBIN.delta_beta(20).ratio == near(2800, rel=0.01)
    difference = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))
    assert difference.delta == near(2.7e-8, rel=0.05)
    assert difference.beta == near(-1.5e-11, rel=0.1)


def test_beta_is_photoabsorption_alone():
    """With Elam's tables: scattering would lower δ/β of haemoglobin from 2683 (2800 by Chantler's) to 1694."""
    delta = HAEMOGLOBIN.delta_beta(20).delta
    for kind, ratio in (("photo", 2683), ("total", 1694)):
        mu = 100 * xraydb.material_mu(HAEMOGLOBIN.formula, 20e3, HAEMOGLOBIN.density_g_cm3, kind)
        assert delta / (mu * wavelength(20.0) / (4 * math.pi)) == near(ratio, rel=1e-3)


def test_delta_beta_differences_and_ratios():
    cell, medium = DeltaBeta(6.2e-7, 2.5e-10), DeltaBeta(5.9e-7, 2.7e-10)
    assert cell.against(medium) == near((3e-8, -2e-11))
    assert cell.against(medium).ratio == near(-1500)
    assert DeltaBeta(1e-7, 0.0).ratio == math.inf
    assert DeltaBeta(-1e-7, 0.0).ratio == -math.inf
    assert math.isnan(DeltaBeta(0.0, 0.0).ratio)


def test_delta_and_beta_are_proportional_to_density():
    thin, dense = (Compound("SiO2", rho).delta_beta(12) for rho in (1.1, 2.2))
    assert dense == near((2 * thin.delta, 2 * thin.beta))


def test_mixture_weights_by_mass_and_ignores_its_parts_densities():
    assert Mixture((("H2O", 1.0),), 0.9982).delta_beta(20) == near(WATER.delta_beta(20))
    # Water as 11.19 % hydrogen and 88.81 % oxygen by mass.
    hydrogen = 2 * 1.00794 / (2 * 1.00794 + 15.9994)
    elements = Mixture((("H", hydrogen), (Compound("O", 7.0), 1 - hydrogen)), 0.9982)
    assert elements.delta_beta(20) == near(WATER.delta_beta(20), rel=1e-4)
    nested = Mixture(((PLASMA, 0.5), (Mixture((("H2O", 1.0),), 3.0), 0.5)), 1.0).delta_beta(20)
    halves = (PLASMA.delta_beta(20).delta / 1.025 + WATER.delta_beta(20).delta / 0.9982) / 2
    assert nested.delta == near(halves)


def test_solution_adds_volumes():
    mixed = solution(HAEMOGLOBIN, 0.33, WATER)
    assert mixed.density_g_cm3 == near(0.33 + (1 - 0.33 / 1.335) * 0.9982)
    by_volume = 0.33 / 1.335 * HAEMOGLOBIN.delta_beta(20).delta + (1 - 0.33 / 1.335) * WATER.delta_beta(20).delta
    assert mixed.delta_beta(20).delta == near(by_volume)


def test_parse_material_knows_presets_in_any_case_and_formulas():
    assert parse_material("Haemoglobin") is HAEMOGLOBIN
    assert parse_material("HEMOGLOBIN") is HAEMOGLOBIN
    assert parse_material(" plasma ") is PLASMA
    assert parse_material("RBC") is RED_CELL
    assert parse_material("water", 1.2) == Compound("H2O", 1.2)
    assert parse_material("plasma", 1.0).delta_beta(20).delta < PLASMA.delta_beta(20).delta
    assert parse_material("SiO2", 2.2) == Compound("SiO2", 2.2)


def test_every_name_is_a_material_with_a_source():
    names = [text.lower() for named in named_materials() for text in (named.name, *named.aliases)]
    assert len(names) == len(set(names)) > 50
    for named in named_materials():
        assert parse_material(named.name.upper()) is named.material
        assert all(parse_material(alias) is named.material for alias in named.aliases)
        assert named.source
        found = named.material.delta_beta(20.0)
        assert found.delta > 1e-10
        assert 0 < found.beta < found.delta
    assert parse_material("soft_tissue") is parse_material("soft tissue")
    assert parse_material("soft tissue", 1.0).density_g_cm3 == 1.0


@pytest.mark.parametrize(
    ("name", "electrons", "attenuation"),
    [
        ("soft tissue", 0.54996, 0.8230),
        ("muscle", 0.54938, 0.8205),
        ("adipose tissue", 0.55579, 0.5677),
        ("cortical bone", 0.51478, 4.001),
        ("blood", 0.54999, 0.8428),
        ("brain", 0.55239, 0.8098),
        ("PMMA", 0.53937, 0.5714),
        ("polystyrene", 0.53768, 0.4363),
        ("PTFE", 0.47992, 0.9847),
    ],
)
def test_tissues_and_plastics_have_their_tabulated_numbers(name, electrons, attenuation):
    """Electrons per nucleon Z/A and total attenuation at 20 keV [cm²/g] of Hubbell & Seltzer (NIST 126).

    β holds photoabsorption alone; scattering is 0.17 to 0.41 cm²/g there.
    """
    material = parse_material(name)
    delta, beta = material.delta_beta(20.0)
    free = free_electron_delta(electrons * AVOGADRO, material.density_g_cm3, 20.0)
    assert delta == near(free, rel=4e-3)
    absorbed = 4 * math.pi * beta / wavelength(20.0) / 100 / material.density_g_cm3
    assert 0.15 < attenuation - absorbed < 0.45


@pytest.mark.parametrize(
    ("text", "density", "said"),
    [
        ("unobtainium", 1.0, "formula"),
        ("sio2", 2.2, "capitals"),
        ("H2O)", 1.0, "formula"),
        ("H0", 1.0, "formula"),
        ("Cf", 15.0, "uranium"),
        ("", 1.0, "formula"),
        (None, 1.0, "formula"),
        ("SiO2", None, "density"),
        ("SiO2", 0, "positive"),
        ("SiO2", -2.2, "positive"),
        ("SiO2", 2200, "between"),
        ("SiO2", math.nan, "positive"),
        ("SiO2", "heavy", "number"),
        ("water", -1.0, "density of H2O"),
        ("plasma", 1025.0, "density of the mixture"),
    ],
)
def test_parse_material_says_what_is_wrong(text, density, said):
    with pytest.raises(InputError, match=said):
        parse_material(text, density)


@pytest.mark.parametrize("energy", [0, -20, 20e3, math.nan, 0.01])
def test_energy_out_of_range(energy):
    with pytest.raises(InputError, match="energy"):
        WATER.delta_beta(energy)


@pytest.mark.parametrize(
    ("components", "said"),
    [
        ((("H2O", 0.5), ("NaCl", 0.4)), "add up to 1"),
        ((("H2O", 1.1), ("NaCl", -0.1)), "mass fraction"),
        ((("H2O", 1.0), ("NaCl", 0.0)), "mass fraction"),
        ((("H2O",),), "pairs"),
        ((("H2o", 1.0),), "formula"),
        ((), "add up to 1"),
    ],
)
def test_mixture_says_what_is_wrong(components, said):
    with pytest.raises(InputError, match=said):
        Mixture(components, 1.0)


def test_solution_cannot_be_denser_than_its_solute():
    with pytest.raises(InputError, match="concentration"):
        solution(HAEMOGLOBIN, 1.4, WATER)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.json", '{"rbc0*": {"formula": "SiO2", "density": 2.2}, "rbc*.vtk": "red cell", "*": "water"}'),
        ("t.toml", '"rbc0*" = {formula = "SiO2", density = 2.2}\n"rbc*.vtk" = "red cell"\n"*" = "water"\n'),
    ],
)
def test_material_table_takes_the_first_match(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    table = read_material_table(tmp_path / name)
    assert material_of("rbc01.vtk", table) == Compound("SiO2", 2.2)
    assert material_of("some/folder/rbc11.vtk", table) is RED_CELL
    assert material_of("wall.vtp", table) is WATER


def test_material_of_falls_back_or_says_so():
    table = {"rbc*": RED_CELL}
    assert material_of("wall.vtk", table, WATER) is WATER
    with pytest.raises(InputError, match=r"wall\.vtk.*rbc\*"):
        material_of("wall.vtk", table)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("t.json", "{not json", "valid JSON"),
        ("t.toml", "a = = 1", "valid TOML"),
        ("t.json", "[1, 2]", "must hold a table, but it holds list"),
        ("t.json", "{}", "map mesh file names"),
        ("t.json", '{"rbc*": 3}', r"rbc\*"),
        ("t.json", '{"rbc*": {"density": 3}}', r"rbc\*"),
        ("t.json", '{"rbc*": {"formula": "SiO2", "densty": 3}}', "densty"),
        ("t.json", '{"rbc*": {"formula": "SiO2"}}', r"rbc\*.*density"),
        ("t.json", '{"rbc*": {"formula": "SiO2", "density": "x"}}', r"rbc\*.*number"),
    ],
)
def test_material_table_says_what_is_wrong(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said) as error:
        read_material_table(tmp_path / name)
    assert name in str(error.value)


def test_material_table_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        read_material_table(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        *(
            (text, "CaSO6H4")
            for text in ("CaSO4.2H2O", "CaSO4 2H2O", "CaSO4·2H2O", "CaSO4*2H2O", "CaSO4 . 2 H2O", "CaSO4.2(H2O)")
        ),
        *((f"CaSO4{half}H2O", "CaSO4.5H") for half in (".0.5", "·0.5", " · 0.5 ", " 0.5", "·½", "×½")),
        *(("Na2CO3.10H2O", "Na2CO13H20"), ("Cu(NO3)2.3H2O", "CuN2O9H6")),
        *(("MgSO4.7H2O.NaCl", "MgSO11H14NaCl"), ("CaSO₄·2H₂O", "CaSO6H4")),
        *(("NaCl.KCl", "NaCl2K"), ("YBa2Cu3O6.9", "YBa2Cu3O6.9"), ("Ba0.5Sr0.5TiO3", "BaSrTi2O6")),
    ],
)
def test_hydrates_and_decimals_are_told_apart(written, meant):
    assert Compound(written, 2.3).delta_beta(20) == near(Compound(meant, 2.3).delta_beta(20))


def test_water_with_the_digit_zero_is_refused():
    with pytest.raises(InputError, match=r"CaSO4\.2H20"):
        Compound("CaSO4.2H20", 2.3)
    assert Compound("C10H20", 0.8).delta_beta(20).delta > 0


@pytest.mark.parametrize(
    ("isotope", "plain", "masses"),
    [
        *(
            ("D2O", "H2O", (18.0153, 20.0276)),
            ("T2O", "H2O", (18.0153, 22.0315)),
            ("[2H]2O", "H2O", (18.0153, 20.0276)),
        ),
        *(
            ("C2D6O", "C2H6O", (46.069, 52.106)),
            ("[13C]H4", "CH4", (16.043, 17.03)),
            ("[10B]4C", "B4C", (55.255, 52.06)),
        ),
        ("MgSO4.7D2O", "MgSO11H14", (246.47, 260.55)),
    ],
)
def test_isotopes_weigh_what_they_weigh(isotope, plain, masses):
    """As many electrons a molecule, and heavier molecules."""
    wanted = Compound(plain, 1.1).delta_beta(20).delta * masses[0] / masses[1]
    assert Compound(isotope, 1.1).delta_beta(20).delta == near(wanted, rel=1e-3)


@pytest.mark.parametrize("formula", ["10B4C", "2H2O", "H 2O", "CaSO4..2H2O", "[13X]2", "Lr"])
def test_formulas_that_may_mean_something_else_are_refused(formula):
    with pytest.raises(InputError, match="must be a chemical formula"):
        Compound(formula, 1.0)
