"""The methods that the benchmark compares: one table of options of the library's own, with names and headings, and ways
to find the beams first. How to add one: docs/adding.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.align.derivatives import blurred, in_pixels, projections
from holosplat.align.find import align_views
from holosplat.align.initial_geometry import shifts_by_mass
from holosplat.baselines import TOMOGRAPHIES
from holosplat.checks import require
from holosplat.geometry import Grid
from holosplat.matter import Known, MaterialPrior, Matter
from holosplat.methods import (
    Auto,
    Gaussians,
    HolographicVoxels,
    Method,
    PerView,
    SmoothVolume,
    Surfaces,
    Voxels,
)
from holosplat.methods import Method as Options
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.presets import preset
from holosplat.optics.retrieval import tikhonov
from holosplat.planning.acts import of_simulation
from holosplat.planning.needs import Costs, Needs, Sizes, of_fit
from holosplat.progress import Progress
from holosplat.representations.voxels import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.volume import Object, Volume
from holosplat.workflows.reconstruct import reconstruct

from ..declaration import Case
from ..opponents.mbir import MbirPerView
from ..opponents.neural_fields import NeuralFields
from ..opponents.onix import Onix, PixelNerf
from ..opponents.photographs import AlphaSplats, RadianceFields
from .folder import REFERENCE
from .prepare import MeasuredCase

Aligner = Callable[[Scan, MaterialPrior, Progress], Scan]
"""The training frames in other exposures."""

ROUNDS = 6
"""Volumes and poses in turn: errors of a pixel settle in four."""
BLUR = 1.0
"""Projections are compared after a Gaussian of this standard deviation [pixels], as `align` compares frames."""
RIGID = [0, 1, 4]
"""Of the derivatives of a projection: by the two shifts and by the roll, which move an image in its plane."""


def by_mass(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Scan:
    """Shifts that bring the centres of mass of retrieved thickness to the projections of one point."""
    found = shifts_by_mass(_thickness(scan, prior, on_progress).double().numpy(), scan.views)
    return scan.with_views(replace(scan.views, shifts=scan.views.shifts + scan.views.pixel_size * found))


def by_reprojection(scan: Scan, prior: MaterialPrior, on_progress: Progress, rounds: int = ROUNDS) -> Scan:
    """Shifts and roll of each view by which its retrieved thickness fits that of a volume of all views, in turn.

    Iterative reprojection (Dengler 1989, Ultramicroscopy 30, 337; Gürsoy et al. 2017, Sci. Rep. 7, 11818), with the
    volume of total-variation tomography, and least squares in place of cross-correlation, so that parts of a pixel and
    the roll are found, too.
    """
    lines = _thickness(scan, prior, on_progress) / scan.views.pixel_size
    upper, views = 1.0 if isinstance(prior, Known) else None, scan.views
    for n in range(rounds):
        plain = in_pixels(views)
        grid = Grid.of_views(in_pixels(scan.views))
        volume = TOMOGRAPHIES["tv"](lines, plain, grid, upper, lambda fraction: None)
        projected, slopes = projections(volume, grid, in_pixels(views))
        missing = blurred(lines - projected, BLUR).flatten(1).double().numpy()
        columns = blurred(slopes[:, RIGID], BLUR).flatten(2).double().numpy()
        rotations, shifts = views.rotations.copy(), views.shifts.copy()
        for v, (column, left) in enumerate(zip(columns, missing)):
            x, y, roll = np.linalg.lstsq(column.T, left, rcond=1e-9)[0]
            rotations[v] = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix() @ rotations[v]
            shifts[v] += views.pixel_size * np.array([x, y])
        views = replace(views, rotations=rotations, shifts=shifts)
        on_progress("reprojection", (n + 1) / rounds)
    return scan.with_views(views)


def by_align(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Scan:
    """`holosplat align`: shifts, roll and turns by the frames themselves."""
    found = align_views(scan, prior, on_progress=on_progress)
    return Scan(scan.frames, found.exposures, scan.is_test, scan.provenance)


ALIGNERS: dict[str, tuple[str, Aligner]] = {
    "mass": ("views shifted by centres of mass", by_mass),
    "reprojection": ("views aligned with the tikhonov-tv volume", by_reprojection),
    "align": ("views aligned by holosplat align", by_align),
}
"""Name → one line of what it does, and the aligner."""


def _thickness(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Tensor:
    """Retrieved thickness [V, H, W] [m]."""
    material = assumed_material(scan, prior, on_progress)
    return tikhonov(torch.from_numpy(scan.frames), scan.exposures, *material)


@dataclass(frozen=True)
class BenchMethod:
    """name: for the command line and the table; family: its heading in the table; summary: one line of what it does;
    options: of the library's method that runs; aligner: what first finds where the beams are (None: nothing)."""

    name: str
    family: str
    summary: str
    options: Options
    aligner: Aligner | None = None

    def run(self, scan: Scan, prior: MaterialPrior, seed: int, on_progress: Progress) -> Object:
        """The Object that the method makes of the training frames `scan`; `InputError` where it cannot."""
        if self.aligner is not None:
            scan = self.aligner(scan, prior, on_progress)
        return reconstruct(
            scan, prior, self.options, seed, on_progress=lambda stage, part, record: on_progress(stage, part)
        ).object


PER_VIEW = "phase retrieval of each view, then tomography"
VOXELS = "voxels through the waves"
NEURAL = "neural field through the waves"
GAUSSIANS = "Gaussians through the waves"
SURFACES = "surfaces through the waves"
ALIGNED_LINES = "phase retrieval of each view, then a network"
PHOTOGRAPHS = "holograms taken for photographs, without waves"
AUTO = "chosen by the frames"


def methods(effort: float = 1.0) -> dict[str, BenchMethod]:
    """Name → method. effort: share of the steps of those that fit in many steps (1: as published)."""
    table = (*_as_photographs(effort), *_per_view(), *_through_waves(effort))
    return {method.name: method for method in table}


def _per_view() -> list[BenchMethod]:
    """Paganin with every tomography, then every other phase retrieval with the best of them."""
    plain = {
        "fbp": "filtered back-projection",
        "art": "ART (Kaczmarz, ray by ray)",
        "sirt": "SIRT without bounds",
        "sirt-nonneg": "SIRT without negative values",
    }
    rows = [(f"paganin-{name}", f"Paganin, {what}", PerView("paganin", name, False)) for name, what in plain.items()]
    mbir = MbirPerView("paganin", bounded=False)
    rows += [
        ("paganin-svmbir", "Paganin, model-based reconstruction (qGGMRF) by svmbir", mbir),
        ("paganin-tv-nonneg", "Paganin, total variation without negative values", PerView("paganin", "tv", False)),
        ("paganin-tv", "Paganin, total variation in [0, 1]", PerView("paganin", "tv")),
    ]
    others = {
        "ctf": "contrast transfer function",
        "tikhonov": "nonlinear Tikhonov with positivity",
        "gerchberg-saxton": "Gerchberg–Saxton",
        "hybrid-input-output": "hybrid input–output",
        "admm": "ADMM",
    }
    rows += [(f"{name}-tv", f"{what}, total variation in [0, 1]", PerView(name, "tv")) for name, what in others.items()]
    return [BenchMethod(name, PER_VIEW, summary, options) for name, summary, options in rows]


def _as_photographs(effort: float) -> list[BenchMethod]:
    """Both from a random start."""
    splats, field = AlphaSplats().with_effort(effort), RadianceFields().with_effort(effort)
    return [
        BenchMethod(splats.kind, PHOTOGRAPHS, "opaque Gaussians laid over each other (Kerbl et al. 2023)", splats),
        BenchMethod(field.kind, PHOTOGRAPHS, "radiance field with positional encoding (Mildenhall et al. 2020)", field),
    ]


def _through_waves(effort: float) -> list[BenchMethod]:
    rows: list[tuple[str, str, str, Any]] = [
        (
            "holographic-tv",
            VOXELS,
            "total variation made to agree with the holograms: the start of the Gaussians",
            HolographicVoxels(),
        ),
        (
            "volume",
            VOXELS,
            "a smooth volume of continuous matter: reconstruct --method volume",
            SmoothVolume(),
        ),
        (
            "voxels-waves",
            VOXELS,
            "voxels from holographic-tv, fitted to the holograms, with total variation",
            Voxels().with_effort(effort),
        ),
        (
            "neural-field",
            NEURAL,
            "hash grid and small network, fitted to the projections of holographic-tv, then to the holograms",
            NeuralFields().with_effort(effort),
        ),
        (
            "onix",
            NEURAL,
            "pixel-aligned network (Zhang et al. 2023) that saw no other scene, fitted to the holograms",
            Onix().with_effort(effort),
        ),
        (
            "pixelnerf",
            ALIGNED_LINES,
            "the same (Yu et al. 2021), fitted to the thickness that phase retrieval finds in each view",
            PixelNerf().with_effort(effort),
        ),
        (
            "gaussians-random",
            GAUSSIANS,
            "from a random start: reconstruct --preset random",
            preset("random").with_effort(effort),
        ),
        (
            "gaussians",
            GAUSSIANS,
            "from phase retrieval and total variation: reconstruct --method gaussians",
            Gaussians().with_effort(effort),
        ),
        (
            "surfaces",
            SURFACES,
            "closed surfaces cut out of the Gaussians and fitted to the holograms: reconstruct --method surfaces",
            Surfaces().with_effort(effort),
        ),
        (
            "auto",
            AUTO,
            "what suits the matter, with the best state kept: what reconstruct does by default",
            Auto().with_effort(effort),
        ),
        (
            "learned",
            AUTO,
            "the same, begun with a network's guess where that explains the frames better: --start learned",
            replace(Auto(), gaussians=replace(Auto().gaussians, start="learned")).with_effort(effort),
        ),
    ]
    return [BenchMethod(*row) for row in rows]


METHODS = methods()
"""Name → method, in the order of the tables."""
ON_ALIGNED = {
    "paganin-tv": ("mass", "reprojection"),
    "tikhonov-tv": ("mass", "reprojection", "align"),
    **dict.fromkeys(("voxels-waves", "gaussians", "surfaces", "auto"), ("align",)),
}
"""The methods that also run on views which were aligned before, and how."""


def aligned(table: Mapping[str, BenchMethod]) -> dict[str, BenchMethod]:
    """Name → method of `ON_ALIGNED`, such as `tikhonov-tv+mass`."""
    found = {}
    for name, ways in ON_ALIGNED.items():
        for way in ways:
            said, aligner = ALIGNERS[way]
            both, summary = f"{name}+{way}", f"{table[name].summary}; {said}"
            found[both] = replace(table[name], name=both, summary=summary, aligner=aligner)
    return found


ALIGNED = aligned(METHODS)
"""Methods that are run where they are named, for cases whose beams are not where they should be."""


JUDGED = 60.0
"""Bytes of a voxel of a case whose truth and result are compared (`benchmarks/needs_acts.py`)."""


def of_methods(exposures: Exposures, is_test: np.ndarray, samples: int, methods: Sequence[Method]) -> Needs:
    """What a case of the benchmark takes, with such frames, of which some are held out, and so many wave samples along
    a pixel of its simulation."""
    sizes, voxels = Sizes.of(exposures[~is_test]), Sizes.of(exposures).voxels
    each = [needs for method in methods if (needs := of_fit(sizes, method)) is not None]
    made = of_simulation(exposures, samples, len(exposures))
    memory = max([made.memory, *(needs.memory for needs in each)]) + JUDGED * voxels
    disk = made.disk + 2 * Costs.written * voxels + 1e6 * len(each)
    return Needs(memory, disk, 10 + sum(needs.seconds for needs in each))


def of_benchmark(cases: Sequence[Needs]) -> Needs:
    """What several cases take, one after the other."""
    return Needs(max(one.memory for one in cases), sum(one.disk for one in cases), sum(one.seconds for one in cases))


@dataclass(frozen=True)
class Reference:
    """name: for the table; summary: one line of what it is; run: (case, true volume, on_progress) → Object,
    `InputError` with the reason where the case has no such reference."""

    family: ClassVar[str] = REFERENCE
    aligner: ClassVar[None] = None

    name: str
    summary: str
    run: Callable[[Case | MeasuredCase, Volume, Progress], Object]


def truth_on_voxels(case: Case | MeasuredCase, truth: Volume, on_progress: Progress) -> VoxelGrid:
    """The true volume itself: what voxels of one pixel can hold, at their best."""
    on_progress("truth on voxels", 0.0)
    scales = [float(np.abs(values).max()) for values in (truth.delta, truth.beta)]
    channels = [values / (scale or 1.0) for values, scale in zip((truth.delta, truth.beta), scales)]
    return VoxelGrid(torch.from_numpy(np.stack(channels)), truth.grid, Matter.free(*scales))


def tv_of_true_lines(case: Case | MeasuredCase, truth: Volume, on_progress: Progress) -> VoxelGrid:
    """Total-variation tomography from the true thickness in the training views: phase retrieval without error."""
    require(
        isinstance(case, Case) and case.prior.fixes_level,
        "the true thickness needs a known material, but methods are told of none here.",
    )
    assert isinstance(case, Case)
    views = case.true_exposures().views[np.flatnonzero(~case.is_test)]
    material = case.prior.materials[0]
    _, projected_delta = case.scene.project(views)
    lines = (projected_delta / material.delta).float()
    grid = Grid.of_views(views)
    values = TOMOGRAPHIES["tv"](lines, views, grid, 1.0, lambda fraction: on_progress("tomography", fraction))
    return VoxelGrid(values[None], grid, Matter.one(*material))


REFERENCES = {
    reference.name: reference
    for reference in (
        Reference("truth-on-voxels", "the true volume on voxels of one pixel", truth_on_voxels),
        Reference("tv-true-lines", "TV tomography from the true thickness of the training views", tv_of_true_lines),
    )
}
"""Name → reference."""
