"""The methods of reconstruction. docs/adding.md says how to add one: a file here, and a line in `METHODS`."""

from __future__ import annotations

from .auto import Auto
from .gaussian_options import FitOptions, GaussianRates
from .gaussians import Gaussians, gaussian_fit
from .ground import ExtraTerm
from .method import Method, Near, Stage, Task, begun, finished
from .neural_field import NeuralFields, NeuralFit
from .onix import AlignedFit, Onix, PixelNerf
from .per_view import PerView
from .pinn import Pinn, PinnFit
from .solve import Settled, require_possible, settled, solve
from .surface_fit import Extraction, SurfaceFit, SurfaceOptions
from .surfaces import Surfaces, refine_surfaces
from .uncertain import Determined, Uncertain
from .volume import SmoothVolume
from .voxels import HolographicVoxels, VoxelFit, Voxels

METHODS: dict[str, Method] = {
    "auto": Auto(),
    "gaussians": Gaussians(),
    "surfaces": Surfaces(),
    "voxels": Voxels(),
    "volume": SmoothVolume(),
    "neural-field": NeuralFields(),
    "onix": Onix(),
    "pixelnerf": PixelNerf(),
    "holographic-tv": HolographicVoxels(),
    "tikhonov-tv": PerView("tikhonov", "tv"),
    "ctf-tv": PerView("ctf", "tv"),
    "paganin-tv": PerView("paganin", "tv"),
    "paganin-fbp": PerView("paganin", "fbp", bounded=False),
    "paganin-sirt": PerView("paganin", "sirt", bounded=False),
}
"""Every method by the name that the command line knows, with its options by default."""
OF_SERIES: dict[str, Method] = {"pinn": Pinn()}
"""Those that take all times of a scan at once, and need several."""

__all__ = [
    "METHODS",
    "OF_SERIES",
    "AlignedFit",
    "Auto",
    "Determined",
    "ExtraTerm",
    "Extraction",
    "FitOptions",
    "GaussianRates",
    "Gaussians",
    "HolographicVoxels",
    "Method",
    "Near",
    "NeuralFields",
    "NeuralFit",
    "Onix",
    "PerView",
    "Pinn",
    "PinnFit",
    "PixelNerf",
    "Settled",
    "SmoothVolume",
    "Stage",
    "SurfaceFit",
    "SurfaceOptions",
    "Surfaces",
    "Task",
    "Uncertain",
    "VoxelFit",
    "Voxels",
    "begun",
    "finished",
    "gaussian_fit",
    "refine_surfaces",
    "require_possible",
    "settled",
    "solve",
]
