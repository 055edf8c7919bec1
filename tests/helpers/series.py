"""A tiny series: two cells that move by a fifth of a pixel a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from helpers.cli import PIXEL, QUICK
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.io.reading import Reading
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.mesh import TriangleMesh
from holosplat.scan import Exposures, Scan
from holosplat.series.folder import SeriesFolder
from holosplat.series.plan import Cut, Settings, plan_series
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene, MeshSeries

SHAPE, TIMES = (19, 23), 5
CELL = HAEMOGLOBIN.delta_beta(20.0)
SETTINGS = Settings(method=QUICK, matter="levels")


def known(energy_kev: float) -> MaterialPrior:
    return MaterialPrior.known(HAEMOGLOBIN.delta_beta(energy_kev))


def moving(times: int, seeds: Sequence[int] = ()) -> Scan:
    """Four views of each time, the last of them held out; seeds: of the cells at each time (default: the same)."""
    box, step = (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL), np.array([0.2, 0.0, 0.1]) * PIXEL
    cells = [random_cells(2, box, seed, 10 * PIXEL) for seed in seeds or (1,) * times]
    at = [[TriangleMesh(c.vertices + k * step, c.faces, c.name) for c in those] for k, those in enumerate(cells)]
    truth = MeshSeries(tuple(MeshScene.of_one_material(cells, CELL) for cells in at), 0.5 * np.arange(times))
    exposures = Exposures.of(Views.evenly_spaced(4, SHAPE, PIXEL), 20.0, 0.1).repeated(truth.times)
    return simulate(truth, exposures, is_test=np.tile(np.arange(4) == 3, times))


@dataclass(frozen=True)
class Files:
    """The scan of all times, and one file of each."""

    path: Path
    scan: Path
    each: Path


def planned(out: Path, scan: Path, window: int = 2, settings: Settings = SETTINGS, overlap: int = 0) -> SeriesFolder:
    """A new series of `scan`."""
    folder = SeriesFolder(out)
    folder.create(plan_series([scan], settings, known, Reading(), Cut(window, overlap)))
    return folder


def cold() -> Settings:
    """Without warm starts."""
    return replace(SETTINGS, warm=replace(SETTINGS.warm, on=False))
