"""The methods that the benchmark compares: one table, one interface. How to add one: docs/adding.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..baselines import TOMOGRAPHIES, HolographicTV, holographic_tv
from ..fit.neural import NeuralFit, fit_neural
from ..fit.voxels import VoxelFit, fit_voxels
from ..geometry import Grid, Views
from ..optics.retrieval import RETRIEVALS
from ..representations import GaussianCloud, SurfaceMesh, VoxelGrid
from ..representations.neural_field import Matter, NeuralField
from ..scan import Scan
from ..workflows.reconstruct import reconstruct
from ..workflows.settings import MaterialPrior, Settings, preset
from ..workflows.start import assumed_material
from ..workflows.surfaces import SurfaceSettings, refine_surfaces
from .method import Method, Progress
from .svmbir import svmbir_volume

PER_VIEW = "phase retrieval of each view, then tomography"
VOXELS = "voxels through the waves"
NEURAL = "neural field through the waves"
GAUSSIANS = "Gaussians through the waves"
SURFACES = "surfaces through the waves"

Volumetric = Callable[[Tensor, Views, Grid, Callable[[float], None]], Tensor]
"""(thickness [V, H, W] in metres, views, grid, on_progress) → occupancy [Z, Y, X]."""


@dataclass(frozen=True)
class PerView:
    """Phase retrieval of each view by `retrieval`, then `tomography`, on voxels of one pixel; see `Method.run`."""

    retrieval: str
    tomography: Volumetric

    def __call__(self, scan: Scan, prior: MaterialPrior, seed: int, on_progress: Progress) -> VoxelGrid:
        """The occupancy of one material: the known one, or what the frames suggest."""
        material = assumed_material(scan, prior, on_progress)
        thickness = retrieve(self.retrieval, scan, material, on_progress)
        grid = Grid.of_views(scan.views)
        values = self.tomography(thickness, scan.views, grid, lambda part: on_progress("tomography", part))
        return VoxelGrid(values[None], grid, *material)


@dataclass(frozen=True)
class Bounded:
    """A tomography of the table with the occupancy kept below one where the material is known (`PerView` otherwise)."""

    retrieval: str
    tomography: str

    def __call__(self, scan: Scan, prior: MaterialPrior, seed: int, on_progress: Progress) -> VoxelGrid:
        """The occupancy of one material."""
        upper = 1.0 if prior.kind == "known" else None
        return PerView(self.retrieval, tomography(self.tomography, upper))(scan, prior, seed, on_progress)


def tomography(name: str, upper: float | None = None) -> Volumetric:
    """The tomography `name` with the occupancy kept below `upper`."""
    solve = TOMOGRAPHIES[name]
    return lambda lines, views, grid, on_progress: solve(lines, views, grid, upper, on_progress)


def retrieve(name: str, scan: Scan, material: tuple[float, float], on_progress: Progress) -> Tensor:
    """Thickness [V, H, W] in metres from the frames of `scan`, by the phase retrieval `name`."""
    frames = torch.from_numpy(scan.frames)
    report = _stage(on_progress, "phase retrieval")
    return RETRIEVALS[name](frames, scan.exposures, *material, on_progress=report)


def holographic_voxels(scan: Scan, prior: MaterialPrior, options: HolographicTV, on_progress: Progress) -> VoxelGrid:
    """The start of the Gaussians, by itself: TV tomography made to agree with the holograms."""
    material = assumed_material(scan, prior, on_progress)
    bounded = replace(options, upper=1.0 if prior.kind == "known" else 0.0)
    values, grid = holographic_tv(scan, material, bounded, on_progress)
    return VoxelGrid(values[None], grid, *material)


def voxels_through_waves(
    scan: Scan, prior: MaterialPrior, start: HolographicTV, options: VoxelFit, on_progress: Progress
) -> VoxelGrid:
    """Voxels fitted to the holograms, from the start that the Gaussians have; δ and β apart where nothing is known."""
    first = holographic_voxels(scan, prior, start, on_progress)
    bounded = replace(options, upper=1.0 if prior.kind == "known" else 0.0)
    return fit_voxels(scan, first.freed() if prior.kind == "free" else first, bounded, on_progress)


def neural_through_waves(
    scan: Scan, prior: MaterialPrior, seed: int, start: HolographicTV, options: NeuralFit, on_progress: Progress
) -> NeuralField:
    """A neural field that learns the line integrals of the Gaussians' start, and is then fitted to the holograms."""
    first = holographic_voxels(scan, prior, start, on_progress)
    matter = Matter(
        first.delta, first.beta, 2 if prior.kind == "free" else 1, upper=1.0 if prior.kind == "known" else 0.0
    )
    thickness = first.project(scan.views).channels[:, 0]
    return fit_neural(scan, matter, thickness, options, seed, on_progress)


def gaussians(scan: Scan, prior: MaterialPrior, seed: int, settings: Settings, on_progress: Progress) -> GaussianCloud:
    """What `holosplat reconstruct` does; Ctrl-C is passed on."""
    found = reconstruct(scan, prior, settings, seed, on_progress=lambda stage, part, record: on_progress(stage, part))
    if not found.finished:
        raise KeyboardInterrupt
    return found.cloud


def surfaces(
    scan: Scan, prior: MaterialPrior, seed: int, settings: Settings, how: SurfaceSettings, on_progress: Progress
) -> SurfaceMesh:
    """What `holosplat surface` makes of what `holosplat reconstruct` does."""
    cloud = gaussians(scan, prior, seed, settings, on_progress)
    return refine_surfaces(cloud, scan, how, lambda stage, part, record: on_progress(stage, part))


def methods(effort: float = 1.0) -> dict[str, Method]:
    """Name → method. effort: share of the steps of those that fit in many steps (1: as published)."""
    table = (*_per_view(), *_through_waves(effort), *_gaussians(effort), _surfaces(effort))
    return {method.name: method for method in table}


def _per_view() -> list[Method]:
    """Paganin with every tomography, then every other phase retrieval with the best of them."""
    plain = {
        "fbp": "filtered back-projection",
        "art": "ART (Kaczmarz, ray by ray)",
        "sirt": "SIRT without bounds",
        "sirt-nonneg": "SIRT without negative values",
    }
    rows = [(name, f"Paganin, {what}", PerView("paganin", tomography(name))) for name, what in plain.items()]
    rows += [
        ("svmbir", "Paganin, model-based reconstruction (qGGMRF) by svmbir", PerView("paganin", svmbir_volume)),
        ("tv-nonneg", "Paganin, total variation without negative values", PerView("paganin", tomography("tv"))),
        ("tv", "Paganin, total variation in [0, 1]", Bounded("paganin", "tv")),
    ]
    table = [Method(f"paganin-{name}", PER_VIEW, summary, run) for name, summary, run in rows]
    others = {
        "ctf": "contrast transfer function",
        "tikhonov": "nonlinear Tikhonov with positivity",
        "gerchberg-saxton": "Gerchberg–Saxton",
        "hybrid-input-output": "hybrid input–output",
        "admm": "ADMM",
    }
    return table + [
        Method(f"{name}-tv", PER_VIEW, f"{what}, total variation in [0, 1]", Bounded(name, "tv"))
        for name, what in others.items()
    ]


def _through_waves(effort: float) -> list[Method]:
    start = preset("default").volume
    voxels, neural = VoxelFit(), NeuralFit()
    voxels = replace(voxels, steps=_share(voxels.steps, effort))
    neural = replace(neural, warmup_steps=_share(neural.warmup_steps, effort), steps=_share(neural.steps, effort))
    return [
        Method(
            "holographic-tv",
            VOXELS,
            "total variation made to agree with the holograms: the start of the Gaussians",
            lambda scan, prior, seed, on_progress: holographic_voxels(scan, prior, start, on_progress),
        ),
        Method(
            "voxels-waves",
            VOXELS,
            "voxels from holographic-tv, fitted to the holograms, with total variation",
            lambda scan, prior, seed, on_progress: voxels_through_waves(scan, prior, start, voxels, on_progress),
        ),
        Method(
            "neural-field",
            NEURAL,
            "hash grid and small network, fitted to the projections of holographic-tv, then to the holograms",
            lambda scan, prior, seed, on_progress: neural_through_waves(scan, prior, seed, start, neural, on_progress),
        ),
    ]


def _gaussians(effort: float) -> list[Method]:
    default, random = (_scaled(preset(name), effort) for name in ("default", "random"))
    return [
        Method(
            "gaussians-random",
            GAUSSIANS,
            "from a random start: reconstruct --preset random",
            lambda scan, prior, seed, on_progress: gaussians(scan, prior, seed, random, on_progress),
        ),
        Method(
            "gaussians",
            GAUSSIANS,
            "from phase retrieval and total variation: what reconstruct does by default",
            lambda scan, prior, seed, on_progress: gaussians(scan, prior, seed, default, on_progress),
        ),
    ]


def _surfaces(effort: float) -> Method:
    default, how = _scaled(preset("default"), effort), SurfaceSettings()
    how = replace(how, fit=replace(how.fit, steps=_share(how.fit.steps, effort)))
    return Method(
        "surfaces",
        SURFACES,
        "closed surfaces cut out of the Gaussians and fitted to the holograms: what surface does by default",
        lambda scan, prior, seed, on_progress: surfaces(scan, prior, seed, default, how, on_progress),
    )


def _stage(on_progress: Progress, stage: str) -> Callable[[float], None]:
    return lambda part: on_progress(stage, part)


def _share(steps: int, effort: float) -> int:
    return max(1, round(effort * steps))


def _scaled(settings: Settings, effort: float) -> Settings:
    schedule = replace(settings.fit.schedule, steps=_share(settings.fit.schedule.steps, effort))
    return replace(
        settings,
        approximate_steps=_share(settings.approximate_steps, effort),
        fit=replace(settings.fit, schedule=schedule),
    )


METHODS = methods()
"""Name → method, in the order of the tables."""
