"""Resource estimates of commands other than `reconstruct` of one time.

`benchmarks/needs_acts.py` measures the memory that the constants below stand for, and writes docs/data/needs_acts.csv.
Seconds and bytes on the disk are rough: they were measured once or twice, on a shared machine.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..io.ome import CHUNK, TIFF_SUFFIXES, ZARR_SUFFIX
from ..io.volumes import SLAB_VOXELS
from ..optics.sampling import padding
from .needs import KEPT, Costs, Needs, Sizes, of_fit, of_start, with_report

if TYPE_CHECKING:
    from ..align import PoseOptions
    from ..matter import MatterKind
    from ..methods import Method
    from ..methods.surface_fit import SurfaceOptions
    from ..motion.flow_reconstruction import FlowOptions
    from ..motion.track_linking import TrackOptions
    from ..scan import Exposures


class Parts:
    """Bytes of memory and seconds that the parts of these commands take, beside those of `Costs`."""

    plain_program: float = 0.37e9
    """The program without what fits need."""
    drawn: float = 0.63e9
    """All of it while a report is drawn of one of several times."""
    search: float = 0.54e9
    """The program while it looks for poses."""
    poses: float = 110.0
    """A voxel of the finest pixels on which poses are looked for."""
    carried: float = 255.0
    """A voxel of matter in motion: L-BFGS, gradients and priors."""
    sources: float = 14.0
    """The same voxel at each time: where the flow brought it from."""
    node_pairs: float = 10.0
    """A pair of nodes of two cells in flow, whose block is computed at once."""
    exported: float = 25.0
    """A voxel of a volume that is written whole."""
    slab: float = 18.0
    """A voxel of a slab of one."""
    halved: float = 14.0
    """A voxel of chunks of which larger voxels are made."""


class Room:
    """Bytes on the disk."""

    node: float = 58.0
    """A node of a mesh file, with its triangles."""
    nodes: float = 4.0
    """Nodes of all surfaces, for each pixel of a frame, by and large."""


def of_simulation(exposures: Exposures, samples: int, frames: int) -> Needs:
    """What `simulate` takes: one view of waves at a time, and `frames` that are written. samples: along a pixel."""
    margin = padding(exposures, samples)
    rows, columns = (n + 2 * m for n, m in zip(exposures.views.shape, margin))
    pixels = frames * math.prod(exposures.views.shape)
    return Needs(Costs.program + Costs.simulated * rows * columns * samples**2, Costs.written * pixels + 1e6)


def one_time(exposures: Exposures) -> Exposures:
    """Those of the first time."""
    return exposures[np.flatnonzero(exposures.time == exposures.time.min())]


def times_of(exposures: Exposures) -> int:
    """How many times there are."""
    return len(np.unique(exposures.time))


def of_track(exposures: Exposures, how: TrackOptions) -> Needs:
    """What `track` takes for training frames of several times: bodies of each by itself, then some frames a step."""
    paths = _of_paths(exposures, how.soft.schedule.views_per_step)
    begun = Costs.program + of_start(Sizes.of(one_time(exposures)), how.sightings.volume)
    every = replace(Sizes.of(one_time(exposures)), views=len(exposures))
    return replace(paths, memory=with_report(every, max(begun, paths.memory)))


def of_forecast(exposures: Exposures, views_per_step: int) -> Needs:
    """What `forecast` takes for the training frames of its run; its report is of one time."""
    paths = _of_paths(exposures, views_per_step)
    return replace(paths, memory=max(paths.memory, Parts.drawn + Costs.frames * Sizes.of(exposures).pixels))


def _of_paths(exposures: Exposures, views_per_step: int) -> Needs:
    """What a fit of paths takes."""
    one, times = Sizes.of(one_time(exposures)), times_of(exposures)
    step = replace(one, views=min(len(exposures), views_per_step or len(exposures)))
    every = replace(one, views=len(exposures))
    memory = Costs.program + Costs.frames * every.pixels + Costs.edges * step.waves(1)
    disk = Costs.page + Costs.written * every.pixels + Room.node * Room.nodes * one.rows * one.columns * times
    return Needs(memory, disk, 20 + 3e-5 * every.waves(1))


def of_alignment(exposures: Exposures, how: PoseOptions) -> Needs:
    """What `align` takes: all frames on the finest pixels on which poses are looked for, and a volume of theirs."""
    finest = min(level.pixels for level in how.levels(exposures.views.shape, len(exposures)))
    sizes = Sizes.of(exposures, finest)
    pixels = len(exposures) * math.prod(exposures.views.shape)
    memory = Parts.search + Costs.frames * pixels + Parts.poses * sizes.voxels
    return Needs(memory, Costs.written * pixels + 1e6, 10 + 2e-5 * sizes.views * sizes.voxels)


def of_motion(exposures: Exposures, how: FlowOptions) -> Needs:
    """What `reconstruct --motion flow` takes where something moves: a volume that a flow carries to every time."""
    one, times = Sizes.of(one_time(exposures)), times_of(exposures)
    alone = of_fit(one, how.volume)
    assert alone is not None
    every = replace(one, views=len(exposures))
    moved = Costs.program + Costs.frames * every.pixels + (Parts.carried + Parts.sources * times) * one.voxels
    memory = with_report(every, max(alone.memory, moved))
    disk = Costs.page + Costs.written * (KEPT * one.voxels + every.pixels)
    return Needs(memory, disk, 20 + 1.5e-4 * times * one.voxels)


def of_each_time(exposures: Exposures, method: Method, matter: MatterKind | None) -> Needs | None:
    """What each time by itself takes, one after the other; None for a method of which nothing is known."""
    one = of_fit(Sizes.of(one_time(exposures)), method, matter)
    return one and one.times(times_of(exposures))


def of_surfaces(exposures: Exposures, how: SurfaceOptions) -> Needs:
    """What `surface` takes: the fit of what is cut out of a run."""
    sizes, samples = Sizes.of(exposures), how.fit.schedule.oversample
    waves = replace(sizes, samples=samples).waves() if samples else sizes.waves(1)
    memory = Costs.program + Costs.frames * sizes.pixels + Costs.edges * waves
    return Needs(memory, Room.node * Room.nodes * sizes.rows * sizes.columns + 1e6, 5 + 5.6e-6 * waves)


def of_export(shape: tuple[int, int, int], suffix: str) -> Needs:
    """What `export --volume` takes: TIFF is written whole, others by slabs, OME-Zarr by rows of chunks, too."""
    voxels = math.prod(shape)
    slab, chunks = (
        min(voxels, max(rows, shape[0] * shape[2])) for rows in (SLAB_VOXELS, 2 * CHUNK * shape[0] * shape[2])
    )
    held = Parts.exported * voxels if suffix in TIFF_SUFFIXES else Parts.slab * slab
    held += Parts.halved * chunks if suffix == ZARR_SUFFIX else 0.0
    return Needs(Parts.plain_program + held, 2 * Costs.written * voxels, 1 + 2e-7 * voxels)


def of_growth(cells: int, nodes: int, snapshots: int, travel: float) -> Needs:
    """What `grow` takes; nodes: of a cell; travel: how far the fastest fluid goes from one snapshot to the next [m]."""
    steps = 2.4 * snapshots * travel / 1e-6
    seconds = 2 + 2.5e-8 * steps * (cells * nodes) ** 2
    disk = Room.node * nodes * cells * snapshots + 1e5
    return Needs(Costs.program + Parts.node_pairs * nodes**2, disk, seconds)
