"""Where a result comes from: a fingerprint of its scan, versions and machine."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

import numpy as np
import torch

from ..backends import device_name
from ..scan import Exposures, Scan
from ..version import __version__


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
    return digest.hexdigest()[:16]


def _energies(exposures: Exposures) -> float | list[float]:
    """The frames' energies [keV]; one number if they are the same, as all scans had before."""
    energies = exposures.energy_kev.tolist()
    return energies[0] if exposures.has_one_energy else energies


def environment(backend: str) -> dict[str, dict[str, str]]:
    """Versions and machine, for config.json; `backend` is the one that fits."""
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
