"""Time series of mesh files: ParaView's collection (.pvd), an XML list of files with the time of each.

ParaView opens only VTK's XML files from a collection, such as .vtp and .vtu, and no legacy .vtk; `read_pvd` takes both.
"""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from ..checks import InputError, require, require_regular
from ..tables import number_in
from .atomic import atomic_path


@dataclass(frozen=True)
class TimeStep:
    """The files, one a body, of one instant `time` [s]."""

    time: float
    files: tuple[Path, ...]


def write_pvd(path: str | Path, steps: Sequence[TimeStep]) -> None:
    """Write the collection `path` of `steps`; files are named relative to its folder, so that it can move with them.

    `InputError` for a time that is not finite, and for legacy files.
    """
    folder = Path(path).resolve().parent
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <!-- timestep in seconds -->"]
    lines.append("  <Collection>")
    for step in steps:
        require(math.isfinite(step.time), f"{path}: times must be finite, but one is {step.time}; correct it.")
        for part, file in enumerate(step.files):
            legacy = Path(file).suffix.lower() == ".vtk"
            require(
                not legacy, f"{path} must name XML files (.vtp, .vtu), but {file} is a legacy one; write it as .vtp."
            )
            name = quoteattr(Path(os.path.relpath(Path(file).resolve(), folder)).as_posix())
            lines.append(f'    <DataSet timestep="{step.time!r}" part="{part}" file={name}/>')
    lines += ["  </Collection>", "</VTKFile>", ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def read_pvd(path: str | Path) -> list[TimeStep]:
    """The instants of a collection in the order of time, the files of each in the order of their parts.

    `InputError` where the file is missing, is no collection, names no files or files that do not exist, or has no time
    for one.
    """
    require_regular(path, "a ParaView collection (.pvd)")
    try:
        root = ElementTree.fromstring(Path(path).read_bytes())
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path} must be a readable ParaView collection (.pvd), but it is not: {error}.") from None
    require(root.tag == "VTKFile", f"{path} must be a ParaView collection (.pvd), but it holds {root.tag}.")
    found: dict[float, list[tuple[int, Path]]] = {}
    for entry in root.iterfind("./Collection/DataSet"):
        file = Path(path).parent / entry.get("file", "")
        require(file.is_file(), f"{path} names {entry.get('file')!r}, but there is no such file; check the folder.")
        time, part = _number(path, entry, "timestep", "nan"), _number(path, entry, "part", "0")
        found.setdefault(time, []).append((int(part), file))
    require(len(found) > 0, f"{path} must name at least one file, but it names none; write it anew.")
    return [TimeStep(time, tuple(file for _, file in sorted(files))) for time, files in sorted(found.items())]


def _number(path: str | Path, entry: ElementTree.Element, name: str, default: str) -> float:
    number = number_in(entry.get(name, default))
    require(
        math.isfinite(number),
        f"{path}: {name} of {entry.get('file')!r} must be a number, but it is {entry.get(name)!r}; write it anew.",
    )
    return number
