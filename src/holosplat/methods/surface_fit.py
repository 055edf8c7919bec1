"""Closed surfaces: how they are cut out of Gaussians, and fitted to frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from scipy.sparse import csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from torch import Tensor

from ..backends import Backend, device, resolve
from ..baselines.beyond import MULTIPLE
from ..baselines.two_materials import told_apart
from ..checks import in_range, positive, require
from ..fit.loop import Fit, Plan
from ..fit.optimiser import Adam, Group, Leaves, Optimiser
from ..fit.pose_refinement import PoseRefinement, with_pose_refinement
from ..fit.problem import Problem, Schedule
from ..fit.projected_gradient import QuasiNewton
from ..fit.terms import Objective
from ..fit.terms.frames import ProfileLikelihood
from ..fit.terms.object import CurvatureVariation, membrane_inverse
from ..geometry import Grid, Views
from ..matter import Matter
from ..mesh import TriangleMesh
from ..optics.background import Light
from ..optics.sampling import fringe_sampling
from ..ranges import Rate, Weight, checked_dataclass
from ..representations import GaussianCloud, SurfaceMesh, isosurface
from ..representations.isosurface import adjacency
from ..scan import Scan
from .cross_validation import predicted_frames
from .ground import ExtraTerm, ground

VERTICES = "object.vertices"
BETAS, EPSILON = (0.9, 0.99), 1e-30
"""Adam's constants for vertices (Nicolet et al. 2021)."""
MEMORY = 20
"""Pairs of steps and gradients that L-BFGS remembers."""
FINEST = 0.25
"""Edge of voxels [pixels] at which surfaces are cut out, at least."""
NEAR = 2
"""Voxels within which a material is near: that far a pixel's blur reaches."""


@checked_dataclass
class Extraction:
    """How surfaces are cut out of the occupancy that Gaussians add up to."""

    level: float = 0.5
    """Occupancy at the surface. Reconstruction tries 0.4 to 1.2 times as much, for the frames to choose."""
    spacing: float = 1.0
    """Edge of the voxels, and about the length of the triangles' sides [pixels]."""
    least_volume: Weight = 8.0
    """Bodies and cavities of fewer voxels are left out."""
    smoothing: int = 10
    """Steps that smooth away the voxels' traces."""

    def __post_init__(self) -> None:
        in_range("level", self.level, 0.01, 0.99)
        in_range("spacing", self.spacing, FINEST, 8.0, unit="pixels")

    def finer(self) -> Extraction:
        """The same on voxels half as large (`FINEST` at least), of bodies as large."""
        spacing = max(FINEST, self.spacing / 2)
        return replace(self, spacing=spacing, least_volume=self.least_volume * (self.spacing / spacing) ** 3)


@checked_dataclass
class SurfaceFit:
    """Options of the fit of surfaces to frames."""

    rate: Rate = 0.2
    """Length of the first step [pixels], of the vertex that moves most; others are ten times as long at most."""
    worth: Weight = 5.0
    """Least log-likelihood gain of a step [nats], averaged over ten, for the fit to continue: by about as much any
    number moves it that the frames do not tell (Akaike 1974)."""
    stiffness: Weight = 2.0
    """How far a vertex draws its neighbours along in a step, λ of Nicolet et al. (2021); ends do not depend on it."""
    curvature: Weight = 3.0
    """Prior of smooth shapes: κ of ½ κ R² ∫ |∇H|² dA of each body [nats], H its mean curvature, R = 3 V/A."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, rounded=1.0, rounding=3.0))
    """How frames are compared; their noise is what the surfaces leave of each view."""
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=100, decay=0.1))
    """The loop; waves are sampled one finer than for Gaussians unless it says how, for edges are sharper."""
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name."""
    backend: Backend = "auto"
    """What computes the fit."""

    def __post_init__(self) -> None:
        positive("rate", self.rate, "pixels")


@dataclass(frozen=True)
class SurfaceOptions:
    """How surfaces are cut out, and how they are fitted."""

    extraction: Extraction = field(default_factory=Extraction)
    fit: SurfaceFit = field(default_factory=SurfaceFit)

    def with_effort(self, effort: float) -> Self:
        """The same options with `effort` times the steps, at least one."""
        return replace(self, fit=replace(self.fit, schedule=self.fit.schedule.with_effort(effort)))


def extract_surfaces(cloud: GaussianCloud, scan: Scan, options: Extraction = Extraction()) -> SurfaceMesh:
    """The surfaces where the occupancy of `cloud` crosses the level, in the field of view of `scan` and the
    rows beyond that the cloud fills.

    Errors: `InputError` if the cloud is not of one material, or there is no such surface.
    """
    has = "several materials" if cloud.matter.others else "δ and β apart"
    require(
        cloud.matter.single,
        f"surfaces need one material of known δ and β, but this run has {has}; "
        "reconstruct with --material or --delta-beta.",
    )
    grid = Grid.of_views(field_of(cloud, scan.views), 1 / options.spacing)
    with torch.no_grad():
        density = cloud.density(grid)[0].cpu()
    return cut_surfaces(density, grid, cloud.unit_length, cloud.matter, options)


def cut_surfaces(
    occupancy: Tensor, grid: Grid, unit_length: float, matter: Matter, options: Extraction = Extraction()
) -> SurfaceMesh:
    """The surfaces [`unit_length`] where occupancy [Z, Y, X] of the first material on `grid` crosses the level from
    each material of `matter`, the strongest first, to those of weaker contrast on its side of the medium, and to this.

    The level lies between those materials that are near: of a wall in air 0.5, though a liquid lies between both in δ.
    Errors: `InputError` if one of them has no surface.
    """
    vertices, faces, count, cut = list[np.ndarray](), list[np.ndarray](), 0, dict[int, TriangleMesh]()
    for side in (1, -1):
        own = {k: side * delta / matter.delta for k, (delta, _) in enumerate(matter.channels)}
        own = {k: level for k, level in own.items() if level > 0}
        for k, level in zip(own, _levels(side * occupancy, list(own.values()), options.level)):
            share = side * occupancy.numpy() / level
            cut[k] = isosurface(share, grid, 1.0, options.least_volume, options.smoothing)
    for mesh in (cut[k] for k in sorted(cut)):
        vertices.append(mesh.vertices / unit_length)
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
    points, triangles = torch.from_numpy(np.concatenate(vertices)), torch.from_numpy(np.concatenate(faces))
    return SurfaceMesh(points, triangles, unit_length, matter, parts=[len(part) for part in faces])


def _levels(occupancy: Tensor, own: Sequence[float], share: float) -> Iterator[np.ndarray | float]:
    """The occupancy, or that of each voxel, at which each material and all stronger ones end, those of levels `own`
    falling: the `share` of the way between the weakest of them and the strongest of the others that are near.

    A material but the first is near where it fills more than a layer (`told_apart`).
    """
    if len(own) < 2:
        yield from (share * level for level in own)
        return
    filled = told_apart(occupancy, own, 1)[1:].numpy() > 0
    near = [np.asarray(binary_dilation(each, iterations=NEAR), dtype=bool) for each in filled]
    for k in range(len(own)):
        above, below = np.full(occupancy.shape, own[0]), np.zeros(occupancy.shape)
        for j in range(1, k + 1):
            above[near[j - 1]] = own[j]
        for j in range(len(own) - 1, k, -1):
            below[near[j - 1]] = own[j]
        yield below + share * (above - below)


def surface_fit(
    scan: Scan,
    start: SurfaceMesh,
    options: SurfaceFit = SurfaceFit(),
    seed: int = 0,
    light: Light | None = None,
    freedom: PoseRefinement | None = None,
) -> Fit:
    """The fit of the surfaces `start` to the training frames of `scan`, of the same triangles, made ready.

    freedom: of where these frames are, which is then fitted, too. Steps are those of L-BFGS in the coordinates
    (1 + λΔ) x (Nicolet, Jacobson & Jakob 2021, "Large steps in inverse rendering of geometry", section 3), which need
    the whole objective, so that `views_per_step` is how many frames are in memory at a time; with a `freedom`, Adam's.
    """
    finer, backend, schedule = oversampling(scan.train(), options), resolve(options.backend), options.schedule
    if schedule.views_per_step and not freedom:
        schedule = replace(schedule, views_per_step=0, views_at_once=schedule.views_per_step)
    start = start.on(backend)
    base = ground(scan, start, start.matter, options.objective, schedule, backend, finer=finer, light=light)
    frames = ProfileLikelihood(base.frames, int(base.train.measured.isfinite().sum()), alike=bool(freedom))
    prior = [CurvatureVariation(options.curvature * frames.nat, start)] if options.curvature > 0 else []
    solve = (_membrane_on_gpu if backend == "cuda" else _membrane)(start, options.stiffness)

    def optimiser(leaves: Leaves) -> Optimiser:
        if freedom:  # poses move the objective between the steps of vertices
            return Adam(leaves, backend, {VERTICES: Group(BETAS, EPSILON, solve=solve, together=True)})
        return QuasiNewton(leaves, lambda slope: solve(solve(slope)), MEMORY, options.worth * frames.nat)

    plan = Plan(
        problem=Problem(base.model, (frames, *prior, *base.extra(options.terms))),
        schedule=schedule,
        optimiser=optimiser,
        rates=lambda factor, step: {VERTICES: options.rate * (factor if freedom else 1.0)},
        judge=base.judge,
        capture=False,  # not yet tried as a CUDA graph
    )
    return Fit(with_pose_refinement(plan, freedom, base.train, frames.nat), seed)


def oversampling(scan: Scan, options: SurfaceFit = SurfaceFit()) -> int:
    """Wave samples along a pixel at which surfaces are fitted and judged: their edges are sharper than Gaussians'."""
    return options.schedule.oversample or fringe_sampling(scan.exposures, extra=1)


def _membrane(start: SurfaceMesh, stiffness: float) -> Callable[[Tensor], Tensor]:
    """The inverse of 1 + λΔ of a mesh: gradients [P, 3] in, smooth directions out."""
    faces, count = start.faces.numpy(), len(start.vertices)
    edges = adjacency(faces, count)
    laplacian = diags_array(edges.sum(1)) - edges
    solve = splu(csc_array(eye_array(count) + stiffness * laplacian)).solve
    return lambda gradient: torch.from_numpy(solve(gradient.numpy()))


def _membrane_on_gpu(start: SurfaceMesh, stiffness: float) -> Callable[[Tensor], Tensor]:
    """The same on the GPU, which does not wait for the CPU."""
    edges = adjacency(start.faces.cpu().numpy(), len(start.vertices))
    return membrane_inverse(edges, stiffness, device(start.backend))


def frames_of(found: SurfaceMesh | GaussianCloud, scan: Scan, options: SurfaceFit) -> Tensor:
    """Frames [V, H, W] of `scan` that `found` predicts, as a fit of surfaces predicts them."""
    return predicted_frames(scan.exposures, found.on(resolve(options.backend)), oversampling(scan, options))


def field_of(cloud: GaussianCloud, views: Views) -> Views:
    """`views` with the rows above and below that `cloud` fills: a multiple of `MULTIPLE`, to the nearest."""
    with torch.no_grad():
        height = cloud.centres[:, 1].double() * cloud.unit_length - float(Grid.of_views(views).centre[1])
    past = float(height.abs().max()) - 0.5 * views.height if len(cloud) else 0.0
    return views.taller(MULTIPLE * max(0, round(past / (MULTIPLE * views.finest))))
