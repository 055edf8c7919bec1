"""δ/β of the thesis' matter by tables and by what counts as absorption: docs/data/delta_beta.csv.

    python benchmarks/delta_beta.py

Chantler's (1995, 2000) and Elam's (2002) tables are those of `xraydb`, Henke's (1993) those of `periodictable`, which
the extra `bench` installs. δ is that of the same table (of Chantler's for Elam's, which have no f1). "Total" adds to
photoabsorption what is scattered out of the beam, coherently or not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import xraydb
from machine import commit
from rows import written

from holosplat.materials import HAEMOGLOBIN, WATER

OUT = Path(__file__).resolve().parents[1] / "docs" / "data" / "delta_beta.csv"
ENERGY_KEV = 20.0
KEV_M = 12.398419843e-10
"""h c [keV m]."""
COLUMNS = ("material", "table", "absorption", "energy_kev", "delta", "beta", "ratio", "versions", "commit")


def rows() -> Iterator[tuple[str, str, str, float, float]]:
    """Material, table, what counts as absorption, δ and β."""
    for name, material in (("haemoglobin", HAEMOGLOBIN), ("water", WATER)):
        formula, density = material.formula, material.density_g_cm3
        delta, beta, _ = xraydb.xray_delta_beta(formula, density, 1e3 * ENERGY_KEV)
        yield name, "Chantler", "photoabsorption", delta, beta
        for kind, said in (("photo", "photoabsorption"), ("total", "total")):
            mu_per_m = 100 * xraydb.material_mu(formula, 1e3 * ENERGY_KEV, density=density, kind=kind)
            yield name, "Elam", said, delta, float(mu_per_m) * KEV_M / ENERGY_KEV / (4 * math.pi)
        yield name, "Henke", "photoabsorption", *henke(formula, density)


def henke(formula: str, density: float) -> tuple[float, float]:
    """δ and β by Henke's tables; `SystemExit` with a sentence where `periodictable` is not installed."""
    try:
        from periodictable import xsf
    except ImportError:
        raise SystemExit("Henke's tables need periodictable: pip install periodictable.") from None
    index = complex(xsf.index_of_refraction(formula, density=density, energy=ENERGY_KEV))
    return 1 - index.real, abs(index.imag)


def main() -> None:
    """Write the table."""
    versions = " ".join(f"{name} {version(name)}" for name in ("xraydb", "periodictable"))
    found = [
        (*about, ENERGY_KEV, f"{delta:.5g}", f"{beta:.5g}", f"{delta / beta:.5g}", versions, commit())
        for *about, delta, beta in rows()
    ]
    written(OUT, COLUMNS, (dict(zip(COLUMNS, row)) for row in found))


if __name__ == "__main__":
    main()
