"""What would fit where a reconstruction does not: the same on larger voxels in the start, or on larger pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from ..baselines import HolographicTV
from ..matter import MatterKind
from ..methods import Auto, Gaussians, HolographicVoxels, Method, NeuralFields, Surfaces, Voxels
from ..scan import Exposures
from .needs import Needs, Sizes, of_reconstruction, on_larger_pixels

BINNINGS, FEWEST_COLUMNS = range(2, 9), 11
"""What is tried for --bin, and columns that must be left."""


def smaller(exposures: Exposures, method: Method, matter: MatterKind | None) -> Iterator[tuple[str, Needs]]:
    """The same reconstruction on larger voxels in the start, and on larger pixels; how, and what it takes then."""
    flag, coarse = _one_voxel_a_pixel(method)
    for factor in (1, *BINNINGS):
        if factor > 1 and exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        sizes, bins = Sizes.of(exposures, factor), f"--bin {factor}" if factor > 1 else ""
        for how, tried in ((bins, method), (f"{bins} {flag}".strip(), coarse)):
            needs = of_reconstruction(sizes, tried, matter)
            if needs is not None and how:
                yield how, needs


def coarser(exposures: Exposures, of: Callable[[Exposures], Needs]) -> Iterator[tuple[str, Needs]]:
    """What `of` says of the same frames on larger pixels; how, and what it takes then."""
    for factor in BINNINGS:
        if exposures.views.shape[1] // factor < FEWEST_COLUMNS:
            return
        yield f"--bin {factor}", of(on_larger_pixels(exposures, factor))


def _one_voxel_a_pixel(method: Method) -> tuple[str, Method]:
    """A method whose start has voxels of one pixel, and the flag that makes it so; none where it has no such start."""
    start = getattr(method, "volume", None)
    if isinstance(start, HolographicTV) and isinstance(method, Gaussians | HolographicVoxels | Voxels | NeuralFields):
        return "--set volume.refine=1", replace(method, volume=replace(start, refine=1))
    if isinstance(method, Auto | Surfaces):
        gaussians = method.gaussians
        coarse = replace(gaussians, volume=replace(gaussians.volume, refine=1))
        return "--set gaussians.volume.refine=1", replace(method, gaussians=coarse)
    return "", method
