"""Where a result comes from: the fingerprint of its scan, versions, machine; and which files belong to one run."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import InputError, require
from ..io.atomic import read_json, write_json
from ..io.lock import files_in
from ..io.provenance import sha256
from ..version import __version__

if TYPE_CHECKING:  # the command line names files of runs before it loads PyTorch
    from ..scan import Exposures, Scan


def scan_hash(scan: Scan) -> str:
    """A short fingerprint (SHA-256) of the frames and how they were taken."""
    digest = hashlib.sha256()
    exposures = scan.exposures
    for block in scan.blocks():
        digest.update(np.ascontiguousarray(block).tobytes())
    parts = (
        scan.is_test,
        scan.views.rotations,
        scan.views.shifts,
        exposures.distance,
        exposures.psf_sigma_px,
        exposures.time,
    )
    for array in parts:
        digest.update(np.ascontiguousarray(array).tobytes())
    views = scan.views
    pixels = views.pixel_size if views.has_one_pixel else views.pixel_sizes.tolist()
    digest.update(repr((pixels, _energies(exposures))).encode())
    if np.any(exposures.bandwidth):
        digest.update(np.ascontiguousarray(exposures.bandwidth).tobytes())
    return digest.hexdigest()[:16]


def _energies(exposures: Exposures) -> float | list[float]:
    """The frames' energies [keV]; one number if they are the same, as all scans had before."""
    energies = exposures.energy_kev.tolist()
    return energies[0] if exposures.has_one_energy else energies


def environment(backend: str) -> dict[str, dict[str, str]]:
    """Versions and machine, for config.json; `backend` is the one that fits."""
    import torch

    from ..backends import device_name

    return {
        "versions": {
            "holosplat": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
        "machine": {
            "system": platform.platform(),
            "processor": _processor(),
            "threads": f"{torch.get_num_threads()} of {os.cpu_count()} cores",
            "backend": backend,
            "device": device_name(backend),
        },
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


RUN, CONFIG_SUM = "run", "config_sha256"
"""Entries, or attributes, by which a file says of which run it is, and of which `config_sum`."""

RESUMED_WITH = {
    "scan_hash": "scan file",
    "method": "method and settings (--method, --preset, --config, --set, or the options of track)",
    "prior": "material (--material, --delta-beta)",
    "matter": "kind of matter (--matter)",
    "seed": "seed (--seed)",
    "light": "light (--light, --air)",
    "uncertain": "ranges (--distance, --energy-kev, --delta-beta)",
    "refine": "refinement (--refine, --uncertain-…)",
}
"""What must not change between the parts of a run, as messages call it."""


def config_sum(config: Mapping[str, Any]) -> str:
    """The SHA-256 of what a run was started with: the entries `RESUMED_WITH` of config.json, as JSON with sorted names
    and without spaces."""
    bound = {name: config.get(name) for name in RESUMED_WITH}
    return hashlib.sha256(json.dumps(bound, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def require_bound(path: Path, said: Mapping[str, Any], marks: Mapping[str, str], config: Path) -> None:
    """`InputError` if the file `path` says that it is of another run, or of other settings, than the `marks` of the run
    in the file `config`. What says nothing, as files of older versions do, passes."""
    require(
        str(said.get(RUN, marks[RUN])) == marks[RUN],
        f"{path} must be of the run in {config}, but it is of another one; bring back its own, or start anew.",
    )
    require(
        str(said.get(CONFIG_SUM, marks[CONFIG_SUM])) == marks[CONFIG_SUM],
        f"{path} must be of a run with the settings in {config}, but it was written with others; bring back the "
        f"{config.name} of that run, or start anew.",
    )


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
