"""The scan and the truth of a case, simulated once and kept."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from holosplat.beamline.declared.declaration import Case
from holosplat.checks import require
from holosplat.io.json import read_json, write_json
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.volumes import read_volume, write_volume
from holosplat.scan import Scan
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.drawn import ChangingScene, Scene, Still
from holosplat.specimens.rods import RodScene
from holosplat.volume import Volume
from holosplat.workflows.provenance import scan_hash

from .measured import MeasuredCase


def prepared(case: Case | MeasuredCase, folder: Path) -> tuple[Scan, Volume]:
    """The scan and the true volume of `case`: those in `folder`, or else simulated, or corrected, and written there.

    `InputError` if the folder holds another case of that name, or frames that were changed. What is returned was
    read from the files in either way, so that a benchmark that goes on sees the same bytes as one that begins.
    """
    record, scan_file, truth_file = (folder / name for name in ("case.json", "scan.nxs", "truth.h5"))
    mark = case.fingerprint() if isinstance(case, MeasuredCase) else fingerprint(case)
    if record.is_file():
        require(
            read_json(record).get("fingerprint") == mark,
            f"{folder} holds an earlier {case.name} of seed {case.seed}, other than the present one; "
            "choose another --out, as their rows cannot be compared.",
        )
    else:
        folder.mkdir(exist_ok=True)
        write_scan(scan_file, case.scan())
        write_volume(truth_file, case.truth())
    scan, truth = read_scan(scan_file), read_volume(truth_file)
    if not record.is_file():  # last, so that a folder with it is complete
        facts = case.described(scan) if isinstance(case, MeasuredCase) else described(case)
        write_json(record, {**facts, "fingerprint": mark, "scan_hash": scan_hash(scan)})
    whole = read_json(record).get("scan_hash") == scan_hash(scan)
    require(whole, f"{scan_file} is not the scan that was simulated, its frames were changed; choose another --out.")
    return scan, truth


def fingerprint(case: Case) -> str:
    """A short hash (SHA-256) of a case: scene, exposures, split, photons, and what methods are told."""
    exposures, views = case.exposures, case.exposures.views
    digest = hashlib.sha256()
    for array in _arrays(case):
        digest.update(np.ascontiguousarray(array).tobytes())
    energy = exposures.one_energy("a case of the benchmark")
    numbers = (views.shape, views.pixel_size, energy, case.photons, case.prior.as_dict(), case.seed)
    digest.update(repr((numbers, [each for still in _stills(case.scene) for each in _matter(still)])).encode())
    if not case.light.is_even:
        digest.update(repr(case.light).encode())
    if case.misalignment:
        digest.update(repr(case.misalignment).encode())
    return digest.hexdigest()[:16]


def _stills(scene: Scene) -> list[Still]:
    """A scene, or one that changes at its first, middle and last time."""
    return [scene.drawn(share) for share in (0.0, 0.5, 1.0)] if isinstance(scene, ChangingScene) else [scene]


def _matter(scene: Still) -> list[object]:
    """δ and β of each body, and the profiles of continuous ones."""
    if isinstance(scene, ContinuousScene):
        return [(element.profile, tuple(element.matter)) for element in scene.elements]
    if isinstance(scene, RodScene):
        return [tuple(scene.matter)]
    return [tuple(material) for material in scene.materials]


def _arrays(case: Case) -> Iterable[np.ndarray]:
    for scene in _stills(case.scene):
        if isinstance(scene, ContinuousScene):
            for element in scene.elements:
                yield from (element.centre, element.axes, element.gradient)
        elif isinstance(scene, RodScene):
            yield from (scene.ends, scene.radii)
        else:
            for mesh in scene.meshes:
                yield from (mesh.vertices, mesh.faces)
    exposures = case.exposures
    yield from (exposures.views.rotations, exposures.views.shifts)
    yield from (exposures.distance, exposures.psf_sigma_px, exposures.time, np.asarray(case.is_test, dtype=bool))


def described(case: Case) -> dict[str, Any]:
    """A case in numbers, for the report: how it is measured, and what methods are told."""
    exposures, views = case.exposures, case.exposures.views
    return {
        "case": case.name,
        "seed": case.seed,
        "summary": case.summary,
        "specimen": case.specimen,
        "detector": list(views.shape),
        "pixel_size_m": views.pixel_size,
        "energy_kev": exposures.one_energy("a case of the benchmark"),
        "distance_m": [float(exposures.distance.min()), float(exposures.distance.max())],
        "psf_sigma_px": [float(exposures.psf_sigma_px.min()), float(exposures.psf_sigma_px.max())],
        "training_frames": int(np.count_nonzero(~np.asarray(case.is_test))),
        "held_out_frames": int(np.count_nonzero(case.is_test)),
        "shares_axis": views.shares_axis,
        "photons": case.photons,
        "light": case.light.facts(),
        **({"misalignment": asdict(case.misalignment)} if case.misalignment else {}),
        "prior": case.prior.as_dict(),
    }
