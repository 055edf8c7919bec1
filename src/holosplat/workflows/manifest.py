"""The manifest of a run folder: what its files were when the last command that wrote there ended."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..checks import InputError
from ..io.json import read_json, write_json
from ..io.leftovers import files_in
from ..io.provenance import sha256

MANIFEST = "manifest.json"


def write_manifest(folder: Path, run: str) -> None:
    """Write the SHA-256 and size of each file in `folder`, and the name of the run that they are of."""
    files = {name: {"bytes": path.stat().st_size, "sha256": sha256(path)} for name, path in _files(folder)}
    write_json(folder / MANIFEST, {"run": run, "files": files})


def faults(folder: Path, run: str) -> list[str]:
    """What is not as the manifest of `folder` says, a sentence each; none where all is."""
    path = folder / MANIFEST
    if not path.is_file():
        return [f"{path} is not there: the run was cut off, or is of an older version"]
    try:
        table = read_json(path)
        said: dict[str, Any] = dict(table["files"])
        expected = {name: (int(one["bytes"]), str(one["sha256"])) for name, one in said.items()}
    except (InputError, KeyError, TypeError, ValueError):
        return [f"{path} is damaged"]
    found = dict(_files(folder))
    wrong = [] if table.get("run") == run else [f"{path} is of another run than config.json"]
    wrong += [f"{folder / name} is missing" for name in expected if name not in found]
    wrong += [f"{path} does not know of {folder / name}" for name in found if name not in expected]
    for name, (size, digest) in expected.items():
        if name in found and (found[name].stat().st_size != size or sha256(found[name]) != digest):
            wrong.append(f"{folder / name} is not what was written")
    return wrong


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Names below `folder` and paths of its files, but for hidden ones and the manifest, in order."""
    for path in files_in(folder):
        if (relative := str(path.relative_to(folder))) != MANIFEST:
            yield relative, path
