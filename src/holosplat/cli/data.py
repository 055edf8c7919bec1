"""The commands `info`, `data`, `materials`, `check` and `doctor`: files, samples, materials, checksums, versions."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from ..checks import InputError, require
from ..io.reading import Reading
from ..units import number_of
from ..workflows.run_folder import check as look
from .places import Output, with_checked_arguments
from .sentence import say


def _list() -> None:
    """List the sample data: name, what it is, source, licence, and what is known of it."""
    from ..io.samples import samples

    for name, sample in samples().items():
        how = f"{sample.bytes / 1e6:.1f} MB" if sample.url else f"{sample.bytes / 1e6:.1f} MB, only --from a folder"
        print(f"{name}: {sample.title} ({how})")
        print(f"  source: {sample.source}; licence: {sample.licence}\n  {sample.facts}")


def _fetch(name: Positional[str], folder: Annotated[Path | None, arg(name="from")] = None) -> None:
    """Fetch sample data into the cache, and print its path with the options that say what is known of it.

    What is printed goes into a command as it is: holosplat reconstruct $(holosplat data fetch NAME).

    Args:
        name: Name of the data, as `holosplat data list` has it.
        folder: A folder that has the file already; nothing is then fetched.
    """
    from ..io.samples import fetched, sample

    wanted = sample(name)
    path, options = fetched(wanted, folder)
    words = name if folder is None else f"{name} --from {shlex.quote(str(folder))}"
    again = f"$(holosplat data fetch {words})"
    say(f"{wanted.facts}\ngo on: {wanted.next.format(data=again)}")
    print(path, *options)


def data(
    act: Annotated[
        Annotated[None, subcommand("list", constructor=with_checked_arguments(_list))]
        | Annotated[None, subcommand("fetch", constructor=with_checked_arguments(_fetch))],
        arg(name=""),
    ],
) -> None:
    """Sample data of other people: list it, or fetch one into the cache (list, fetch NAME)."""


def materials(names: Positional[tuple[str, ...]] = (), energy_kev: float = 20.0) -> None:
    """List the materials that have a name, with density, δ, β and δ/β; formulas need a density instead.

    Args:
        names: Only those whose name has one of these texts in it (default: all).
        energy_kev: Photon energy [keV].
    """
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


def check(path: Positional[Path]) -> None:
    """Say whether a run folder or an HDF5 file is as it was written, by manifest and checksums.

    Args:
        path: Run folder, another folder with HDF5 files, or one such file.
    """
    count, wrong = look(path)
    if wrong:
        raise InputError("; ".join(each.rstrip(".") for each in wrong) + ".")
    print(f"{path} is as it was written: {number_of(count, 'HDF5 file')} read to the end")


def info(path: Positional[Path], picture: Output | None = None, reading: Reading = Reading()) -> None:
    """Say what a file or a run is: shape, beam, angles, air, noise, fringes, what is missing, and what it takes.

    A few frames are read, and no more. What is missing is said with the option that gives it.

    Args:
        path: Scan of any format, volume, mesh, object or run folder.
        picture: PNG file to write: two frames with a scale bar, and their power spectrum with fringes.
    """
    from ..report.info import info as described

    print("\n".join(described(path, reading, picture).lines()))


def doctor() -> None:
    """Look at the installation: versions, kernels, threads, memory, disk, and a small run with its error.

    Exits with 1 where something is wrong, after it has said what to do.
    """
    from ..workflows.doctor import checks

    wrong = 0
    for check in checks():
        print(check.line(), flush=True)
        wrong += bool(check.remedy)
    print("all is well" if not wrong else f"{wrong} of these are wrong; what to do stands below each")
    if wrong:
        raise SystemExit(1)
