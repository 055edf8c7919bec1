"""`holosplat materials`: the materials that have a name, with their δ and β."""

from __future__ import annotations

from tyro.conf import Positional


def materials(names: Positional[tuple[str, ...]] = (), energy_kev: float = 20.0) -> None:
    """List the materials that have a name, with density, δ, β and δ/β; formulas need a density instead.

    Args:
        names: Only those whose name has one of these texts in it (default: all).
        energy_kev: Photon energy [keV].
    """
    from ..checks import require
    from ..materials import named_materials

    wanted = [text.lower() for text in names]
    found = [
        named
        for named in named_materials()
        if not wanted or any(text in name.lower() for text in wanted for name in (named.name, *named.aliases))
    ]
    require(
        len(found) > 0,
        f"names must be part of the name of a material, but {', '.join(names)} is in none; give none to see all.",
    )
    print(f"{'name':34} {'g/cm³':>8} {'δ':>11} {'β':>11} {'δ/β':>7}  source  (at {energy_kev:g} keV)")
    for named in found:
        delta, beta = (matter := named.material.delta_beta(energy_kev))
        name = ", ".join((named.name, *named.aliases))
        density = named.material.density_g_cm3
        print(f"{name:34} {density:8.4g} {delta:11.4e} {beta:11.4e} {matter.ratio:7.0f}  {named.source}")
