"""The methods of reconstruction. docs/adding.md says how to add one: a file here, and a line in `METHODS`."""

from __future__ import annotations

from ..plugins import Extended
from .auto import Auto
from .gaussian_options import FitOptions, GaussianRates
from .gaussians import Gaussians, gaussian_fit
from .ground import ExtraTerm
from .method import Method, Near, Stage, Task, begun, finished
from .per_view import PerView
from .solve import Settled, require_possible, settled, solve
from .surface_fit import Extraction, SurfaceFit, SurfaceOptions
from .surfaces import Surfaces, refine_surfaces
from .uncertain import Determined, Uncertain
from .volume import SmoothVolume
from .voxels import HolographicVoxels, VoxelFit, Voxels

METHODS: Extended[Method] = Extended(
    {
        "auto": Auto(),
        "gaussians": Gaussians(),
        "surfaces": Surfaces(),
        "voxels": Voxels(),
        "volume": SmoothVolume(),
        "holographic-tv": HolographicVoxels(),
        "tikhonov-tv": PerView("tikhonov", "tv"),
        "ctf-tv": PerView("ctf", "tv"),
        "paganin-tv": PerView("paganin", "tv"),
        "paganin-fbp": PerView("paganin", "fbp", bounded=False),
        "paganin-sirt": PerView("paganin", "sirt", bounded=False),
    },
    "holosplat.methods",
)
"""Every method by the name that the command line knows, with its options by default; other packages add theirs
(docs/adding.md)."""

__all__ = [
    "METHODS",
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
    "PerView",
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
