"""Cases × methods × seeds, one row each; what is there already is kept."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from holosplat.align.held_out import place_frames
from holosplat.align.poses import PoseOptions
from holosplat.backends import resolve
from holosplat.checks import InputError, reason_of, require
from holosplat.metrics import resolution
from holosplat.optics.sampling import fringe_sampling
from holosplat.progress import Progress
from holosplat.representations import (
    MovingSurfaces,
    Stored,
    SurfaceMesh,
    VoxelGrid,
)
from holosplat.scan import Scan
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene
from holosplat.version import source_commit
from holosplat.volume import Object, Volume
from holosplat.workflows.evaluate import Scores, score_object
from holosplat.workflows.provenance import environment, scan_hash

from ..declaration import Case
from ..opponents.fields import NeuralField, PixelAlignedField
from .arena.contest import status_bytes
from .folder import BenchFolder, Row, good_name
from .methods import Aligner, BenchMethod, Reference
from .pictures import TRUTH, Arrays, method_picture, truth_picture
from .prepare import MeasuredCase, agreement, prepared

Name = TypeVar("Name", bound=str)
BLURS = (3.0, 1.0)
"""Gaussian blurs of both volumes [voxels], one after the other: a wide one catches moves of some voxels."""
ROUNDS = 6
"""Gauss–Newton steps at each blur; they settle in four."""
PLACING = 4
"""Rounds in which frames are placed on each size of pixels: the matter is known, and errors are of a pixel."""


@dataclass(frozen=True)
class Move:
    """`x' = R x + t`: rotation [3, 3], translation [3] [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def best(cls, truth: Volume, found: Volume) -> Move:
        """The move of `truth` onto `found`, both on one grid of cubic voxels, with the least squares of δ."""
        voxel = truth.grid.voxel_size[0]
        axes = [(axis - middle) / voxel for axis, middle in zip(truth.grid.axes(), truth.grid.centre)]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        points = np.stack([x, y, z], axis=-1)
        scale = float(np.abs(truth.delta).max())
        rotation, translation = np.eye(3), np.zeros(3)
        for blur in BLURS:
            still, target = (gaussian_filter(volume.delta / scale, blur) for volume in (truth, found))
            for _ in range(ROUNDS):
                turn, step = _step(still, target, points, rotation, translation)
                rotation, translation = turn @ rotation, turn @ translation + step
        middle = truth.grid.centre
        return cls(rotation, voxel * translation + middle - rotation @ middle)

    def of(self, scene: MeshScene) -> MeshScene:
        """The moved scene."""
        meshes = tuple(mesh.transformed(self.rotation, self.translation) for mesh in scene.meshes)
        return replace(scene, meshes=meshes)


def _step(
    still: np.ndarray, target: np.ndarray, points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The turn [3, 3] and then the translation [3] [voxels] that bring `still`, moved as it is, nearer to `target`.

    A small turn ω and translation τ change the moved volume f by `-(ω × x + τ) · ∇f`.
    """
    back = (points - translation) @ rotation + 0.5 * (np.array(still.shape[::-1]) - 1)
    moved = map_coordinates(still, np.moveaxis(back[..., ::-1], -1, 0), order=1)
    slopes = np.stack([np.asarray(np.gradient(moved, axis=axis)) for axis in (2, 1, 0)], axis=-1)
    near = (slopes**2).sum(-1) > 0
    slopes, missing, at = slopes[near], (target - moved)[near], points[near]
    columns = -np.concatenate([np.cross(at, slopes), slopes], axis=1)
    found = np.linalg.lstsq(columns.T @ columns, columns.T @ missing, rcond=1e-12)[0]
    return Rotation.from_rotvec(found[:3]).as_matrix(), found[3:]


def judged_with(case: Case, found: Stored, scan: Scan, truth: Volume, on_progress: Progress) -> tuple[Scan, Volume]:
    """The frames of `scan` where they fit `found` best, and the truth moved onto it; errors: `InputError` for scenes
    without meshes."""
    if not isinstance(case.scene, MeshScene):
        raise InputError(f"beams of {case.name} are elsewhere, for which the scene must be of meshes.")
    moved = Move.best(truth, found.voxelise(truth.grid)).of(case.scene).voxelise(truth.grid)
    placed = place_frames(found, scan, PoseOptions(rounds=PLACING), on_progress).exposures
    return Scan(scan.frames, placed, scan.is_test, scan.provenance), moved


HALF_DIAGONAL = 0.5 * np.sqrt(3.0)
"""From a voxel's centre to its corner, in voxels: a ball of this radius holds a voxel's centre wherever it lies."""


def contrast_by_size(found: Volume, truth: Volume, balls: Sequence[Ball]) -> tuple[np.ndarray, np.ndarray]:
    """Diameters [S] [m], falling, and the contrast [S] of the balls of each, as a part of the true one.

    A ball's contrast is the mean δ within it, less the mean δ in the shell around it as wide as its radius; both
    volumes lie on one grid of cubic voxels. 1: all of it is left; 0: nothing is seen.
    """
    contrast = np.array([[_contrast(volume, ball) for volume in (found, truth)] for ball in balls])
    diameters = np.array([ball.diameter for ball in balls])
    sizes = np.unique(diameters)[::-1]
    sums = np.stack([contrast[diameters == size].sum(axis=0) for size in sizes])
    return sizes, sums[:, 0] / sums[:, 1]


def _contrast(volume: Volume, ball: Ball) -> float:
    """Mean δ in `ball` less that around it; with room for the blur of a voxel between the two."""
    pitch, radius = volume.grid.voxel_size[0], 0.5 * ball.diameter
    reach = max(2 * radius, radius + 1.5 * pitch)
    near = [np.flatnonzero(np.abs(axis - c) <= reach) for axis, c in zip(volume.grid.axes(), ball.centre)]
    x, y, z = (axis[i] - c for axis, i, c in zip(volume.grid.axes(), near, ball.centre))
    distance = np.sqrt(z[:, None, None] ** 2 + y[None, :, None] ** 2 + x[None, None, :] ** 2)
    values = volume.delta[np.ix_(near[2], near[1], near[0])].astype(np.float64)
    inside = distance <= max(radius, HALF_DIAGONAL * pitch)
    around = (distance > radius + 0.5 * pitch) & (distance <= reach)
    return float(values[inside].mean() - values[around].mean())


CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What Linux takes to forget the peak of a process's memory (proc(5), clear_refs)."""


@contextmanager
def memory_growth() -> Iterator[Callable[[], int | None]]:
    """Yields a function: by how many bytes the process's memory grew at its peak since; None where Linux is not."""
    before = None
    with suppress(OSError):
        CLEAR.write_text(RESET_PEAK)
        before = status_bytes("VmRSS")

    def growth() -> int | None:
        peak = status_bytes("VmHWM")
        return None if before is None or peak is None else max(0, peak - before)

    yield growth


TRUTH_THRESHOLD = 0.5
"""Shell correlation with a noise-free truth at which the resolution is read: 0.143 between two halves of the data
corresponds to it (Rosenthal & Henderson 2003, J. Mol. Biol. 333, 721)."""


@dataclass(frozen=True)
class Suite:
    """What is run: `load(case, seed)` for all `cases` and `seeds`, each with all `methods` and `references`."""

    cases: Sequence[str]
    seeds: Sequence[int]
    methods: Mapping[str, BenchMethod]
    references: Mapping[str, Reference]
    load: Callable[[str, int], Case | MeasuredCase]

    def __post_init__(self) -> None:
        for what, chosen in (("cases", self.cases), ("methods", self.methods), ("seeds", self.seeds)):
            require(len(chosen) > 0, f"a benchmark needs at least one of the {what}; name one.")
        for name in (*self.cases, *self.names()):
            good_name(name)
        require(min(self.seeds) >= 0, f"seeds must be 0 or more, but one is {min(self.seeds)}.")

    def names(self) -> list[str]:
        """References and methods, in the order in which they run."""
        return [*self.references, *self.methods]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.cases) * len(self.seeds) * len(self.names())


def chosen(what: str, wanted: Sequence[str], table: Sequence[Name]) -> list[Name]:
    """The `wanted` names in the `table`'s order, all if none is wanted; `InputError` listing the table otherwise."""
    unknown = [name for name in wanted if name not in table]
    if unknown:
        raise InputError(f"{what} must be among {', '.join(table)}, but {', '.join(unknown)} is not; correct it.")
    return [name for name in table if name in wanted or not wanted]


def run_suite(
    suite: Suite,
    folder: BenchFolder,
    *,
    retry: bool = False,
    on_progress: Progress = lambda stage, fraction: None,
    on_row: Callable[[Row, int], None] = lambda row, left: None,
) -> None:
    """Fill `folder` with the rows of `suite` that it lacks; with `retry`, failed ones are made again.

    A method that fails gets a row that says why, and the others go on. Ctrl-C is passed on, and leaves whole rows only.
    `on_row(row, left)` is called after each row, with the number of those to come.
    """
    folder.create()
    missing = {
        (case, seed): [name for name in suite.names() if not folder.has_row(case, seed, name, retry)]
        for case in suite.cases
        for seed in suite.seeds
    }
    left = sum(len(names) for names in missing.values())
    tables = (suite.references, suite.methods)
    jobs = [(place, method, job) for table in tables for place, (method, job) in enumerate(table.items())]
    for (name, seed), wanted in missing.items():
        if not wanted:
            continue
        on_progress(f"{name} {seed}: scene and scan", 0.0)
        bench = _Bench.of(suite.load(name, seed), folder, on_progress)
        for place, method, job in jobs:
            if method not in wanted:
                continue
            row, picture = bench.attempt(method, job, place)
            if picture:  # before the row, which marks both as done
                folder.write_picture(row.case, row.seed, row.method, picture)
            folder.write_row(row)
            left -= 1
            on_row(row, left)


def stored_bytes(found: Stored) -> int:
    """Size of what has to be stored of an object: voxels, networks and their images as float16, and the mask of fields
    in bits; all other parameters as float32, and faces as int32."""
    count = sum(parameter.numel() for parameter in found.parameters().values())
    if isinstance(found, VoxelGrid):
        return 2 * count
    if isinstance(found, NeuralField | PixelAlignedField):
        images = found.images.numel() if isinstance(found, PixelAlignedField) else 0
        return 2 * (count + images) + found.mask.numel() // 8
    faces = found.faces.numel() if isinstance(found, SurfaceMesh | MovingSurfaces) else 0
    return 4 * (count + faces)


@dataclass(frozen=True)
class _Bench:
    """A case made ready: what methods are given, and what their results are held against."""

    case: Case | MeasuredCase
    scan: Scan
    truth: Volume
    picture: Arrays
    blank: Row
    on_progress: Progress
    aligned: dict[Aligner, tuple[Scan, float]] = field(default_factory=dict)
    """Training frames that an aligner has placed, and its seconds: methods that share it need it once."""

    @classmethod
    def of(cls, case: Case | MeasuredCase, folder: BenchFolder, on_progress: Progress) -> _Bench:
        scan, truth = prepared(case, folder.case(case.name, case.seed))
        picture = truth_picture(scan, truth)
        folder.write_picture(case.name, case.seed, TRUTH, picture)
        hashed, commit = scan_hash(scan), source_commit()
        blank = Row(case.name, case.seed, "", "", "", 0, "failed", "", hashed, commit, "")
        blank = replace(blank, **environment(resolve("auto")))
        return cls(case, scan, truth, picture, blank, on_progress)

    def attempt(self, name: str, job: BenchMethod | Reference, place: int) -> tuple[Row, Arrays | None]:
        """The row of a method or reference and, if it has a result, its picture."""
        row = replace(self.blank, method=name, family=job.family, summary=job.summary, place=place)
        picture = None
        stage = f"{row.case} {row.seed} {name}: "
        gc.collect()  # of the method before
        try:
            with memory_growth() as growth:
                before = self.aligned[job.aligner][1] if job.aligner and job.aligner in self.aligned else 0.0
                began = time.perf_counter() - before
                found = self._produced(job, lambda what, fraction: self.on_progress(stage + what, fraction))
                row = replace(row, seconds=time.perf_counter() - began, memory_bytes=growth())
            self.on_progress(stage + "scores", 0.0)
            scores, picture = self._judged(found, stage)
            size = stored_bytes(found) if isinstance(found, Stored) else None
            row = replace(row, status="done", stored_bytes=size, **_numbers(scores))
            if isinstance(self.case, MeasuredCase):
                row.volume.update(agreement(found.voxelise(self.truth.grid), self.truth))
        except Exception as error:  # one method's fault must not take the others' results
            row = replace(row, reason=reason_of(error))
        return replace(row, when=datetime.now(UTC).isoformat(timespec="seconds")), picture

    def _produced(self, job: BenchMethod | Reference, on_progress: Progress) -> Object:
        """What a job makes; training frames that an aligner has placed are kept for others that need them."""
        if isinstance(job, Reference):
            return job.run(self.case, self.truth, on_progress)
        scan, aligner = self.scan.train(), job.aligner
        if aligner is not None:
            if aligner not in self.aligned:
                began = time.perf_counter()
                placed = aligner(scan, self.case.prior, on_progress)
                self.aligned[aligner] = placed, time.perf_counter() - began
            scan = self.aligned[aligner][0]
        return replace(job, aligner=None).run(scan, self.case.prior, self.case.seed, on_progress)

    def _judged(self, found: Object, stage: str) -> tuple[Scores, Arrays]:
        oversample, scan, truth = fringe_sampling(self.scan.exposures), self.scan, self.truth
        if isinstance(self.case, Case) and self.case.misalignment:
            say = self.on_progress
            told = lambda what, fraction: say(stage + what, fraction)  # noqa: E731
            scan, truth = judged_with(self.case, cast(Stored, found), scan, truth, told)
        scores = score_object(found, scan, truth, oversample)
        volume = found.voxelise(self.truth.grid)
        picture = method_picture(volume, scores, self.picture)
        if self.case.balls:
            picture["diameters"], picture["contrast"] = contrast_by_size(volume, self.truth, self.case.balls)
        return scores, picture


def _numbers(scores: Scores) -> dict[str, dict[str, float | None]]:
    """The scores as a row has them."""
    assert scores.test is not None
    assert scores.train is not None
    assert scores.volume is not None
    volume = scores.volume
    half = resolution(volume.frequency, volume.fsc, TRUTH_THRESHOLD, volume.pitch)
    plain = {name: None if n is None else float(n) for name, n in volume.as_dict().items()}
    plain["resolution_half"] = half
    return {"test": dict(scores.test.mean), "train": dict(scores.train.mean), "volume": plain}
