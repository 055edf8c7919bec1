"""The scan and the truth of a case, simulated once and kept; and cases of measured frames: few of many views for
training, and filtered back-projection of all for the truth."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from holosplat.baselines.algebraic import filtered_backprojection
from holosplat.beamline.light import EVEN_LIGHT, UnevenLight
from holosplat.beamline.misalignment import AS_PLANNED, Misalignment
from holosplat.checks import InputError, require
from holosplat.geometry import Grid
from holosplat.io.atomic import read_json, write_json
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.reading import Part, Reading, Told
from holosplat.io.samples import fetched, sample
from holosplat.io.volumes import read_volume, write_volume
from holosplat.matter import KnownRatio
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.drawn import ChangingScene, Truth
from holosplat.specimens.scene import MeshScene
from holosplat.units import wavenumber
from holosplat.volume import Volume
from holosplat.workflows.correct import CorrectionOptions, correct
from holosplat.workflows.provenance import scan_hash

from ..declaration import Case
from ..specimens.rods import RodScene

DARKEST = 1e-3
"""Relative intensity below which a pixel counts as so bright: its logarithm has no meaning."""
WITHIN = 0.45
"""Share of the frames' width about the axis within which volumes are compared: beyond it, back-projection of all
views has streaks of what lies outside."""


@dataclass(frozen=True)
class MeasuredCase:
    """Measured frames in contact, of absorption alone.

    name, summary: of the case; sample: the data's name (`holosplat data list`); reading, correction: how raw frames
    become relative ones; every, count: training frames, one in so many and at most so many; prior: the ratio δ/β that
    methods are told, which changes δ and no frame; folder: where the data lie (None: they are fetched). The seed is
    that of the methods.
    """

    name: str
    summary: str
    sample: str
    reading: Reading
    correction: CorrectionOptions
    every: int
    count: int
    prior: KnownRatio
    folder: Path | None = None
    seed: int = 0
    balls: tuple[()] = ()
    photons: None = None
    light: UnevenLight = EVEN_LIGHT
    misalignment: Misalignment = AS_PLANNED

    def scan(self) -> Scan:
        """The corrected frames, those for training marked; `InputError` where the data are not at hand."""
        source, _ = fetched(sample(self.sample), self.folder)
        with TemporaryDirectory() as scratch:
            out = Path(scratch) / "scan.nxs"
            correct(source, out, self.correction, reading=self.reading)
            scan = read_scan(out).in_memory()
        is_test = np.ones(len(scan), dtype=bool)
        is_test[np.arange(0, len(scan), self.every)[: self.count]] = False
        return scan.with_split(is_test)

    def truth(self) -> Volume:
        """β by filtered back-projection of all frames, and the δ that the ratio gives it."""
        return back_projected(self.scan(), self.prior)

    def fingerprint(self) -> str:
        """A short hash (SHA-256) of the data and of what is done with them."""
        said = (self.reading.as_table(), self.correction, self.every, self.count, self.prior.as_dict(), self.seed)
        return hashlib.sha256(repr((sample(self.sample).sha256, said)).encode()).hexdigest()[:16]

    @property
    def specimen(self) -> str:
        """What the data show, and where they come from."""
        known = sample(self.sample)
        words = f"{known.title} ({known.source}; {known.licence}), measured"
        return f"{words}; the truth is filtered back-projection of all views"


def back_projected(scan: Scan, prior: KnownRatio) -> Volume:
    """β by filtered back-projection of all frames of `scan`, and the δ that the ratio gives it."""
    line = 2 * wavenumber(scan.exposures.one_energy("a measured case"))
    lines, grid = -np.log(np.maximum(scan.frames, DARKEST)) / line, Grid.of_views(scan.views)
    beta = filtered_backprojection(torch.from_numpy(lines), scan.views, grid, None, lambda done: None).numpy()
    return Volume(prior.ratio * beta, beta, grid)


def agreement(found: Volume, reference: Volume, rows: slice = slice(None)) -> dict[str, float]:
    """Correlation of β with that of all views, and its slope (least squares through 0), within `WITHIN` of the axis and
    in these rows."""
    x, _, z = reference.grid.axes()
    near = np.hypot(z[:, None], x[None]) < WITHIN * len(x) * reference.grid.voxel_size[0]
    inside = np.broadcast_to(near[:, None], reference.beta.shape)
    a, b = (volume.beta[:, rows][inside[:, rows]].astype(np.float64) for volume in (found, reference))
    return {"correlation": float(np.corrcoef(a, b)[0, 1]), "slope": float(a @ b / (b @ b))}


def _capsule(name: str, summary: str, crop: str | None) -> MeasuredCase:
    told = Told(energy_kev=20.0, distance=0.0, pixel_size=42.92e-6, axis_column=42.625, sense="anticlockwise")
    ratio = KnownRatio(500.0)
    return MeasuredCase(
        name, summary, "capsule", Reading(told, Part(crop=crop)), CorrectionOptions(rings=5), 8, 12, ratio
    )


TOOTH = Reading(Told(energy_kev=20.0, distance=0.0, pixel_size=1e-5, axis_column=147.25, sense="anticlockwise"))
MEASURED = {
    case.name: case
    for case in (
        _capsule("capsule-dome", "the soft dome of a gelatine capsule, 12 of 91 measured views", "0:28,:"),
        _capsule("capsule", "a gelatine capsule with metal, 12 of 91 measured views", None),
        MeasuredCase(
            "tooth",
            "a tooth, 15 of 181 measured views of two rows",
            "tooth",
            TOOTH,
            CorrectionOptions(method="plain"),
            12,
            15,
            KnownRatio(300.0),
        ),
    )
}
"""Name → case."""


def missing_data(names: tuple[str, ...], folder: Path | None) -> dict[str, str]:
    """What cannot be run of the measured cases `names`: name → the sentence that says why."""
    missing = {}
    for name in names:
        try:
            fetched(sample(MEASURED[name].sample), folder)
        except InputError as error:
            missing[name] = str(error)
    return missing


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
        write_json(
            record, {**described(case, scan.exposures, scan.is_test), "fingerprint": mark, "scan_hash": scan_hash(scan)}
        )
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


def _stills(scene: Truth) -> list[Truth]:
    """A scene, or one that changes at its first, middle and last time."""
    return [scene.drawn(share) for share in (0.0, 0.5, 1.0)] if isinstance(scene, ChangingScene) else [scene]


def _matter(scene: Truth) -> list[object]:
    """δ and β of each body, and the profiles of continuous ones."""
    if isinstance(scene, ContinuousScene):
        return [(element.profile, tuple(element.matter)) for element in scene.elements]
    if isinstance(scene, RodScene):
        return [tuple(scene.matter)]
    assert isinstance(scene, MeshScene)
    return [tuple(material) for material in scene.materials]


def _arrays(case: Case) -> Iterable[np.ndarray]:
    for scene in _stills(case.scene):
        if isinstance(scene, ContinuousScene):
            for element in scene.elements:
                yield from (element.centre, element.axes, element.gradient)
        elif isinstance(scene, RodScene):
            yield from (scene.ends, scene.radii)
        elif isinstance(scene, MeshScene):
            for mesh in scene.meshes:
                yield from (mesh.vertices, mesh.faces)
    exposures = case.exposures
    yield from (exposures.views.rotations, exposures.views.shifts)
    yield from (exposures.distance, exposures.psf_sigma_px, exposures.time, np.asarray(case.is_test, dtype=bool))


def described(case: Case | MeasuredCase, exposures: Exposures, is_test: np.ndarray) -> dict[str, Any]:
    """A case in numbers, for the report: how it is measured, and what methods are told."""
    views = exposures.views
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
        "training_frames": int(np.count_nonzero(~is_test)),
        "held_out_frames": int(np.count_nonzero(is_test)),
        "shares_axis": views.shares_axis,
        "photons": case.photons,
        "light": case.light.facts(),
        **({"misalignment": asdict(case.misalignment)} if case.misalignment else {}),
        "prior": case.prior.as_dict(),
    }
