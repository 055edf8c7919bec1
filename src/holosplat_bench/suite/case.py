"""The cases of the benchmark: the files of the suite, and cases by name or from a file of one's own."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np

from holosplat.beamline.declaration import Case, case_of
from holosplat.checks import InputError, require, whole_seed
from holosplat.scan import Exposures

from .declared import declared_names, read_declaration

FOLDER = Path(__file__).with_name("cases")
"""The suite: a TOML file for each case, or for several that differ little."""
ORDER = ("main", "thesis", "cells", "xmpi", "plasma8", "noise12", "crowded12", "sharp_light")
ORDER += ("misaligned", "two_materials8", "shells8", "foam12")
ORDER += ("soft12", "tissue16", "coated", "absorber12", "contact91", "matter")
"""How tables list the files of the suite; others follow by name."""


def case_names() -> list[str]:
    """The names of the suite's cases, in the order in which tables list them."""
    return list(_suite())


def load_case(name: str | Path, seed: int = 0, snapshots: Path | None = None) -> Case:
    """The case called `name` with the scene and the noise of `seed`.

    name: of the suite (`case_names`), or a TOML file like those in `suite/cases`, with `:variant` behind
    it where it declares several; snapshots: folder of simulated red cells, `*_000.vtk` … (µm), which cases that have
    `[with_snapshots]` then show; the others are what they are without. `InputError` says what is wrong with a file, and
    where the scene is larger than the field of view.
    """
    whole_seed("seed", seed)
    path, called = _found(str(name))
    declared = read_declaration(path, called, snapshots is not None)
    try:
        return case_of(declared, called, seed, snapshots)
    except InputError as error:
        raise InputError(f"{path}, case {called}: {error}") from None


def planned_frames(name: str | Path, snapshots: Path | None = None) -> tuple[Exposures, np.ndarray]:
    """The exposures of a case, without its scene, and which of them are held out; arguments and errors as those of
    `load_case`."""
    path, called = _found(str(name))
    return read_declaration(path, called, snapshots is not None).exposures()


def _found(name: str) -> tuple[Path, str]:
    """The file that declares a case, and what the case is called there."""
    if file := re.fullmatch(r"(.*\.toml)(?::([^/\\]+))?", name):
        path = Path(file[1])
        names = declared_names(path)
        choice = ", ".join(f"{path}:{n}" for n in names)
        require(bool(file[2]) or len(names) == 1, f"{path} declares several cases; choose one of {choice}.")
        return path, file[2] or names[0]
    suite = _suite()
    if name not in suite:
        raise InputError(f"case must be one of {', '.join(suite)}, or a TOML file, but it is {name!r}.")
    return suite[name], name


@cache
def _suite() -> dict[str, Path]:
    """The file of every case."""
    files = sorted(
        FOLDER.glob("*.toml"), key=lambda f: (ORDER.index(f.stem) if f.stem in ORDER else len(ORDER), f.stem)
    )
    return {name: path for path in files for name in declared_names(path)}
